"""Sensor noise: what is observed of a state that is known as it is."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dexctl.state import Bools, GraspState
from dexctl.streams import Streams
from dexctl.validation import check_numbers


@dataclass(frozen=True, kw_only=True)
class SensorNoise:
    """Standard deviations of white noise on joints and touch. Set-points are known exactly.

    Attributes:
        joint: of joint positions [rad].
        position: of each coordinate of contact points [m].
        normal: of each coordinate of unit normals, before they are made unit again.
        force: of normal forces, as a share of the force; forces do not fall below zero.

    Raises:
        InvalidInput: a number that is not finite, or below zero.
    """

    joint: float = 0.0
    position: float = 0.0
    normal: float = 0.0
    force: float = 0.0

    def __post_init__(self) -> None:
        check_numbers(self, not_negative=("joint", "position", "normal", "force"))

    def __bool__(self) -> bool:
        return max(self.joint, self.position, self.normal, self.force) > 0


def observed(
    state: GraspState, noise: SensorNoise, streams: Streams, mask: Bools | None = None
) -> GraspState:
    """``state`` ``(N,)`` with noise on it.

    Each environment has its own random stream; only those in ``mask`` move on, and the numbers of
    the others are to be thrown away.
    """
    if not noise:
        return state
    count, d = state.q.shape
    m = state.in_contact.shape[1]
    drawn = streams.normal((d + 7 * m,), mask)
    joints, fingers = drawn[:, :d], drawn[:, d:].reshape(count, m, 7)
    touch = state.in_contact[..., None]
    normal = state.contact_normal + noise.normal * fingers[..., 3:6]
    length = np.sqrt((normal * normal).sum(axis=-1, keepdims=True))
    normal = normal / np.maximum(length, 1e-12)
    position = state.contact_position + noise.position * fingers[..., :3]
    return replace(
        state,
        q=state.q + noise.joint * joints,
        contact_position=np.where(touch, position, 0.0),
        contact_normal=np.where(touch, normal, 0.0),
        contact_force=state.contact_force * np.maximum(1.0 + noise.force * fingers[..., 6], 0.0),
    )
