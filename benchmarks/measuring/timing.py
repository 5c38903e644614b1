"""Timings of calls, taken in turns so that all sides meet the same load."""

from __future__ import annotations

import time
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import numpy as np

THREADS = 2  # of the physics in the timing benchmarks
# of in-grasp manipulation; they give the same numbers
ENGINES = {"compiled": "compiled (extra `fast`)", "plain": "numpy only"}


def timed(call: Callable[[], Any]) -> float:
    """Seconds that a call took."""
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def timings(call: Callable[[int], Any], count: int, warm_up: int = 50) -> np.ndarray:
    """Seconds that each of ``count`` calls took, ``(count,)``; ``call`` gets its index."""
    for i in range(min(warm_up, count)):
        call(i)
    return np.array([timed(lambda i=i: call(i)) for i in range(count)])


def in_turns(
    calls: dict[str, Callable[[int], Any]], count: int, rounds: int
) -> dict[str, np.ndarray]:
    """Timings ``(rounds, count)`` of each call, taken in turns so that all meet the same load."""
    rows: dict[str, list[np.ndarray]] = {name: [] for name in calls}
    for i in range(rounds):
        order = list(calls) if i % 2 == 0 else list(calls)[::-1]
        for name in order:
            rows[name].append(timings(calls[name], count))
    return {name: np.array(row) for name, row in rows.items()}


def spread(seconds: np.ndarray) -> dict[str, float]:
    """Median, p99 and count of timings, in microseconds."""
    return {
        "median_us": round(float(np.median(seconds) * 1e6), 2),
        "p99_us": round(float(np.percentile(seconds, 99) * 1e6), 2),
        "count": int(np.size(seconds)),
    }


def ratio(ours: np.ndarray, theirs: np.ndarray) -> dict[str, float]:
    """Median over the rounds ``(rounds, ...)`` of the ratio of medians, with its extremes."""
    each = np.median(ours.reshape(len(ours), -1), 1) / np.median(theirs.reshape(len(theirs), -1), 1)
    return {
        "median": round(float(np.median(each)), 4),
        "least": round(float(each.min()), 4),
        "most": round(float(each.max()), 4),
        "rounds": len(each),
    }


def engines() -> list[str]:
    """The engines of in-grasp manipulation that are installed."""
    return [name for name in ENGINES if name == "plain" or find_spec("numba") is not None]
