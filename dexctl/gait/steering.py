"""GoalSteering: brings an object to a goal orientation through who turns it as told."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from dexctl.controller import BatchController, Controller, check_parts
from dexctl.exceptions import InvalidInput
from dexctl.gait.goal import GoalGait, shortened
from dexctl.hand import HandModel
from dexctl.rotations import inverse, multiply, rotation_vector
from dexctl.saved import batch_shape, check_names, copies, fill
from dexctl.state import Floats, GraspState
from dexctl.validation import check_mask, check_numbers, unit_quaternion, with_changes


@dataclass(frozen=True, kw_only=True)
class GoalSteeringConfig:
    """Settings of `GoalSteering`."""

    gain: float = 2.0
    """Angular velocity that is asked for with each radian that is left [1/s], ..."""
    speed: float = 0.5
    """... and at most [rad/s]."""
    grasp_angle: float = 0.45
    """When less than this is left it is made good in the grasp, by a `GoalGait`, until half as much
    again is left [rad]."""
    goal: tuple[float, float, float, float] | None = None
    """Orientation that the object is to have, wxyz, where the state has none of its own."""

    def __post_init__(self) -> None:
        check_numbers(self, positive=("gain", "speed"), not_negative=("grasp_angle",))
        if self.goal is not None:
            unit_quaternion("goal", self.goal)


class GoalSteeringChanges(TypedDict, total=False):
    """`GoalSteeringConfig`'s fields as keywords, for type checkers."""

    gain: float
    speed: float
    grasp_angle: float
    goal: tuple[float, float, float, float] | None


class GoalSteering(BatchController):
    """Has the object turned the shortest way to its goal, by a controller that is told an axis.

    The thesis (chapter 3, hand-centric decomposition) reorients an object by controllers for
    single axes in sequence. One that turns about any axis that it is told
    (``goal_angular_velocity``), such as a policy trained with commands, needs no decomposition: it
    is asked for the rotation vector that is left, times a gain; what such a one leaves can be made
    good in the grasp. Where the state has no goal, the other controller is asked as it is.

    Args:
        hand: the hand.
        config: the settings; None: `GoalSteeringConfig`'s own. Keyword arguments change single
            ones.
        turner: who turns the object; None: a `GoalGait`.
        control_period: of that one [s].
        axis: of that one's gait, ``(3,)``.

    Raises:
        InvalidInput: a setting is wrong, or the turner is no controller of this hand and period.
    """

    def __init__(
        self,
        hand: HandModel,
        config: GoalSteeringConfig | None = None,
        *,
        turner: Controller | None = None,
        control_period: float = 0.05,
        axis: ArrayLike | None = None,
        **changes: Unpack[GoalSteeringChanges],
    ) -> None:
        if turner is None:
            turner = GoalGait(hand, control_period=control_period, axis=axis)
        super().__init__(hand, control_period=control_period)
        check_parts(hand, {"turner": turner}, control_period)
        self.config = with_changes(GoalSteeringConfig, config, changes)
        self.turner, self.tracks = turner, turner.tracks
        self.object, self.gravity = turner.object, turner.gravity
        self.grasp = GoalGait(hand, control_period=turner.control_period, axis=axis)
        self._start(0)

    def _start(self, count: int) -> None:
        self._met, self._grasped = np.zeros(count, bool), np.zeros(count, bool)
        self._place = np.zeros((count, 3))

    def _arrays(self) -> dict[str, np.ndarray]:
        return {"met": self._met, "grasped": self._grasped, "place": self._place}

    def reset(self, seed: ArrayLike | None = None, mask: ArrayLike | None = None) -> None:
        self.turner.reset(seed, mask)
        self.grasp.reset(seed, mask)
        if mask is None or not len(self._met):
            self._start(0)
        else:
            chosen = check_mask(mask, self._met.shape)
            self._met, self._grasped = self._met & ~chosen, self._grasped & ~chosen

    def state_dict(self) -> dict[str, Any]:
        parts = {"turner": self.turner.state_dict(), "grasp": self.grasp.state_dict()}
        return self._signed(**parts, steering=copies(self._arrays()))

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        parts, own = self._parts(saved, "turner", "grasp", "steering"), type(self).__name__
        check_names(own, parts["steering"], self._arrays())
        (count,) = batch_shape(own, parts["steering"], "met") or (0,)
        self.turner.load_state_dict(parts["turner"])
        self.grasp.load_state_dict(parts["grasp"])
        self._start(count)
        fill(own, self._arrays(), parts["steering"])

    def act_batch(self, state: GraspState) -> Floats:
        goal, now, place = state.goal_quaternion, state.object_quaternion, state.object_position
        if goal is None and self.config.goal is not None:
            goal = np.tile(self.config.goal, (len(state.q), 1))
        if goal is None:
            action = self.turner.act(state)
            self._diagnostics = {**self.turner.diagnostics, "left": np.zeros(len(state.q))}
            return action
        if now is None or place is None:
            raise InvalidInput(
                "the state has a goal and no pose of the object; expected a tracked object"
            )
        if len(self._met) != len(now):
            self._start(len(now))
        self._place = np.where(self._met[:, None], self._place, place)
        self._met = np.ones_like(self._met)
        vector = rotation_vector(multiply(goal, inverse(now)))
        left = np.linalg.norm(vector, axis=1)
        spin = shortened(self.config.gain * vector, self.config.speed)
        asked = replace(state, goal_quaternion=None, goal_angular_velocity=spin)
        action = self.turner.act(asked)
        self._diagnostics = {**self.turner.diagnostics, "left": left}
        if self.config.grasp_angle > 0:
            most = self.config.grasp_angle * np.where(self._grasped, 1.5, 1.0)  # not to and fro
            before, self._grasped = self._grasped, left < most
            if (self._grasped & ~before).any():
                self.grasp.reset(None, self._grasped & ~before)
            self.grasp.refer_to(self._place, goal)
            wanted = replace(state, goal_quaternion=goal, goal_angular_velocity=None)
            action = np.where(self._grasped[:, None], self.grasp.act(wanted), action)
        return action
