"""Figures as people read them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from dexctl.statistics import Estimate


def percent(share: float | None) -> str:
    """A share as a percentage; a dash where there is none."""
    return "-" if share is None else f"{100 * share:.0f} %"


def interval(one: Estimate, unit: str = "", digits: int = 2, factor: float = 1.0) -> str:
    """A figure with its interval."""
    value, low, high = (f"{factor * x:.{digits}f}" for x in (one.value, one.low, one.high))
    return f"{value}{' ' + unit if unit else ''} ({low} to {high})".replace("-0.00", "0.00")


def spread(found: Mapping[str, Any], digits: int, unit: str = "") -> str:
    """A median with its 10th and 90th percentile; a dash where there is none."""
    middle, low, high = (found[name] for name in ("median", "p10", "p90"))
    if middle is None or low is None or high is None:
        return "-"
    space = "" if unit in ("", "°") else " "
    return f"{middle:.{digits}f}{space}{unit} ({low:.{digits}f} to {high:.{digits}f})"


def degrees(found: Mapping[str, Any]) -> dict[str, Any]:
    """Percentiles in degrees by their plain names."""
    return {name: found[f"{name}_deg"] for name in ("median", "p10", "p90")}


def number(value: float, digits: int) -> str:
    """A number; a dash where it is none."""
    return f"{value:.{digits}f}" if np.isfinite(value) else "-"
