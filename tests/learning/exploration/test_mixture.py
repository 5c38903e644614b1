"""The behaviour mixture: hand-computed numbers, and what must hold for any."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from dexctl.exceptions import InvalidInput
from learning.exploration import (
    Segments,
    advance,
    fixed_probabilities,
    linear_decay,
    value_probabilities,
)


def test_two_candidates_are_the_sigmoid_of_the_thesis() -> None:
    found = value_probabilities([[1.0, 1.0 + np.log(3.0)], [0.0, 0.0]])
    assert found == pytest.approx(np.array([[0.25, 0.75], [0.5, 0.5]]), abs=1e-15)


def test_temperature_divides_the_values() -> None:
    assert value_probabilities([0.0, 2 * np.log(3.0)], 2.0) == pytest.approx([0.25, 0.75])


def test_large_values_do_not_overflow() -> None:
    found = value_probabilities([[1e4, 1e4 - 1.0], [-1e300, 1e300]])
    assert found[0] == pytest.approx([1 / (1 + np.exp(-1)), 1 / (1 + np.exp(1))], abs=1e-12)
    assert found[1].tolist() == [0.0, 1.0]


def test_three_candidates() -> None:
    assert value_probabilities(np.log([2.0, 3.0, 5.0])) == pytest.approx([0.2, 0.3, 0.5])


@settings(derandomize=True, deadline=None)
@given(
    npst.arrays(float, (3, 4), elements=st.floats(-1e3, 1e3)),
    st.floats(-1e3, 1e3),
    st.floats(0.1, 10.0),
)
def test_probabilities(values: np.ndarray, shift: float, temperature: float) -> None:
    found = value_probabilities(values, temperature)
    assert (found >= 0).all() and found.sum(axis=-1) == pytest.approx(np.ones(3))
    assert value_probabilities(values + shift, temperature) == pytest.approx(found, abs=1e-9)
    best = np.take_along_axis(found, values.argmax(axis=-1)[:, None], axis=-1)[:, 0]
    assert (best == found.max(axis=-1)).all()


@pytest.mark.parametrize("temperature", [0.0, -1.0, np.nan, np.inf])
def test_bad_temperature(temperature: float) -> None:
    with pytest.raises(InvalidInput, match="temperature is"):
        value_probabilities([0.0, 0.0], temperature)


def test_bad_values() -> None:
    with pytest.raises(InvalidInput, match="not finite"):
        value_probabilities([0.0, np.nan])


def test_fixed_schedule() -> None:
    assert fixed_probabilities(0.5, 3).tolist() == [0.5, 0.25, 0.25]
    assert fixed_probabilities(0.7, 1).tolist() == [1.0]
    with pytest.raises(InvalidInput, match="share is 1.5"):
        fixed_probabilities(1.5, 2)
    with pytest.raises(InvalidInput, match="candidates is 0"):
        fixed_probabilities(0.5, 0)


def test_linear_decay() -> None:
    found = [linear_decay(step, 0.8, 100) for step in (0, 25, 100, 250)]
    assert found == pytest.approx([0.8, 0.6, 0.0, 0.0])
    assert linear_decay(0, 0.8, 0) == 0.0


def test_a_choice_holds_for_its_length() -> None:
    segments = Segments.start(1)
    actors = []
    for uniform in (0.9, 0.1, 0.1, 0.1, 0.9):
        segments = advance(segments, [0.5, 0.5], [uniform], [1, 3])
        actors.append(int(segments.actor[0]))
        segments = segments.after_step(np.array([False]))
    # the controller for three steps, whatever was drawn; the policy for one; the controller again
    assert actors == [1, 1, 1, 0, 1]


def test_the_end_of_an_episode_ends_the_segment() -> None:
    segments = advance(Segments.start(2), [0.0, 1.0], [0.5, 0.5], 10)
    segments = segments.after_step(np.array([True, False]))
    assert segments.left.tolist() == [0, 9] and segments.due.tolist() == [True, False]
    segments = advance(segments, [1.0, 0.0], [0.5, 0.5], 10)
    assert segments.actor.tolist() == [0, 1] and segments.left.tolist() == [10, 9]


def test_which_interval_a_number_falls_in() -> None:
    start = Segments.start(5)
    uniform = [0.0, 0.199, 0.2, 0.5, 0.999]
    found = advance(start, [0.2, 0.3, 0.5], uniform, [4, 5, 6])
    assert found.actor.tolist() == [0, 0, 1, 2, 2]
    assert found.left.tolist() == [4, 4, 5, 6, 6]


def test_frequencies() -> None:
    uniform = np.random.default_rng(0).random(20_000)
    actor = advance(Segments.start(len(uniform)), [0.2, 0.3, 0.5], uniform, 1).actor
    share = np.bincount(actor) / len(actor)
    assert share == pytest.approx([0.2, 0.3, 0.5], abs=0.012)


@settings(derandomize=True, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 7), st.integers(1, 4))
def test_segments_never_change_actor_before_their_end(seed: int, length: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    segments, age = Segments.start(6), np.zeros(6, int)
    for _ in range(30):
        before, due = segments.actor, segments.due
        probabilities = rng.dirichlet(np.ones(count), 6)
        segments = advance(segments, probabilities, rng.random(6), length)
        assert (segments.actor[~due] == before[~due]).all()
        assert ((segments.actor >= 0) & (segments.actor < count)).all()
        age = np.where(due, 1, age + 1)
        assert (age + segments.left == length + 1).all()
        segments = segments.after_step(rng.random(6) < 0.1)


def test_bad_length() -> None:
    with pytest.raises(InvalidInput, match="length is 0"):
        advance(Segments.start(1), [1.0], [0.5], 0)


def test_candidates_that_are_not_there_have_no_share() -> None:
    where = np.array([[True, True, False], [True, False, False], [True, True, True]])
    found = value_probabilities(np.array([0.0, 0.0, 1e4]), where=where)
    np.testing.assert_allclose(found, [[0.5, 0.5, 0], [1, 0, 0], [0, 0, 1]])
    found = fixed_probabilities(0.6, 3, where)
    np.testing.assert_allclose(found, [[0.4, 0.6, 0], [1, 0, 0], [0.4, 0.3, 0.3]])
