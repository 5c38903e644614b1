"""GoalGait: brings an object to a goal orientation, about one axis after the other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from dexctl.controller import BatchController
from dexctl.exceptions import InvalidInput
from dexctl.gait.coordinated import CoordinatedGait, CoordinatedGaitConfig
from dexctl.hand import HandModel
from dexctl.rotations import (
    from_rotation_vector,
    inverse,
    multiply,
    rotation_vector,
    shortest,
    twist_angle,
)
from dexctl.saved import batch_shape, check_names, copies, fill
from dexctl.state import Floats, GraspState
from dexctl.switch.landing import split
from dexctl.validation import (
    check_kind,
    check_mask,
    check_numbers,
    numbers,
    unit_quaternion,
    with_changes,
)


@dataclass(frozen=True, kw_only=True)
class GoalGaitConfig:
    """Settings of `GoalGait`."""

    gait: CoordinatedGaitConfig = field(default_factory=CoordinatedGaitConfig)
    """Of the gait, whose axis and speed are those of the turns that need new grasps."""
    goal: tuple[float, float, float, float] | None = None
    """Orientation that the object is to have, wxyz, where the state has none of its own."""
    gain: float = 1.5
    """Angular velocity about the gait's axis for each radian that is left [1/s]."""
    tilt_lead: float = 0.3
    """In-grasp manipulation tilts the object towards a pose that is at most so far ahead [rad]."""
    most_tilt: float = 0.4
    """The object is tilted no further than this from where it was at the reset [rad]; goals beyond
    are approached so far."""
    align_angle: float = 0.05
    """It is tilted when less than this is left to turn about the gait's axis [rad], ..."""
    turn_angle: float = 0.15
    """... and turned about that again from so much on [rad]; what is left below it stays, so it has
    to be less than what goals are to be reached within."""

    def __post_init__(self) -> None:
        check_kind(self, gait=CoordinatedGaitConfig)
        check_numbers(
            self,
            positive=("gain", "tilt_lead", "align_angle", "turn_angle"),
            not_negative=("most_tilt",),
        )
        if self.align_angle > self.turn_angle:
            raise InvalidInput(
                f"align_angle is {self.align_angle} and turn_angle {self.turn_angle}; expected the "
                "first to be no greater"
            )
        if self.goal is not None:
            unit_quaternion("goal", self.goal)

    @classmethod
    def suiting(cls, hand: HandModel) -> GoalGaitConfig:
        """What suits a hand: its gait's settings."""
        return cls(gait=CoordinatedGaitConfig.suiting(hand))

    def about(self, axis: object) -> GoalGaitConfig:
        """The same with a gait about ``axis`` ``(3,)``, of any length, at the same speed."""
        return replace(self, gait=self.gait.about(axis))


class GoalGaitChanges(TypedDict, total=False):
    """`GoalGaitConfig`'s fields as keywords, for type checkers."""

    gait: CoordinatedGaitConfig
    goal: tuple[float, float, float, float] | None
    gain: float
    tilt_lead: float
    most_tilt: float
    align_angle: float
    turn_angle: float


