"""Shares and medians over trials, each with its interval, and how people read them."""

from __future__ import annotations

from typing import Any

import numpy as np

from dexctl.statistics import bootstrap, wilson


def share(hits: np.ndarray) -> dict[str, Any]:
    """How many of the trials ``(N,)``, with the 95 % Wilson interval of their share."""
    k, n = int(hits.sum()), len(hits)
    found = wilson(k, n)
    interval = [rounded(found.low), rounded(found.high)]
    return {"count": k, "of": n, "share": round(k / n, 4), "wilson95": interval}


def over_seeds(values: np.ndarray) -> dict[str, Any]:
    """Median over trials ``(N,)`` with its 95 % bootstrap interval, 10th and 90th percentile."""
    found = bootstrap(values, "median")
    p10, p90 = np.percentile(values, [10, 90])
    return {
        "median": rounded(found.value),
        "bootstrap95": [rounded(found.low), rounded(found.high)],
        "p10": rounded(p10),
        "p90": rounded(p90),
    }


def percent(part: dict[str, Any]) -> str:
    """A share for people: 61 of 64 (95 %)."""
    return f"{part['count']} of {part['of']} ({100 * part['share']:.0f} %)"


def percent_interval(part: dict[str, Any]) -> str:
    """A share for people with its interval: 95 % (87-98)."""
    low, high = part["wilson95"]
    return f"{100 * part['share']:.0f} % ({100 * low:.0f}-{100 * high:.0f})"


def rounded(value: Any) -> float:
    """As results have it, four places behind the point."""
    return round(float(value), 4)
