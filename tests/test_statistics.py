"""Intervals: against hand-computed numbers, and what must hold for any data."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.statistics import bootstrap, interquartile_mean, wilson


def test_wilson_by_hand() -> None:
    # z = 1.959964: centre (8/11 + z^2/22) / (1 + z^2/11), half width by the formula
    z, p, n = 1.959963984540054, 8 / 11, 11
    centre = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z * np.sqrt(p * (1 - p) / n + z * z / (4 * n * n)) / (1 + z * z / n)
    found = wilson(8, 11)
    assert found.value == pytest.approx(8 / 11)
    assert (found.low, found.high) == pytest.approx((centre - half, centre + half), abs=1e-12)
    assert (found.low, found.high) == pytest.approx((0.4344, 0.9025), abs=1e-4)
    assert wilson(11, 11).high == 1.0
    assert wilson(0, 11).low == 0.0


def test_interquartile_mean_by_hand() -> None:
    assert interquartile_mean([1.0, 2.0, 3.0, 100.0]) == 2.5
    assert interquartile_mean([-50.0, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 90.0]) == 2.5  # 1, 2, 3, 4
    assert interquartile_mean([1.0, 2.0, 9.0]) == 4.0  # a quarter of three is no whole value


def test_bootstrap_of_a_normal_sample_matches_theory() -> None:
    sample = np.random.default_rng(1).normal(3.0, 2.0, 400)
    found = bootstrap(sample, "mean", resamples=4000)
    error = 1.96 * sample.std() / np.sqrt(len(sample))
    assert found.value == pytest.approx(sample.mean())
    assert found.high - found.low == pytest.approx(2 * error, rel=0.05)
    assert found.count == 400


@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=12), st.sampled_from(["median", "iqm"]))
def test_intervals_lie_within_the_values_and_repeat(values: list[float], statistic: str) -> None:
    found = bootstrap(values, statistic, resamples=200)
    slack = 1e-9 * (1 + max(abs(value) for value in values))
    assert min(values) - slack <= found.low <= found.high <= max(values) + slack
    assert found == bootstrap(values, statistic, resamples=200)


@given(st.integers(1, 60).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_wilson_holds_the_share(case: tuple[int, int]) -> None:
    found = wilson(*case)
    assert 0.0 <= found.low <= found.value <= found.high <= 1.0


def test_one_value_is_its_own_interval() -> None:
    assert bootstrap([2.5])[:3] == (2.5, 2.5, 2.5)


def test_bad_input() -> None:
    with pytest.raises(UnknownName, match="unknown statistic 'mode'; known: iqm, mean, median"):
        bootstrap([1.0], "mode")
    with pytest.raises(InvalidInput, match=r"values have shape \(0,\)"):
        bootstrap([])
    with pytest.raises(InvalidInput, match="value 1 is nan"):
        bootstrap([1.0, np.nan])
    with pytest.raises(InvalidInput, match="confidence is 95"):
        bootstrap([1.0], confidence=95)
    with pytest.raises(InvalidInput, match="resamples is 0"):
        bootstrap([1.0], resamples=0)
    for successes, trials in ((3, 2), (-1, 2), (0, 0), (0.5, 1)):
        with pytest.raises(InvalidInput, match=f"got {successes} successes of {trials} trials"):
            wilson(successes, trials)  # pyright: ignore[reportArgumentType]
