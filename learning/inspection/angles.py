"""The angle between actions: how far a policy goes a controller's way."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from dexctl.exceptions import InvalidInput
from dexctl.state import Floats

NOTHING = 1e-9
"""A set-point change shorter than this [rad] has no direction."""


def action_angle(a: ArrayLike, b: ArrayLike, joints: ArrayLike | None = None) -> Floats:
    """Angle ``(...)`` [rad] in [0, pi] between set-point changes ``(..., d)``.

    NaN where one of them is zero: then there is no angle. Two random directions of d joints make
    one of pi/2, give or take about 1 / sqrt(d).

    Args:
        a, b: the actions.
        joints: which joints count, ``(..., d)`` bool; None is all.

    Raises:
        InvalidInput: they are not of one shape.
    """
    a, b = np.asarray(a, float), np.asarray(b, float)
    if a.shape != b.shape:
        raise InvalidInput(f"actions have shapes {a.shape} and {b.shape}; expected the same")
    if joints is not None:
        a, b = np.where(joints, a, 0.0), np.where(joints, b, 0.0)
    long_a = np.sqrt((a * a).sum(axis=-1, keepdims=True))
    long_b = np.sqrt((b * b).sum(axis=-1, keepdims=True))
    defined = ((long_a > NOTHING) & (long_b > NOTHING))[..., 0]
    a = a / np.where(long_a > NOTHING, long_a, 1.0)
    b = b / np.where(long_b > NOTHING, long_b, 1.0)
    # exact near 0 and pi, where the arc cosine is not
    apart = np.sqrt(((a - b) ** 2).sum(axis=-1))
    together = np.sqrt(((a + b) ** 2).sum(axis=-1))
    return np.where(defined, 2.0 * np.arctan2(apart, together), np.nan)
