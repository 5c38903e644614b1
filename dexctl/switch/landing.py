"""Where switching fingers come down, and the way round the object: geometry about an axis."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dexctl.rotations import cross
from dexctl.state import Floats


class Landing(NamedTuple):
    """Where fingers are to be put down, one for each hand.

    Attributes:
        tip: expected fingertip position at touch ``(..., 3)`` [m].
        normal: expected unit normal there, from the fingertip into the object ``(..., 3)``.
    """

    tip: Floats
    normal: Floats


def split(vector: Floats, axis: Floats) -> tuple[Floats, Floats]:
    """The height along ``axis`` ``(...)`` and the part across it ``(..., 3)``."""
    height = vector @ axis
    return height, vector - height[..., None] * axis


def unit_across(vector: Floats, axis: Floats) -> Floats:
    """The unit vector of the part of ``vector`` ``(..., 3)`` across ``axis``."""
    across = split(vector, axis)[1]
    return across / np.maximum(np.sqrt((across * across).sum(axis=-1, keepdims=True)), 1e-9)


def azimuth(reference: Floats, vector: Floats, axis: Floats) -> Floats:
    """Signed angle about ``axis`` from ``reference`` to ``vector``, both across it [rad]."""
    return np.arctan2(cross(reference, vector) @ axis, (reference * vector).sum(axis=-1))


def turned(direction: Floats, angle: Floats | float, axis: Floats) -> Floats:
    """Vectors across ``axis`` ``(..., 3)`` turned about it by ``angle`` ``(...)``."""
    angle = np.asarray(angle)[..., None]
    side = cross(np.broadcast_to(axis, direction.shape), direction)
    return np.cos(angle) * direction + np.sin(angle) * side


def landing_at(origin: Floats, direction: Floats, radius: Floats) -> Landing:
    """Touch from outside at ``radius`` ``(...)`` [m] in ``direction``, at the height of the centre.

    A finger above or below the centre of a round object would press it out of the grasp.
    """
    return Landing(origin + radius[..., None] * direction, -direction)


def round_the_axis(
    tip: Floats, goal: Floats, origin: Floats, axis: Floats, least_radius: Floats
) -> Floats:
    """The next goal on the way from ``tip`` to ``goal`` ``(M, 3)``, a quarter radian ahead.

    The way stays outside both ends and ``least_radius`` ``(M,)`` [m] until its last piece: corners
    stick out between two faces.
    """
    height_a, flat_a = split(tip - origin, axis)
    height_b, flat_b = split(goal - origin, axis)
    radius_a = np.sqrt((flat_a * flat_a).sum(axis=-1))
    radius_b = np.sqrt((flat_b * flat_b).sum(axis=-1))
    angle = azimuth(flat_a, flat_b, axis)
    part = np.minimum(0.25 / np.maximum(np.abs(angle), 1e-9), 1.0)
    direction = turned(flat_a / np.maximum(radius_a, 1e-9)[:, None], part * angle, axis)
    outside = np.maximum(np.maximum(radius_a, radius_b), least_radius)
    radius = np.where(part < 1.0, outside, radius_b)
    height = height_a + part * (height_b - height_a)
    return origin + radius[:, None] * direction + height[:, None] * axis
