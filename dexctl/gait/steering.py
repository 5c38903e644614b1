"""GoalSteering: brings an object to a goal orientation through who turns it as told."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from dexctl.controller import Controller, check_sound, check_state
from dexctl.exceptions import InvalidInput
from dexctl.gait.goal import GoalGait, shortened
from dexctl.hand import HandModel
from dexctl.rotations import inverse, multiply, rotation_vector
from dexctl.state import Floats, GraspState
from dexctl.validation import check_numbers, unit_quaternion, with_changes


@dataclass(frozen=True, kw_only=True)
class GoalSteeringConfig:
    """Settings of `GoalSteering`."""

    gain: float = 2.0
    """Angular velocity that is asked for with each radian that is left [1/s], ..."""
    speed: float = 0.5
    """... and at most [rad/s]."""
    goal: tuple[float, float, float, float] | None = None
    """Orientation that the object is to have, wxyz, where the state has none of its own."""

    def __post_init__(self) -> None:
        check_numbers(self, positive=("gain", "speed"))
        if self.goal is not None:
            unit_quaternion("goal", self.goal)


class GoalSteeringChanges(TypedDict, total=False):
    """`GoalSteeringConfig`'s fields as keywords, for type checkers."""

    gain: float
    speed: float
    goal: tuple[float, float, float, float] | None


class GoalSteering(Controller):
    """Has the object turned the shortest way to its goal, by a controller that is told an axis.

    The thesis (chapter 3, hand-centric decomposition) reorients an object by controllers for
    single axes in sequence. One that turns about any axis that it is told
    (``goal_angular_velocity``), such as a policy trained with commands, needs no decomposition: it
    is asked for the rotation vector that is left, times a gain. Where the state has no goal, the
    other controller is asked as it is.

    Args:
        hand: the hand.
        config: the settings; None: `GoalSteeringConfig`'s own. Keyword arguments change single
            ones.
        turner: who turns the object; None: a `GoalGait`.
        control_period: of that one [s].
        axis: of that one's gait, ``(3,)``.

    Raises:
        InvalidInput: a setting is wrong, or the turner is no controller.
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
        if not isinstance(turner, Controller):
            raise InvalidInput(f"turner is {turner!r}; expected a Controller")
        super().__init__(hand, control_period=turner.control_period)
        self.config = with_changes(GoalSteeringConfig, config, changes)
        self.turner, self.object = turner, turner.object

    def reset(self, seed: ArrayLike | None = None, mask: ArrayLike | None = None) -> None:
        self.turner.reset(seed, mask)

    def state_dict(self) -> dict[str, Any]:
        return self._signed(turner=self.turner.state_dict())

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        self.turner.load_state_dict(self._parts(saved, "turner")["turner"])

    def act(self, state: GraspState) -> Floats:
        goal = state.goal_quaternion
        if goal is None and self.config.goal is not None:
            goal = np.broadcast_to(self.config.goal, (*state.batch_shape, 4))
        left = np.zeros((*state.batch_shape, 3))
        if goal is not None:
            check_state(self.hand, state)
            check_sound(self.hand, state)
            if state.object_quaternion is None:
                raise InvalidInput(
                    "the state has a goal and no pose of the object; expected a tracked object"
                )
            left = rotation_vector(multiply(goal, inverse(state.object_quaternion)))
            spin = shortened(self.config.gain * left, self.config.speed)
            state = replace(state, goal_quaternion=None, goal_angular_velocity=spin)
        action = self.turner.act(state)
        self._diagnostics = {**self.turner.diagnostics, "left": np.linalg.norm(left, axis=-1)}
        return action
