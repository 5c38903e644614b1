"""Checks of configuration values, with messages that name the field."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dexctl.exceptions import InvalidInput


def check_numbers(
    config: object,
    *,
    positive: tuple[str, ...] = (),
    not_negative: tuple[str, ...] = (),
    fractions: tuple[str, ...] = (),
) -> None:
    """Raise InvalidInput where a field of ``config`` is not such a number."""
    for names, low, high, wanted in (
        (positive, np.nextafter(0.0, 1.0), np.inf, "a finite number above 0"),
        (not_negative, 0.0, np.inf, "a finite number, 0 or more"),
        (fractions, 0.0, 1.0, "a number from 0 to 1"),
    ):
        for name in names:
            value = getattr(config, name)
            number = isinstance(value, (int, float, np.number)) and not isinstance(value, bool)
            if not (number and np.isfinite(value) and low <= value <= high):
                raise InvalidInput(f"{name} is {value!r}; expected {wanted}")


def check_kind(config: object, **kinds: type) -> None:
    """Raise InvalidInput where a field of ``config`` is not of the class given for it."""
    for name, kind in kinds.items():
        value = getattr(config, name)
        if not isinstance(value, kind):
            raise InvalidInput(f"{name} is {value!r}; expected a {kind.__name__}")


def check_mask(mask: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """``mask`` as an array of ``shape``; InvalidInput where it is not of bools of that shape."""
    array = np.asarray(mask)
    if array.ndim == 0 and shape == (1,):  # one hand, kept as a batch of one
        array = array.reshape(1)
    if array.dtype != bool or array.shape != shape:
        raise InvalidInput(
            f"mask has shape {array.shape} and kind {array.dtype}; expected bools of shape {shape}"
        )
    return array


def check_twist(twist: object) -> None:
    """Raise InvalidInput where ``twist`` is not six finite numbers."""
    try:
        array = np.asarray(twist, float)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.shape != (6,) or not np.isfinite(array).all():
        raise InvalidInput(
            f"twist is {twist!r}; expected six finite numbers: (linear [m/s], angular [rad/s])"
        )


def unit_axis(axis: object) -> tuple[float, float, float]:
    """The unit vector along ``axis``; InvalidInput where it is not a direction."""
    try:
        array = np.asarray(axis, float)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.shape != (3,) or not np.isfinite(array).all() or not array.any():
        raise InvalidInput(f"axis is {axis!r}; expected three finite numbers, not all zero")
    x, y, z = array / np.linalg.norm(array)
    return float(x), float(y), float(z)


class Turnable(Protocol):
    """Settings of a controller that turns objects."""

    def about(self, axis: object) -> Any:
        """The same with the rotation about ``axis`` ``(3,)``, at the same speed."""
        ...


C = TypeVar("C", bound=Turnable)


def with_changes(config: C, changes: Mapping[str, Any], axis: object = None) -> C:
    """The settings with single ones changed, and then turned about ``axis``; None leaves it.

    Raises:
        InvalidInput: there is no such setting, or a value is out of range.
    """
    known = [field.name for field in fields(config)]  # type: ignore[arg-type]
    for name in changes:
        if name not in known:
            raise InvalidInput(
                f"{type(config).__name__} has no setting {name!r}; known: {', '.join(known)}"
            )
    changed = replace(config, **changes)  # type: ignore[type-var]
    return changed if axis is None else changed.about(axis)
