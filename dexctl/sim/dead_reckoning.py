"""DeadReckoning: where objects are, from where they started and what the fingers feel since."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from dexctl.grasp.odometry import ContactOdometry
from dexctl.hand import HandModel
from dexctl.rotations import multiply
from dexctl.state import Bools, Floats, GraspState


class DeadReckoning:
    """Poses of N objects that nothing tracks; what slips, drifts.

    Args:
        hand: the hand.
        count: N.
        control_period: [s].
    """

    def __init__(self, hand: HandModel, count: int, control_period: float) -> None:
        self._hand = hand
        self._odometry = ContactOdometry(hand, control_period)
        self._odometry.start(count)
        self._start = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))  # orientations

    @property
    def position(self) -> Floats:
        """Where the objects are by now, ``(N, 3)`` [m]."""
        return self._odometry.position

    def __call__(self, seen: GraspState, begin: Bools | None) -> GraspState:
        """``seen`` ``(N,)`` with the poses that follow from what is felt.

        Args:
            seen: what is sensed, with the true pose, which is read where an episode begins only.
            begin: None where a control step has passed in every environment; else those ``(N,)``
                whose episode begins. Nothing changes in the others.
        """
        odometry = self._odometry
        if begin is None:
            odometry.update(seen, self._hand.configuration(seen.q), seen.in_contact)
        else:
            before = odometry.state_dict()
            self._begin(seen, begin)
            after = odometry.state_dict()
            if before["jacobian"] is None:
                before["jacobian"] = np.zeros_like(after["jacobian"])
            odometry.load_state_dict(
                {
                    name: np.where(begin.reshape(-1, *(1,) * (value.ndim - 1)), value, before[name])
                    for name, value in after.items()
                }
            )
        turned = multiply(odometry.quaternion, self._start)
        return replace(seen, object_position=odometry.position, object_quaternion=turned)

    def _begin(self, seen: GraspState, begin: Bools) -> None:
        assert seen.object_position is not None
        assert seen.object_quaternion is not None
        odometry = self._odometry
        self._start = np.where(begin[:, None], seen.object_quaternion, self._start)
        odometry.place(begin, seen.object_position[begin])
        odometry.update(seen, self._hand.configuration(seen.q), seen.in_contact)
        odometry.position[begin] = seen.object_position[begin]  # which is known exactly

    def save(self) -> dict[str, Any]:
        """All that decides what is to come, to be given to `restore`."""
        return {"odometry": self._odometry.state_dict(), "start": self._start.copy()}

    def restore(self, saved: dict[str, Any]) -> None:
        """Go on from what `save` returned."""
        self._odometry.load_state_dict(saved["odometry"])
        self._start = saved["start"].copy()
