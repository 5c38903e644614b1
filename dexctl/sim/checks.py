"""Checks of what simulators are given; each answers with the value met and the ones expected."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from dexctl.description.tree import FARTHEST
from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.state import Bools, Floats
from dexctl.validation import check_vector, number

_MOST_GRAVITY = 1000.0  # m/s^2, a hundred times the earth's
GRAVITY = {"up": (0.0, 0.0, -9.81), "down": (0.0, 0.0, 9.81)}


def listed(names: Iterable[str], most: int = 6) -> str:
    """Names for a message: the first few, and how many more."""
    every = list(names)
    more = len(every) - most
    shown = ", ".join(every[:most] if more > 1 else every)
    return f"{shown} and {more} more" if more > 1 else shown


def count(name: str, value: object) -> int:
    """A whole number above 0."""
    if not isinstance(value, (int, np.integer)) or isinstance(value, bool) or value < 1:
        raise InvalidInput(f"{name} is {value!r}; expected a whole number above 0")
    return int(value)


def positive(name: str, value: float) -> float:
    """A finite number above 0."""
    return number(name, value, 0.0, np.finfo(float).max, "a finite number above 0", above=True)


def object_size(value: float) -> float:
    """An object's width [m]."""
    expected = f"a finite number above 0, at most {FARTHEST:g} m"
    return number("object_size", value, 0.0, FARTHEST, expected, above=True)


def vector(name: str, value: ArrayLike | None, length: int) -> Floats:
    """``(length,)`` finite numbers."""
    return check_vector(name, value, length)


def gravity_vector(gravity: str | ArrayLike) -> Floats:
    """``(3,)`` [m/s^2] from "up", "down" (which way the palm looks) or a vector."""
    if isinstance(gravity, str):
        if gravity not in GRAVITY:
            raise UnknownName("gravity", gravity, [*GRAVITY, "a vector (x, y, z) in m/s^2"])
        return np.array(GRAVITY[gravity])
    found = vector("gravity", gravity, 3)
    if np.abs(found).max() > _MOST_GRAVITY:  # no grasp holds, and what is said of it misleads
        raise InvalidInput(f"gravity is {gravity}; expected at most {_MOST_GRAVITY:g} m/s^2")
    return found


def gravity_name(gravity: Sequence[float]) -> str | tuple[float, ...]:
    """What `gravity_vector` makes this of: "up", "down", or the vector as it is."""
    for name, own in GRAVITY.items():
        if np.allclose(gravity, own, atol=1e-9):
            return name
    return tuple(gravity)


def rows(name: str, value: ArrayLike, shape: tuple[int, ...]) -> Floats:
    """Finite numbers of the shape given."""
    numbers = np.asarray(value, float)
    if numbers.shape != shape:
        raise InvalidInput(f"{name} has shape {numbers.shape}; expected {shape}")
    if not np.isfinite(numbers).all():
        where = np.argwhere(~np.isfinite(numbers))[0].tolist()
        raise InvalidInput(f"{name} is {numbers[tuple(where)]} at {where}; expected finite numbers")
    return numbers


def unit(name: str, vectors: Floats) -> Floats:
    """``(N, k)`` made exactly of length 1; they have to be so to 0.1 % already."""
    norm = np.linalg.norm(vectors, axis=1, keepdims=True)
    if (np.abs(norm - 1) > 1e-3).any():
        raise InvalidInput(f"{name} has norms {norm.ravel()[:4]}...; expected 1")
    return vectors / norm


def mask(value: ArrayLike | None, shape: tuple[int, ...]) -> Bools:
    """Booleans of the batch shape; None is all True."""
    if value is None:
        return np.ones(shape, bool)
    chosen = np.asarray(value)
    if chosen.dtype != bool or chosen.shape != shape:
        raise InvalidInput(
            f"mask has shape {chosen.shape} and type {chosen.dtype}; expected {shape} of bool"
        )
    return chosen
