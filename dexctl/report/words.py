"""Figures as people read them, on pages and in terminals."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np

_NO_VALUE = "-"
_MINUS_ZERO = re.compile(r"-(0(?:\.0*)?)(?![\d.])")


class HasInterval(Protocol):
    """A figure with its interval, such as `dexctl.statistics.Estimate`."""

    @property
    def value(self) -> float: ...
    @property
    def low(self) -> float: ...
    @property
    def high(self) -> float: ...


def number(value: float | None, digits: int) -> str:
    """A number; a dash where it is none."""
    if value is None or not np.isfinite(value):
        return _NO_VALUE
    return _MINUS_ZERO.sub(r"\1", f"{value:.{digits}f}")


def between(
    value: float | None,
    low: float | None,
    high: float | None,
    unit: str = "",
    digits: int = 2,
    factor: float = 1.0,
) -> str:
    """A figure with what it lies between: "12.30 rad (11.00 to 13.00)"; a dash where it is none.

    Args:
        value, low, high: the figure and its bounds.
        unit: that follows it.
        digits: after the point.
        factor: everything is multiplied by it, 100 for percent.
    """
    ends = (value, low, high)
    said = [number(None if end is None else factor * end, digits) for end in ends]
    if said[0] == _NO_VALUE or (said[1] == said[2] == _NO_VALUE):
        return _NO_VALUE if said[0] == _NO_VALUE else f"{said[0]}{_after(unit)}"
    return f"{said[0]}{_after(unit)} ({said[1]} to {said[2]})"


def interval(one: HasInterval, unit: str = "", digits: int = 2, factor: float = 1.0) -> str:
    """An estimate with its interval; see `between`."""
    return between(one.value, one.low, one.high, unit, digits, factor)


def spread(found: Mapping[str, Any], unit: str = "", digits: int = 2) -> str:
    """A median with its 10th and 90th percentile, as ``{"median", "p10", "p90"}``."""
    return between(found["median"], found["p10"], found["p90"], unit, digits)


def percent(share: float | None) -> str:
    """A share as a percentage; a dash where there is none."""
    return _NO_VALUE if share is None else f"{number(100 * share, 0)} %"


def share(count: int, of: int, low: float, high: float) -> str:
    """A share with its interval, from 0 to 1: "8 of 10, 80 % (49 to 94 %)"."""
    ends = f"{100 * low:.0f} to {100 * high:.0f} %"
    return f"{count} of {of}, {100 * count / of:.0f} % ({ends})"


def vector(numbers: Sequence[float]) -> str:
    """Numbers in brackets."""
    return f"({', '.join(f'{number:g}' for number in numbers)})"


def about(axis: str | Sequence[float]) -> str:
    """The axis of a rotation: "about z", "about -x", "about (0, 0.6, 0.8)"."""
    return f"about {axis if isinstance(axis, str) else vector(axis)}"


def _after(unit: str) -> str:
    """A unit as it follows a number."""
    return unit if unit in ("", "°") else f" {unit}"
