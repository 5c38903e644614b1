"""TrackedByTouch: another controller, told the object's pose by touch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dexctl.controller import BatchController, Controller, check_parts
from dexctl.grasp.touch_tracking import Surface, TouchTracking, TouchTrackingConfig
from dexctl.hand import HandModel
from dexctl.saved import batch_shape, check_names, copies, fill
from dexctl.state import Floats, GraspState
from dexctl.validation import check_mask, check_vector, unit_quaternion


class TrackedByTouch(BatchController):
    """Has another controller act as if something tracked the object, whose shape is known.

    For hands without a camera: from where the object is when an episode begins, its pose is what
    `TouchTracking` makes of the contacts. A pose that the state has is not looked at.

    Args:
        hand: the hand.
        controller: who acts.
        surface: of the object, such as a `dexctl.sim.Shape`.
        position, quaternion: where the object is at the first call after a reset, ``(3,)`` [m] and
            wxyz ``(4,)``.
        goal: orientation that the object is wanted in, wxyz ``(4,)``, where a state tells none;
            None: no goal.
        config: settings of the tracking; None: `TouchTrackingConfig`'s own.

    Attributes:
        tracking: the filter.
        goal: as given.

    Raises:
        InvalidInput: a setting is wrong, or the controller is none of this hand.
    """

    def __init__(
        self,
        hand: HandModel,
        controller: Controller,
        surface: Surface,
        *,
        position: ArrayLike,
        quaternion: ArrayLike = (1.0, 0.0, 0.0, 0.0),
        goal: ArrayLike | None = None,
        config: TouchTrackingConfig | None = None,
    ) -> None:
        period = check_parts(hand, {"the controller": controller})
        super().__init__(hand, control_period=period)
        self.controller = controller
        self.object, self.gravity = controller.object, controller.gravity
        self.tracking = TouchTracking(hand, surface, config, control_period=period)
        self._position = check_vector("position", position, 3, "three finite numbers [m]")
        self._quaternion = unit_quaternion("quaternion", quaternion)
        self.goal = None if goal is None else unit_quaternion("goal", goal)
        self._start(0)

    def _start(self, count: int) -> None:
        self.tracking.start(count)
        self._placed = np.zeros(count, bool)

    def reset(self, seed: ArrayLike | None = None, mask: ArrayLike | None = None) -> None:
        self.controller.reset(seed, mask)
        if mask is None or not len(self._placed):
            self._start(0)
        else:
            self._placed = self._placed & ~check_mask(mask, self._placed.shape)

    def state_dict(self) -> dict[str, Any]:
        return self._signed(
            acting=self.controller.state_dict(),
            tracking=self.tracking.state_dict(),
            placed=copies({"placed": self._placed}),
        )

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        parts, own = self._parts(saved, "acting", "tracking", "placed"), type(self).__name__
        check_names(own, parts["placed"], ("placed",))
        (count,) = batch_shape(own, parts["placed"], "placed") or (0,)
        self.controller.load_state_dict(parts["acting"])
        self._start(count)
        self.tracking.load_state_dict(parts["tracking"])
        fill(own, {"placed": self._placed}, parts["placed"])

    def act_batch(self, state: GraspState) -> Floats:
        if len(self._placed) != len(state.q):
            self._start(len(state.q))
        new = ~self._placed
        if new.any():
            self.tracking.place(new, self._position, self._quaternion)
            self._placed = np.ones_like(self._placed)
        tracked = self.tracking.track(state)
        if tracked.goal_quaternion is None and self.goal is not None:
            tracked = replace(tracked, goal_quaternion=np.tile(self.goal, (len(state.q), 1)))
        action = self.controller.act(tracked)
        self._diagnostics = {
            **self.controller.diagnostics,
            "tracked_position": tracked.object_position,
            "tracked_quaternion": tracked.object_quaternion,
        }
        return action
