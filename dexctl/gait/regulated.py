"""RegulatedTurning: another controller's turning, with the object kept where it was."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from dexctl.controller import BatchController, Controller, axis_of, check_parts
from dexctl.exceptions import InvalidInput
from dexctl.hand import HandModel
from dexctl.igm import InGraspManipulation, InGraspManipulationConfig, Share
from dexctl.state import Floats, GraspState
from dexctl.validation import check_numbers, with_changes


@dataclass(frozen=True, kw_only=True)
class RegulatedTurningConfig:
    """Settings of `RegulatedTurning`."""

    height_gain: float = 0.5
    """Pulls the object back, along the axis that it is turned about, to where it was at the first
    call after a reset [1/s]."""
    centring_gain: float = 0.5
    """Pulls it back across the axis [1/s]."""
    tilt_gain: float = 0.0
    """Turns the object's axis back to where it was then [1/s]; policies level most objects
    themselves, and it costs round ones and long ones more than it helps others."""

    def __post_init__(self) -> None:
        check_numbers(self, not_negative=("height_gain", "centring_gain", "tilt_gain"))


class RegulatedTurningChanges(TypedDict, total=False):
    """`RegulatedTurningConfig`'s fields as keywords, for type checkers."""

    height_gain: float
    centring_gain: float
    tilt_gain: float


class RegulatedTurning(BatchController):
    """Superposes another controller and in-grasp manipulation's regulation of the object's pose.

    A policy that feels contacts and does not see the object lets it wander until it is lost. Here
    the fingers that touch also move as they have to for the object to come back: height, place
    across the axis and, if that is asked for, tilt, each by a gain (thesis chapter 4, eq. dqrot,
    with the twist of a proportional regulation). That part turns nothing and controls no force, so
    the other controller goes on with its gait. The object has to be tracked: reckoned from fingers
    that another controller lifts, its pose is soon further off than the object.

    Args:
        hand: the hand.
        config: the settings; None: `RegulatedTurningConfig`'s own. Keyword arguments change single
            ones.
        turner: who turns the object, with an attribute ``axis``, ``(3,)``: a policy that was
            trained for one axis, a gait.

    Raises:
        InvalidInput: a setting is wrong, or the turner is no controller of this hand, or turns
            about no axis of its own.
    """

    tracks = True

    def __init__(
        self,
        hand: HandModel,
        config: RegulatedTurningConfig | None = None,
        *,
        turner: Controller,
        **changes: Unpack[RegulatedTurningChanges],
    ) -> None:
        period = check_parts(hand, {"turner": turner})
        super().__init__(hand, control_period=period)
        self.config = config = with_changes(RegulatedTurningConfig, config, changes)
        self.turner, self.object, self.gravity = turner, turner.object, turner.gravity
        self.axis = axis_of(turner)
        self.in_grasp = InGraspManipulation(
            hand,
            InGraspManipulationConfig(
                stability_gain=0.0,
                closing_speed=0.0,
                reach_distance=0.0,
                odometry=False,  # it is tracked
                height_gain=config.height_gain,
                centring_gain=config.centring_gain,
                tilt_gain=config.tilt_gain,
            ),
            control_period=period,
            axis=self.axis,
        )

    def reset(self, seed: ArrayLike | None = None, mask: ArrayLike | None = None) -> None:
        self.turner.reset(seed, mask)
        self.in_grasp.reset(seed, mask)

    def state_dict(self) -> dict[str, Any]:
        return self._signed(turner=self.turner.state_dict(), in_grasp=self.in_grasp.state_dict())

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        parts = self._parts(saved, "turner", "in_grasp")
        self.turner.load_state_dict(parts["turner"])
        self.in_grasp.load_state_dict(parts["in_grasp"])

    def act_batch(self, state: GraspState) -> Floats:
        levels = self.config.tilt_gain > 0
        if state.object_position is None or (levels and state.object_quaternion is None):
            raise InvalidInput("the state has no pose of the object; expected a tracked object")
        action = self.turner.act(state)
        # as if the set-points were there already: so the lead of both together is limited
        moved = replace(state, q_target=state.q_target + action)
        still = Share(twist=np.zeros((len(state.q), 6)))
        change = self.in_grasp.command(moved, still)
        self._diagnostics = {**self.turner.diagnostics, "regulation": change}
        return action + change
