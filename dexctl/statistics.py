"""Statistics of trials and of seeds: intervals for shares, medians and interquartile means.

What is resampled must be what is independent: seeds, for claims about a method; episodes, for
claims about one policy. Episodes of several seeds are never pooled.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.state import Floats


class Estimate(NamedTuple):
    """A number with its interval, in the unit of what it is of.

    Attributes:
        value: the estimate.
        low, high: of the confidence interval.
        count: how many independent values it is of.
    """

    value: float
    low: float
    high: float
    count: int

    def to_dict(self) -> dict[str, float | int]:
        """As JSON can hold it."""
        return self._asdict()


def interquartile_mean(values: ArrayLike, axis: int = -1) -> Floats:
    """Mean of the middle half: a quarter of the values is cut off at each end.

    Where a quarter is no whole number, as much as is whole is cut off (Agarwal et al., "Deep
    reinforcement learning at the edge of the statistical precipice", 2021, who use scipy's
    ``trim_mean`` with 0.25).
    """
    from scipy import stats  # slow to import, so not before it is needed

    return np.asarray(stats.trim_mean(np.asarray(values, float), 0.25, axis=axis))


STATISTICS: dict[str, Callable[..., Floats]] = {
    "iqm": interquartile_mean,
    "mean": np.mean,
    "median": np.median,
}


def bootstrap(
    values: ArrayLike,
    statistic: str = "median",
    *,
    confidence: float = 0.95,
    resamples: int = 2000,
    seed: int = 0,
) -> Estimate:
    """A statistic of independent values, with its percentile bootstrap interval.

    Args:
        values: ``(n,)``, one for each independent trial or seed.
        statistic: "median", "mean" or "iqm" (interquartile mean).
        confidence: of the interval.
        resamples: how many.
        seed: of the resampling; the same values and seed give the same interval.

    Raises:
        UnknownName: no such statistic.
        InvalidInput: no values, values that are not finite, or settings out of range.
    """
    if statistic not in STATISTICS:
        raise UnknownName("statistic", statistic, STATISTICS)
    numbers = _numbers(values)
    _check_confidence(confidence)
    if not isinstance(resamples, (int, np.integer)) or resamples < 1:
        raise InvalidInput(f"resamples is {resamples}; expected a whole number above 0")
    compute, count = STATISTICS[statistic], len(numbers)
    index = np.random.default_rng(seed).integers(0, count, (int(resamples), count))
    drawn = compute(numbers[index], axis=-1)
    tail = 50.0 * (1.0 - confidence)
    low, high = np.percentile(drawn, [tail, 100.0 - tail])
    return Estimate(float(compute(numbers)), float(low), float(high), count)


def bootstrap_ratio(
    values: ArrayLike,
    base: ArrayLike,
    statistic: str = "median",
    *,
    confidence: float = 0.95,
    resamples: int = 2000,
    seed: int = 0,
) -> Estimate | None:
    """A statistic of ``values`` over that of ``base``, with its percentile bootstrap interval.

    Both are resampled, independently of each other.

    Args:
        values: ``(n,)``.
        base: ``(k,)``.
        statistic, confidence, resamples, seed: see `bootstrap`.

    Returns:
        None where the base's statistic is not above zero, since the ratio then says nothing. Where
        it is so in one of the resamples, the ends of the interval are nan.

    Raises:
        UnknownName, InvalidInput: see `bootstrap`.
    """
    whole = bootstrap(values, statistic, confidence=confidence, resamples=resamples, seed=seed)
    below = bootstrap(base, statistic, confidence=confidence, resamples=resamples, seed=seed)
    if below.value <= 0:
        return None
    compute, rng = STATISTICS[statistic], np.random.default_rng(seed)
    drawn = []
    for numbers in (_numbers(values), _numbers(base)):
        index = rng.integers(0, len(numbers), (int(resamples), len(numbers)))
        drawn.append(compute(numbers[index], axis=-1))
    low = high = np.nan
    if (drawn[1] > 0).all():
        tail = 50.0 * (1.0 - confidence)
        low, high = np.percentile(drawn[0] / drawn[1], [tail, 100.0 - tail])
    return Estimate(whole.value / below.value, float(low), float(high), whole.count)


def wilson(successes: int, trials: int, *, confidence: float = 0.95) -> Estimate:
    """A share with its Wilson score interval.

    Raises:
        InvalidInput: no trials, or more successes than trials.
    """
    whole = all(
        isinstance(value, (int, np.integer)) and not isinstance(value, bool)
        for value in (successes, trials)
    )
    if not (whole and 0 <= successes <= trials and trials > 0):
        raise InvalidInput(
            f"got {successes} successes of {trials} trials; expected whole numbers, "
            "0 <= successes <= trials and at least one trial"
        )
    _check_confidence(confidence)
    from scipy.stats import binomtest  # slow to import, so not before it is needed

    found = binomtest(int(successes), int(trials))
    interval = found.proportion_ci(confidence_level=confidence, method="wilson")
    share = int(successes) / int(trials)
    # rounding may take an end of the interval past the share it belongs to
    low, high = min(float(interval.low), share), max(float(interval.high), share)
    return Estimate(share, low, high, int(trials))


def _numbers(values: ArrayLike) -> Floats:
    numbers = np.asarray(values, float)
    if numbers.ndim != 1 or not len(numbers):
        raise InvalidInput(f"values have shape {numbers.shape}; expected (n,) with n above 0")
    if not np.isfinite(numbers).all():
        where = int(np.argmin(np.isfinite(numbers)))
        raise InvalidInput(f"value {where} is {numbers[where]}; expected finite numbers")
    return numbers


def _check_confidence(confidence: float) -> None:
    if not 0.0 < confidence < 1.0:
        raise InvalidInput(f"confidence is {confidence}; expected a number between 0 and 1")