class GoalGait(BatchController):
    """Turns the object about the gait's axis first, then tilts it in the grasp.

    The thesis (chapter 3, hand-centric decomposition) reorients an object by axis-specific
    controllers in sequence. What is left, R, is split into a turn about the gait's axis and a
    tilt (swing-twist decomposition). The first is the coordinated gait's, either way
    round and without end, with the object brought upright meanwhile; the second is in-grasp
    manipulation's, as far as the fingers reach: a goal that is tilted further than that is not
    reached. Then it is held there.

    A state with a `goal_angular_velocity` and no goal orientation is turned so: about the gait's
    axis without end, across it as far as the fingers reach. One that has neither is turned as the
    gait turns it.

    Args:
        hand: the hand.
        config: the settings; None: `GoalGaitConfig.suiting` the hand. Keyword arguments change
            single ones.
        control_period: [s].
        axis: of the gait, ``(3,)``; None keeps that of the settings.
    """

    def __init__(
        self,
        hand: HandModel,
        config: GoalGaitConfig | None = None,
        *,
        control_period: float = 0.05,
        axis: ArrayLike | None = None,
        **changes: Unpack[GoalGaitChanges],
    ) -> None:
        super().__init__(hand, control_period=control_period)
        config = GoalGaitConfig.suiting(hand) if config is None else config
        self.config = with_changes(GoalGaitConfig, config, changes, axis)
        self.gait = CoordinatedGait(hand, self.config.gait, control_period=control_period)
        self._speed = float(np.linalg.norm(self.config.gait.in_grasp.twist[3:]))
        self._start(0)

    def _start(self, count: int) -> None:
        self._upright, self._place = np.zeros((count, 4)), np.zeros((count, 3))
        self._way = np.ones(count)
        self._known = np.zeros(count, bool)
        self._turning = np.zeros(count, bool)

    def reset(self, seed: ArrayLike | None = None, mask: ArrayLike | None = None) -> None:
        self.gait.reset(seed, mask)
        if mask is None or not len(self._known):
            self._start(0)
        else:
            chosen = check_mask(mask, self._known.shape)
            self._known, self._turning = self._known & ~chosen, self._turning & ~chosen

    def _arrays(self) -> dict[str, np.ndarray]:
        return {
            "upright": self._upright,
            "place": self._place,
            "way": self._way,
            "known": self._known,
            "turning": self._turning,
        }

    def state_dict(self) -> dict[str, Any]:
        return self._signed(gait=self.gait.state_dict(), goal=copies(self._arrays()))

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        parts = self._parts(saved, "gait", "goal")
        own = type(self).__name__
        check_names(own, parts["goal"], self._arrays())
        (count,) = batch_shape(own, parts["goal"], "known") or (0,)
        self.gait.load_state_dict(parts["gait"])
        self._start(count)
        fill(own, self._arrays(), parts["goal"])

    def act_batch(self, state: GraspState) -> Floats:
        goal, spin = state.goal_quaternion, state.goal_angular_velocity
        if goal is None and self.config.goal is not None:
            goal = np.tile(self.config.goal, (len(state.q), 1))
        if goal is None and spin is None:
            action = self.gait.command(state)
            self._diagnostics = dict(self.gait.diagnostics)
            return action
        now, place = state.object_quaternion, state.object_position
        if now is None or place is None:
            raise InvalidInput(
                "the state has a goal and no pose of the object; expected a tracked object"
            )
        self._meet(now, place)
        axis, config = self.gait.axis, self.config
        upright = split_turn(multiply(self._upright, inverse(now)), axis)[0]
        if goal is not None:
            tilt, turn = self._towards(goal, now)
            # the gait needs the object upright
            tilt = np.where(self._turning[:, None], 0.0, tilt - upright)
        else:
            assert spin is not None
            turn, across = split(spin, axis)
            # as far ahead as the grasp's regulation comes in a second, at its gain
            ahead = across / max(config.gait.in_grasp.tilt_gain, 1e-9)
            tilt = np.where(across.any(axis=1, keepdims=True), ahead - upright, 0.0)
        step = shortened(upright + shortened(tilt, config.most_tilt), config.tilt_lead)
        self.gait.in_grasp.refer_to(self._place, multiply(from_rotation_vector(step), now))
        twist = np.zeros((len(now), 6))
        twist[:, 3:] = turn[:, None] * axis
        action = self.gait.command(state, twist)
        self._diagnostics = {**self.gait.diagnostics, "turn": turn, "tilt": step}
        return action

    def refer_to(self, position: Floats, quaternion: Floats) -> None:
        """Take these as the objects' upright poses, in place of those at the reset.

        Args:
            position: ``(N, 3)`` [m].
            quaternion: wxyz ``(N, 4)``.

        Raises:
            InvalidInput: they are not of so many hands.
        """
        place = numbers("position", position, "(N, 3) [m]")
        upright = numbers("quaternion", quaternion, "(N, 4), wxyz")
        if place.ndim != 2 or place.shape[1] != 3 or upright.shape != (len(place), 4):
            raise InvalidInput(
                f"position and quaternion have shapes {place.shape} and {upright.shape}; expected "
                "(N, 3) and (N, 4)"
            )
        if len(self._known) != len(place):
            self._start(len(place))
        self._place, self._upright = place.copy(), upright.copy()
        self._known = np.ones_like(self._known)

    def _meet(self, now: Floats, place: Floats) -> None:
        """Take as upright the poses of objects that are met for the first time since the reset."""
        if len(self._known) != len(now):
            self._start(len(now))
        if not self._known.all():
            self._upright = np.where(self._known[:, None], self._upright, now)
            self._place = np.where(self._known[:, None], self._place, place)
            self._known = np.ones_like(self._known)

    def _towards(self, goal: Floats, now: Floats) -> tuple[Floats, Floats]:
        """The tilt that is left ``(N, 3)`` [rad], and the speed about the gait's axis [rad/s]."""
        config = self.config
        tilt, angle = split_turn(multiply(goal, inverse(now)), self.gait.axis)
        # half a turn away, either way is as good: go on the way that was begun
        back = self._turning & (np.abs(angle) > np.pi - _HALF_TURN) & (angle * self._way < 0)
        angle = np.where(back, angle + 2.0 * np.pi * self._way, angle)
        self._way = np.where(angle < 0, -1.0, 1.0)
        least = np.where(self._turning, config.align_angle, config.turn_angle)
        self._turning = np.abs(angle) > least
        # what is little is left: a turn that went to and fro would have fingers step to and fro
        turn = self._turning * np.clip(config.gain * angle, -self._speed, self._speed)
        return tilt, turn


_HALF_TURN = 0.3  # how near to half a turn is half a turn [rad]


def shortened(vector: Floats, most: float) -> Floats:
    """``vector`` ``(..., 3)``, no longer than ``most``."""
    length = np.sqrt((vector * vector).sum(axis=-1, keepdims=True))
    return vector * np.minimum(1.0, most / np.maximum(length, 1e-12))


def split_turn(turn: Floats, axis: Floats) -> tuple[Floats, Floats]:
    """A turn as a tilt and a turn about ``axis`` after it (swing-twist decomposition).

    So that the tilt can be made wherever the turn about the axis has got to.

    Args:
        turn: wxyz ``(..., 4)``.
        axis: unit ``(3,)``.

    Returns:
        The tilt as a rotation vector across ``axis`` ``(..., 3)`` [rad], and the angle about
        ``axis`` ``(...)`` [rad], in [-pi, pi).
    """
    angle = shortest(twist_angle(turn, axis))
    about = from_rotation_vector(angle[..., None] * axis)
    return rotation_vector(multiply(inverse(about), turn)), angle
