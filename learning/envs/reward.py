"""The reward: the object's angular velocity about the axis, for fingertip grasps only."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dexctl.rotations import inverse, multiply, rotate
from dexctl.state import Bools, Floats


class Turning(NamedTuple):
    """What one control step did to the object; arrays are ``(...)``.

    Attributes:
        speed: angular velocity about the axis, mean over the control step [rad/s].
        tilt: phi, angle between the axis and where the object's own axis is now [rad].
        fingertips: n_c, how many touch.
        fingertips_only: whether nothing of the hand but fingertips touches the object.
    """

    speed: Floats
    tilt: Floats
    fingertips: np.ndarray
    fingertips_only: Bools


def reward(turning: Turning, max_reward: float, max_tilt: float, min_fingertips: int) -> Floats:
    """The reward of one control step ``(...)`` [rad/s] (thesis, chapter 3, eq. reward).

    r = min(r_max, w . k) where at least ``min_fingertips`` and nothing but fingertips touch and
    the tilt is at most phi_max; min(0, w . k) elsewhere. The equation leaves "nothing but
    fingertips" to its text.
    """
    good = (
        (turning.fingertips >= min_fingertips)
        & turning.fingertips_only
        & (turning.tilt <= max_tilt)
    )
    return np.where(good, np.minimum(turning.speed, max_reward), np.minimum(turning.speed, 0.0))


def tilt(quaternion: Floats, upright: Floats, axis: Floats) -> Floats:
    """Angle ``(...)`` [rad] between ``axis`` and the body axis that lies along it when upright.

    Args:
        quaternion: of the object now, wxyz ``(..., 4)``.
        upright: of the object in its settled grasp, ``(..., 4)``.
        axis: unit vector ``(3,)``.
    """
    relative = multiply(quaternion, inverse(upright))
    now = rotate(relative, np.broadcast_to(axis, (*relative.shape[:-1], 3)))
    return np.arccos(np.clip(now @ axis, -1.0, 1.0))


def twist_angle(quaternion: Floats, axis: Floats) -> Floats:
    """The turn about ``axis`` ``(...)`` [rad], in [-2 pi, 2 pi].

    It is the twist of the swing-twist decomposition, so that tilting alone does not count.
    """
    return 2.0 * np.arctan2(quaternion[..., 1:] @ axis, quaternion[..., 0])


def shortest(angle: Floats) -> Floats:
    """``angle`` ``(...)`` [rad] as the shortest turn that ends in the same place, [-pi, pi)."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi
