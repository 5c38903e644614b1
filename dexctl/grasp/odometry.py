"""ContactOdometry: where a held object has got to, from the fingers that hold it alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from dexctl.configuration import HandConfiguration
from dexctl.enclosing import enclosing_centre
from dexctl.grasp.contacts import grasp_map
from dexctl.grasp.placed import placed
from dexctl.hand import HandModel
from dexctl.rotations import multiply
from dexctl.saved import check_names, copies, fill
from dexctl.state import Bools, Floats, GraspState

_LENGTH = 0.05  # scales rotations to lengths in the least squares [m]
_RIDGE = 1e-3  # keeps it solvable where the contacts leave a direction open
_MIDDLE_RATE = 0.2  # pulls the centre to the middle of the contacts while all fingers touch [1/s]


class ContactOdometry:
    """Dead reckoning of N objects for hands without tracking.

    A fingertip that holds without slipping moves with the object, so the contacts' velocities
    J dq are G^T t for the object's twist t (thesis chapter 4, eq. dqrot, read the other way
    round). The twist is their least-squares solution over the fingers that held before and after
    a control period, and is summed up. Slip makes the pose drift.

    Attributes:
        position: ``(N, 3)`` [m].
        quaternion: wxyz, ``(N, 4)``; relative to the start where that was not told.
    """

    def __init__(self, hand: HandModel, control_period: float) -> None:
        self._hand = hand
        self._dt = control_period
        self.start(0)

    def start(self, count: int) -> None:
        """Nothing known, for ``count`` hands."""
        self.position = np.zeros((count, 3))
        self.quaternion = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
        self._q = np.zeros((count, self._hand.nq))
        self._holding = np.zeros((count, self._hand.n_fingers), bool)
        self._point = np.zeros((count, self._hand.n_fingers, 3))
        self._jacobian: Floats | None = None
        self._placed: Bools = np.zeros(count, bool)
        self._following = False

    def forget(self, rows: Bools) -> None:
        """`track` is to place the objects in ``rows`` ``(N,)`` anew."""
        self._placed = self._placed & ~rows
        self._following = False

    def track(self, state: GraspState, now: HandConfiguration, holding: Bools) -> GraspState:
        """``state`` ``(N,)``, which tracks no object, with their poses by dead reckoning.

        Objects met for the first time are at the centre of the smallest ball around the contacts,
        which a side with more fingers does not draw to itself; without any touch the
        fingertips themselves stand round the place where an object would be.

        Args:
            state: to be called with it once every control period.
            now: the hand at ``state.q``.
            holding: the fingers on the object, ``(N, m)``.
        """
        new = ~self._placed
        if new.any():
            touch = state.in_contact[new, :, None]
            point = np.where(touch, state.contact_position[new], now.fingertip_position[new])
            chosen = (touch | ~touch.any(axis=1, keepdims=True))[..., 0]
            self.place(new, enclosing_centre(point, chosen))
        self.update(state, now, holding)
        return replace(state, object_position=self.position, object_quaternion=self.quaternion)

    def _arrays(self) -> dict[str, np.ndarray]:
        return {
            "position": self.position,
            "quaternion": self.quaternion,
            "q": self._q,
            "holding": self._holding,
            "point": self._point,
            "placed": self._placed,
        } | ({} if self._jacobian is None else {"jacobian": self._jacobian})

    def state_dict(self) -> dict[str, Any]:
        """Poses and what the next of them follow from, to be given to `load_state_dict`."""
        return {"jacobian": None, **copies(self._arrays())}

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Continue with saved poses of as many hands as there are now.

        Raises:
            InvalidInput: they are none, or of another hand or number of hands.
        """
        self.start(len(self.position))
        check_names("odometry", saved, (*self._arrays(), "jacobian"))
        if saved["jacobian"] is not None:
            self._jacobian = np.zeros(
                (*self._point.shape[:2], self._hand.finger_joints.shape[1], 3)
            )
        fill("odometry", self._arrays(), saved)

    def place(self, rows: Bools, position: Floats, quaternion: Floats | None = None) -> None:
        """The objects in ``rows`` are there, whatever happened before.

        Args:
            rows: ``(N,)`` bool, K of them true.
            position: ``(K, 3)`` [m], or one ``(3,)`` for all.
            quaternion: wxyz, ``(K, 4)``, or one ``(4,)`` for all; None: what follows is relative
                to how they are turned now.

        Raises:
            InvalidInput: wrong shapes, numbers not finite, or no unit quaternions.
        """
        turned = np.array([1.0, 0.0, 0.0, 0.0]) if quaternion is None else quaternion
        chosen, place, turn = placed(rows, len(self._placed), position, turned)
        self.position[chosen], self.quaternion[chosen] = place, turn
        self._holding = self._holding & ~chosen[:, None]
        self._placed = self._placed | chosen
        self._following = False

    def follow(self, position: Floats, quaternion: Floats | None) -> None:
        """Something tracks the objects: go on from there when it no longer does."""
        self.position = np.array(position)  # the caller may write the next pose into its own
        if quaternion is not None:
            self.quaternion = np.array(quaternion)
        if not self._following:  # a control step does this each time: it must cost nothing
            self._holding = np.zeros_like(self._holding)
            self._placed = np.ones_like(self._placed)
            self._following = True

    def update(self, state: GraspState, now: HandConfiguration, holding: Bools) -> None:
        """Take in one control period; ``holding`` ``(N, m)`` are the fingers on the object."""
        self._following = False
        point = np.where(holding[..., None], state.contact_position, now.fingertip_position)
        both = holding & self._holding
        if self._jacobian is not None and both.any():
            moved = (state.q - self._q)[:, self._hand.finger_joints]
            motion = (moved[:, :, None, :] @ self._jacobian)[:, :, 0]
            self._move(self._point, motion, both)
        whole = holding.all(axis=1, keepdims=True)
        if whole.any():
            pull = _MIDDLE_RATE * self._dt * (enclosing_centre(point) - self.position)
            self.position = self.position + np.where(whole, pull, 0.0)
        self._q, self._holding, self._point = state.q.copy(), holding, point
        self._jacobian = now.finger_jacobian(point)

    def _move(self, point: Floats, motion: Floats, holding: Bools) -> None:
        """Move the objects as their contacts ``(N, m, 3)`` moved, in the least-squares sense."""
        transmission = grasp_map(point, self.position, holding)
        transmission[:, 3:] /= _LENGTH
        gram = transmission @ transmission.swapaxes(-1, -2) + _RIDGE * np.eye(6)
        right = transmission @ motion.reshape(len(motion), -1, 1)
        twist = np.linalg.solve(gram, right)[..., 0]
        twist = np.where(holding.sum(axis=1, keepdims=True) >= 3, twist, 0.0)
        self.position = self.position + twist[:, :3]
        half = 0.5 * twist[:, 3:] / _LENGTH
        turned = multiply(np.concatenate([np.ones((len(half), 1)), half], axis=1), self.quaternion)
        self.quaternion = turned / np.linalg.norm(turned, axis=1, keepdims=True)
