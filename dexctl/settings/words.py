"""Values of several parts that are one word of the command line each."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Annotated, Any

import numpy as np
import tyro


def _read_vector(words: list[str]) -> str | tuple[float, ...]:
    parts = words[0].split(",")
    if len(parts) == 1:
        return words[0]
    try:
        numbers = tuple(float(part) for part in parts)
    except ValueError:
        numbers = ()
    if len(numbers) != 3 or not np.isfinite(numbers).all():
        raise ValueError(f"{words[0]!r} is neither a name nor three finite numbers")
    return numbers


def _show_vector(value: str | tuple[float, ...]) -> list[str]:
    return [value if isinstance(value, str) else _commas(value)]


Vector = Annotated[
    str | tuple[float, float, float],
    tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar="NAME|X,Y,Z",
        instance_from_str=_read_vector,
        is_instance=lambda value: isinstance(value, str | tuple),
        str_from_instance=_show_vector,
    ),
]
"""A direction by name, or as three numbers; "x,y,z" on the command line."""


def _read_quaternion(words: list[str]) -> tuple[float, float, float, float]:
    try:
        w, x, y, z = (float(part) for part in words[0].split(","))
    except ValueError:
        raise ValueError(f"{words[0]!r} is no orientation; expected w,x,y,z") from None
    return w, x, y, z


def _comma_separated(metavar: str, read: Callable[[list[str]], Any]) -> Any:
    """How a tuple is one word of the command line."""
    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar=metavar,
        instance_from_str=read,
        is_instance=lambda value: isinstance(value, tuple),
        str_from_instance=lambda value: [_commas(value)],
    )


def _commas(values: Iterable[float | str]) -> str:
    return ",".join(one if isinstance(one, str) else f"{one:g}" for one in values)


Quaternion = Annotated[
    tuple[float, float, float, float], _comma_separated("W,X,Y,Z", _read_quaternion)
]
"""An orientation, wxyz; "w,x,y,z" on the command line."""

Quaternions = Annotated[
    tuple[tuple[float, float, float, float], ...],
    tyro.constructors.PrimitiveConstructorSpec(
        nargs="*",
        metavar="[W,X,Y,Z ...]",
        instance_from_str=lambda words: tuple(_read_quaternion([word]) for word in words),
        is_instance=lambda value: isinstance(value, tuple),
        str_from_instance=lambda value: [_commas(each) for each in value],
    ),
]
"""Several orientations, each as `Quaternion`."""


def _read_range(words: list[str]) -> tuple[float, float]:
    try:
        low, high = (float(part) for part in words[0].split(","))
    except ValueError:
        raise ValueError(f"{words[0]!r} is no range; expected two numbers, low,high") from None
    return low, high


Range = Annotated[tuple[float, float], _comma_separated("LOW,HIGH", _read_range)]
"""From a low to a high number; "low,high" on the command line."""


def _read_named_ranges(words: list[str]) -> dict[str, tuple[float, float]]:
    found: dict[str, tuple[float, float]] = {}
    for word in words:
        name, _, numbers = word.partition("=")
        if not (name and numbers):
            raise ValueError(f"{word!r} is no range with a name; expected name=low,high")
        if name in found:
            raise ValueError(f"{name!r} is given twice")
        found[name] = _read_range([numbers])
    return found


NamedRanges = Annotated[
    dict[str, tuple[float, float]],
    tyro.constructors.PrimitiveConstructorSpec(
        nargs="*",
        metavar="[NAME=LOW,HIGH ...]",
        instance_from_str=_read_named_ranges,
        is_instance=lambda value: isinstance(value, dict),
        str_from_instance=lambda value: [f"{name}={_commas(one)}" for name, one in value.items()],
    ),
]
"""Ranges by name; "name=low,high", several of them, on the command line."""


def _read_names(words: list[str]) -> tuple[str, ...]:
    return tuple(filter(None, words[0].split(",")))


Names = Annotated[tuple[str, ...], _comma_separated("NAME,NAME", _read_names)]
"""Names that may begin with a minus; "x,-y" on the command line."""
