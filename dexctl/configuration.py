"""HandConfiguration: a hand at one q, from which contact Jacobians are made."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dexctl.state import Floats

if TYPE_CHECKING:
    from dexctl.hand import HandModel

# p @ _SKEW, reshaped to (3, 3), is [p]x; and for a row vector w, w @ [p]x is w x p.
_SKEW = np.zeros((3, 9))
for _row, _col, _axis, _sign in (
    (0, 1, 2, -1), (0, 2, 1, 1), (1, 0, 2, 1), (1, 2, 0, -1), (2, 0, 1, -1), (2, 1, 0, 1),
):  # fmt: skip
    _SKEW[_axis, 3 * _row + _col] = _sign


class HandConfiguration:
    """Forward kinematics at one q, or at a batch of them.

    Attributes:
        hand: the hand.
        fingertip_position: ``(..., m, 3)`` [m], world frame.
        finger_twist: ``(..., m, n, 6)``; row j of finger i is the (linear, angular) velocity that
            joint ``hand.finger_joints[i, j]`` gives, at unit speed, to the point of finger i's
            distal link that is at the world's origin. Rows of fingers with fewer than n joints
            are filled up with zeros.
    """

    __slots__ = ("finger_twist", "fingertip_position", "hand")

    def __init__(self, hand: HandModel, fingertip_position: Floats, finger_twist: Floats) -> None:
        self.hand = hand
        self.fingertip_position = fingertip_position
        self.finger_twist = finger_twist

    @property
    def joint_twist(self) -> Floats:
        """The twists by joint, ``(..., 6, d)``, world frame, taken at the world's origin.

        Of a joint that moves several fingers through couplings, as the first of them sees it.
        """
        hand = self.hand
        out = np.zeros((*self.finger_twist.shape[:-3], 6, hand.nq))
        for finger in reversed(range(hand.n_fingers)):
            count = int(hand.moves[finger].sum())
            joints = hand.finger_joints[finger, :count]
            out[..., joints] = self.finger_twist[..., finger, :count, :].swapaxes(-1, -2)
        return out

    def finger_jacobian(self, point: Floats) -> Floats:
        """Velocities of points ``(..., m, 3)`` on the distal links by the finger's own joints.

        ``(..., m, n, 3)``: row j of finger i is what joint ``hand.finger_joints[i, j]`` does, so
        this is each finger's Jacobian transposed.
        """
        skew = (point @ _SKEW).reshape(*point.shape, 3)
        return self.finger_twist[..., :3] + self.finger_twist[..., 3:] @ skew

    def contact_jacobian(self, point: Floats) -> Floats:
        """Velocities of points ``(..., m, 3)`` fixed on the distal links, ``(..., m, 3, d)``."""
        return self.finger_jacobian(point).swapaxes(-1, -2) @ self.hand.finger_joint_map

    def __getitem__(self, index: Any) -> HandConfiguration:
        """The configuration of some environments of a batch."""
        return HandConfiguration(
            self.hand, self.fingertip_position[index], self.finger_twist[index]
        )
