"""Reckoning: where objects are that nothing tracks, from their start and what is felt since."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from dexctl.configuration import HandConfiguration
from dexctl.grasp.odometry import ContactOdometry
from dexctl.grasp.touch_tracking import TouchTracking
from dexctl.hand import HandModel
from dexctl.sim.scene import Scene
from dexctl.sim.shapes import Shape
from dexctl.state import Bools, Floats, GraspState


class Follower(Protocol):
    """Who follows objects by touch: `ContactOdometry`, `TouchTracking`."""

    position: Floats
    quaternion: Floats

    def place(self, rows: Bools, position: Floats, quaternion: Floats) -> None: ...

    def update(self, state: GraspState, now: HandConfiguration, holding: Bools) -> None: ...

    def state_dict(self) -> dict[str, Any]: ...

    def load_state_dict(self, saved: Mapping[str, Any]) -> None: ...


class Reckoning:
    """Poses of N objects that nothing tracks, known where an episode begins.

    Args:
        hand: the hand.
        groups: the scenes, and how many of the N there are of each.
        control_period: [s].
        shapes_known: whether the objects' shapes are, as the scenes have them.
    """

    def __init__(
        self,
        hand: HandModel,
        groups: Sequence[tuple[Scene, int]],
        control_period: float,
        *,
        shapes_known: bool,
    ) -> None:
        self._hand = hand
        self._follower: Follower
        if shapes_known:
            shapes = [
                shape
                for scene, count in groups
                for shape in count * [Shape.of_body(scene.model, scene.object_body)]
            ]
            self._follower = TouchTracking(hand, shapes, control_period=control_period)
        else:
            self._follower = ContactOdometry(hand, control_period)
            self._follower.start(sum(count for _, count in groups))

    @property
    def position(self) -> Floats:
        """Where the objects are by now, ``(N, 3)`` [m]."""
        return self._follower.position

    def __call__(self, seen: GraspState, begin: Bools | None) -> GraspState:
        """``seen`` ``(N,)`` with the poses that follow from what is felt.

        Args:
            seen: what is sensed, with the true pose, which is read where an episode begins only.
            begin: None where a control step has passed in every environment; else those ``(N,)``
                whose episode begins. Nothing changes in the others.
        """
        follower = self._follower
        if begin is None:
            follower.update(seen, self._hand.configuration(seen.q), seen.in_contact)
        else:
            before = follower.state_dict()
            self._begin(seen, begin)
            after = follower.state_dict()
            follower.load_state_dict(
                {
                    name: value if before[name] is None else _where(begin, value, before[name])
                    for name, value in after.items()
                }
            )
        pose = follower.position.copy(), follower.quaternion.copy()
        return replace(seen, object_position=pose[0], object_quaternion=pose[1])

    def _begin(self, seen: GraspState, begin: Bools) -> None:
        assert seen.object_position is not None
        assert seen.object_quaternion is not None
        follower = self._follower
        position, quaternion = seen.object_position[begin], seen.object_quaternion[begin]
        follower.place(begin, position, quaternion)
        follower.update(seen, self._hand.configuration(seen.q), seen.in_contact)
        # which are known exactly
        follower.position[begin], follower.quaternion[begin] = position, quaternion

    def save(self) -> dict[str, Any]:
        """All that decides what is to come, to be given to `restore`."""
        return self._follower.state_dict()

    def restore(self, saved: dict[str, Any]) -> None:
        """Go on from what `save` returned."""
        self._follower.load_state_dict(saved)


def _where(rows: Bools, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.where(rows.reshape(-1, *(1,) * (one.ndim - 1)), one, other)
