"""HandConfiguration: a hand at one q, from which contact Jacobians are made."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dexctl.state import Bools, Floats

# p @ _SKEW, reshaped to (3, 3), is [p]x; and for a row vector w, w @ [p]x is w x p.
_SKEW = np.zeros((3, 9))
for _row, _col, _axis, _sign in (
    (0, 1, 2, -1), (0, 2, 1, 1), (1, 0, 2, 1), (1, 2, 0, -1), (2, 0, 1, -1), (2, 1, 0, 1),
):  # fmt: skip
    _SKEW[_axis, 3 * _row + _col] = _sign


class FingerJoints(NamedTuple):
    """Which of a hand's d joints move which of its m fingers.

    Attributes:
        joints: of each finger, base to tip, ``(m, n)`` int, n the most that one has; rows of
            shorter fingers are filled up with zeros, which `moves` tells from joint 0.
        map: ``(m, n, d)``; one where joint d is the n-th of a finger, else zero.
        moves: which joints move which fingertip, ``(m, d)`` bool.
    """

    joints: NDArray[np.intp]
    map: Floats
    moves: Bools


class HandConfiguration:
    """Forward kinematics at one q, or at a batch of them.

    Attributes:
        fingers: which joints move which finger.
        fingertip_position: ``(..., m, 3)`` [m], world frame.
        finger_twist: ``(..., m, n, 6)``; row j of finger i is the (linear, angular) velocity that
            joint ``fingers.joints[i, j]`` gives, at unit speed, to the point of finger i's
            distal link that is at the world's origin. Rows of fingers with fewer than n joints
            are filled up with zeros.
    """

    __slots__ = ("finger_twist", "fingers", "fingertip_position")

    def __init__(
        self, fingers: FingerJoints, fingertip_position: Floats, finger_twist: Floats
    ) -> None:
        self.fingers = fingers
        self.fingertip_position = fingertip_position
        self.finger_twist = finger_twist

    @property
    def joint_twist(self) -> Floats:
        """The twists by joint, ``(..., 6, d)``, world frame, taken at the world's origin.

        Of a joint that moves several fingers through couplings, as the first of them sees it.
        """
        fingers, joint_count = self.fingers.moves.shape
        out = np.zeros((*self.finger_twist.shape[:-3], 6, joint_count))
        for finger in reversed(range(fingers)):
            count = int(self.fingers.moves[finger].sum())
            joints = self.fingers.joints[finger, :count]
            out[..., joints] = self.finger_twist[..., finger, :count, :].swapaxes(-1, -2)
        return out

    def finger_jacobian(self, point: Floats) -> Floats:
        """Velocities of points ``(..., m, 3)`` on the distal links by the finger's own joints.

        ``(..., m, n, 3)``: row j of finger i is what joint ``fingers.joints[i, j]`` does, so
        this is each finger's Jacobian transposed.
        """
        skew = (point @ _SKEW).reshape(*point.shape, 3)
        return self.finger_twist[..., :3] + self.finger_twist[..., 3:] @ skew

    def contact_jacobian(self, point: Floats) -> Floats:
        """Velocities of points ``(..., m, 3)`` fixed on the distal links, ``(..., m, 3, d)``."""
        return self.finger_jacobian(point).swapaxes(-1, -2) @ self.fingers.map

    def __getitem__(self, index: Any) -> HandConfiguration:
        """The configuration of some environments of a batch."""
        return HandConfiguration(
            self.fingers, self.fingertip_position[index], self.finger_twist[index]
        )
