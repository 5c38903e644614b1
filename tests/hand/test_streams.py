"""Random streams: a batch draws what each environment would draw alone."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from dexctl.exceptions import InvalidInput
from dexctl.streams import Streams


@given(seed=st.integers(-(2**70), 2**70), count=st.integers(1, 7), draws=st.integers(1, 4))
def test_environment_i_of_a_batch_is_a_single_one_seeded_i_later(
    seed: int, count: int, draws: int
) -> None:
    batch = Streams(seed, (count,))
    alone = [Streams(seed + i) for i in range(count)]
    for _ in range(draws):
        np.testing.assert_array_equal(
            batch.uniform((2, 3)), np.array([stream.uniform((2, 3)) for stream in alone])
        )
        np.testing.assert_array_equal(batch.normal(), [stream.normal() for stream in alone])


def test_one_seed_for_each_environment() -> None:
    batch = Streams([5, -2, 7], (3,))
    alone = [Streams(seed).uniform((4,)) for seed in (5, -2, 7)]
    np.testing.assert_array_equal(batch.uniform((4,)), alone)


@pytest.mark.parametrize("seed", [1.5, "x", [1, 2], np.nan, None, [1, 2, 3.5]])
def test_a_seed_that_is_none_is_an_error(seed: object) -> None:
    with pytest.raises(InvalidInput, match="seed"):
        Streams(seed, (3,))  # type: ignore[arg-type]


def test_numbers_drawn_at_once_are_those_drawn_one_by_one() -> None:
    at_once, one_by_one = Streams(3, (2,)), Streams(3, (2,))
    numbers = at_once.uniform((6,))
    np.testing.assert_array_equal(
        numbers, np.stack([one_by_one.uniform() for _ in range(6)], axis=-1)
    )


def test_only_the_masked_streams_move_on() -> None:
    mask = np.array([True, False, True])
    streams, reference = Streams(0, (3,)), Streams(0, (3,))
    first = streams.uniform((2,), mask)
    np.testing.assert_array_equal(first[mask], reference.uniform((2,))[mask])
    second = streams.uniform((2,))
    np.testing.assert_array_equal(second[1], first[1])
    np.testing.assert_array_equal(second[mask], reference.uniform((2,))[mask])


def test_reseeding_some_leaves_the_others() -> None:
    streams, reference = Streams(0, (3,)), Streams(0, (3,))
    streams.uniform((5,))
    reference.uniform((5,))
    streams.reseed(40, np.array([False, True, False]))
    numbers = streams.uniform()
    np.testing.assert_array_equal(numbers[[0, 2]], reference.uniform()[[0, 2]])
    assert numbers[1] == Streams(41).uniform()
    streams.reseed(0)
    np.testing.assert_array_equal(streams.uniform(), Streams(0, (3,)).uniform())


def test_save_and_restore() -> None:
    streams = Streams(8, (4,))
    streams.normal((3,))
    saved = streams.save()
    expected = streams.normal((2,))
    streams.uniform((9,))
    streams.restore(saved)
    np.testing.assert_array_equal(streams.normal((2,)), expected)
    streams.restore(saved)  # what was saved is not changed by use
    np.testing.assert_array_equal(streams.normal((2,)), expected)


def test_distributions() -> None:
    streams = Streams(1, (50,))
    uniform = streams.uniform((400,))
    normal = streams.normal((400,))
    assert uniform.min() >= 0
    assert uniform.max() < 1
    assert stats.kstest(uniform.ravel(), "uniform").pvalue > 0.01
    assert stats.kstest(normal.ravel(), "norm").pvalue > 0.01
    # neighbouring environments, neighbouring draws, and the two kinds do not follow each other
    for a, b in (
        (uniform[1:], uniform[:-1]),
        (uniform[:, 1:], uniform[:, :-1]),
        (uniform, normal),
    ):
        assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < 0.03
