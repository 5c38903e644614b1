"""GoalSequence: brings an object to a goal by controllers for two axes in sequence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any, NamedTuple, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from dexctl.controller import BatchController, Controller
from dexctl.exceptions import InvalidInput
from dexctl.gait.coordinated import CoordinatedGait
from dexctl.gait.goal import GoalGait, split_turn
from dexctl.hand import HandModel
from dexctl.rotations import from_rotation_vector, inverse, multiply, rotate
from dexctl.saved import batch_shape, check_names, copies, fill
from dexctl.state import Floats, GraspState
from dexctl.validation import check_mask, check_numbers, check_whole, unit_axis, with_changes


class Leg(IntEnum):
    """What is done about the goal now."""

    NONE = -1  # no goal yet
    READY = 0  # turned about the palm's axis, until the turn across it leads to the goal
    ACROSS = 1  # turned across it
    ABOUT = 2  # turned about it, to the goal
    GRASP = 3  # the rest, in the grasp


@dataclass(frozen=True, kw_only=True)
class GoalSequenceConfig:
    """Settings of `GoalSequence`."""

    about_axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Of the palm, ``(3,)``: the one controller turns about it."""
    across_axis: tuple[float, float, float] = (1.0, 0.0, 0.0)
    """The other one's, at right angles to it."""
    speed: float = 0.5
    """What they are told in goal_angular_velocity, about their axes [rad/s]."""
    faces: int = 4
    """Before it is turned across, the object is turned about the axis by a multiple of 1 / faces of
    a turn from where it is: 4 where the other controller knows a cube lying on any face."""
    most_tilt: float = 0.45
    """The grasp makes good the tilt that is left where it is less than this [rad]; ..."""
    lost_tilt: float = 0.7
    """... with more than this, other turns are looked for."""
    align_angle: float = 0.2
    """A turn about the axis is over when less than this is left [rad]; ..."""
    turn_angle: float = 0.5
    """... it is begun where there is more than this, and begun again with half as much more."""
    across_angle: float = 0.1
    """A turn across it is over when less than this is left [rad]."""

    def __post_init__(self) -> None:
        check_numbers(
            self,
            positive=(
                "speed", "most_tilt", "lost_tilt", "align_angle", "turn_angle", "across_angle",
            ),
        )  # fmt: skip
        check_whole(self, faces=1)
        about, across = unit_axis(self.about_axis), unit_axis(self.across_axis)
        if abs(np.dot(about, across)) > 1e-6:
            raise InvalidInput(
                f"across_axis is {self.across_axis}; expected one at right angles to "
                f"{self.about_axis}"
            )
        for least, most in (("most_tilt", "lost_tilt"), ("align_angle", "turn_angle")):
            if getattr(self, least) >= getattr(self, most):
                raise InvalidInput(
                    f"{least} is {getattr(self, least)}; expected less than {most}, "
                    f"{getattr(self, most)}"
                )


class GoalSequenceChanges(TypedDict, total=False):
    """`GoalSequenceConfig`'s fields as keywords, for type checkers."""

    about_axis: tuple[float, float, float]
    across_axis: tuple[float, float, float]
    speed: float
    faces: int
    most_tilt: float
    lost_tilt: float
    align_angle: float
    turn_angle: float
    across_angle: float


class Left(NamedTuple):
    """What is left to do to the goal; arrays ``(N,)`` [rad].

    Attributes:
        tilt: angle between the axis and what of the object is to be there.
        across: turn across the axis that makes it least, in (-pi, pi].
        about: turn about the axis, after the tilt is made good, in [-pi, pi).
    """

    tilt: Floats
    across: Floats
    about: Floats


class GoalSequence(BatchController):
    """Turns the object about the palm's axis, across it, about it again, and then in the grasp.

    The thesis's hand-centric decomposition (chapter 3) with controllers, such as trained policies,
    that each turn an object without end about one axis, and one way only: any orientation is a
    turn about the axis, one across it and another about it (Euler angles); of those that differ in
    the first the shortest is taken. `GoalGait` makes good the last tenths of a radian without
    letting go. A goal that is tilted from all faces of the object by more than the grasp can make
    good is not reached.

    Args:
        hand: the hand.
        config: the settings; None: `GoalSequenceConfig`'s own. Keyword arguments change single
            ones.
        about, across: who turns the object about the axis and across it; they are told so in
            ``goal_angular_velocity``, too. None: a `CoordinatedGait` about that axis.
        control_period: [s].

    Raises:
        InvalidInput: a setting is wrong, or one of them is no controller of this period.
    """

    def __init__(
        self,
        hand: HandModel,
        config: GoalSequenceConfig | None = None,
        *,
        about: Controller | None = None,
        across: Controller | None = None,
        control_period: float = 0.05,
        **changes: Unpack[GoalSequenceChanges],
    ) -> None:
        super().__init__(hand, control_period=control_period)
        self.config = with_changes(GoalSequenceConfig, config, changes)
        self.grasp = GoalGait(hand, control_period=control_period)
        self._axis = np.array(unit_axis(self.config.about_axis))
        self._across = np.array(unit_axis(self.config.across_axis))

        def gait(axis: Floats) -> Controller:
            return CoordinatedGait(hand, control_period=control_period, axis=axis)

        self.about = gait(self._axis) if about is None else about
        self.across = gait(self._across) if across is None else across
        for name, one in (("about", self.about), ("across", self.across)):
            if not isinstance(one, Controller):
                raise InvalidInput(f"{name} is {one!r}; expected a Controller")
            if not np.isclose(one.control_period, control_period):
                raise InvalidInput(
                    f"{name} has a control period of {one.control_period}; expected "
                    f"{control_period}"
                )
        self._start(0)

    def _start(self, count: int) -> None:
        self._leg = np.full(count, int(Leg.NONE))
        self._goal, self._ready = np.zeros((count, 4)), np.zeros((count, 4))
        self._place = np.zeros((count, 3))

    def _controllers(self) -> dict[str, Controller]:
        return {"about": self.about, "across": self.across, "grasp": self.grasp}

    def _arrays(self) -> dict[str, np.ndarray]:
        return {
            "leg": self._leg, "goal": self._goal, "ready": self._ready, "place": self._place,
        }  # fmt: skip

    def reset(self, seed: ArrayLike | None = None, mask: ArrayLike | None = None) -> None:
        for one in self._controllers().values():
            one.reset(seed, mask)
        if mask is None or not len(self._leg):
            self._start(0)
        else:
            self._leg[check_mask(mask, self._leg.shape)] = Leg.NONE

    def state_dict(self) -> dict[str, Any]:
        parts = {name: one.state_dict() for name, one in self._controllers().items()}
        return self._signed(**parts, sequence=copies(self._arrays()))

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        parts = self._parts(saved, *self._controllers(), "sequence")
        own = type(self).__name__
        check_names(own, parts["sequence"], self._arrays())
        (count,) = batch_shape(own, parts["sequence"], "leg") or (0,)
        for name, one in self._controllers().items():
            one.load_state_dict(parts[name])
        self._start(count)
        fill(own, self._arrays(), parts["sequence"])

    def act_batch(self, state: GraspState) -> Floats:
        goal, now, place = state.goal_quaternion, state.object_quaternion, state.object_position
        if goal is None:
            return self._ask(self.about, state, self._axis)
        if now is None or place is None:
            raise InvalidInput(
                "the state has a goal and no pose of the object; expected a tracked object"
            )
        if len(self._leg) != len(now):
            self._start(len(now))
        begun = self._leg == Leg.NONE
        self._place = np.where(begun[:, None], place, self._place)
        before, left = self._leg, self._go_on(now, goal, begun)
        taken_over = (self._leg == Leg.GRASP) & (before != Leg.GRASP)
        if taken_over.any() and not begun.all():
            self.grasp.reset(None, taken_over)
        self.grasp.refer_to(self._place, goal)
        action = np.where(
            (self._leg == Leg.GRASP)[:, None],
            self.grasp.act(replace(state, goal_angular_velocity=None)),
            np.where(
                (self._leg == Leg.ACROSS)[:, None],
                self._ask(self.across, state, self._across),
                self._ask(self.about, state, self._axis),
            ),
        )
        self._diagnostics = {"leg": self._leg.copy(), **left._asdict()}
        return action

    def _ask(self, one: Controller, state: GraspState, axis: Floats) -> Floats:
        """What a controller does that is told to turn about ``axis``."""
        spin = np.broadcast_to(self.config.speed * axis, (*state.batch_shape, 3))
        return one.act(replace(state, goal_quaternion=None, goal_angular_velocity=spin))

    def _go_on(self, now: Floats, goal: Floats, begun: np.ndarray) -> Left:
        """Decide what is done next; what is left of it."""
        config, leg = self.config, self._leg
        left, ready = self.left(now, goal), self.left(now, self._ready)
        other = ~begun & (np.abs((goal * self._goal).sum(axis=1)) < 1.0 - 1e-9)
        over = (leg == Leg.ACROSS) & (left.across < config.across_angle)
        # one that goes the long way round has more than half a turn left
        over &= left.across > -config.lost_tilt
        lost = (leg >= Leg.ABOUT) & (left.tilt > config.lost_tilt)
        new = begun | other | over | lost
        self._goal = goal.copy()
        readied = (leg == Leg.READY) & (np.abs(ready.about) < config.align_angle)
        next_leg = np.where(readied, Leg.ACROSS, leg)
        if new.any():
            first = self._first(now, goal)
            turned = multiply(from_rotation_vector(first[:, None] * self._axis), now)
            self._ready = np.where(new[:, None], turned, self._ready)
            turns = np.where(first > 0, Leg.READY, Leg.ACROSS)
            near = left.tilt < config.most_tilt
            next_leg = np.where(new, np.where(near, Leg.GRASP, turns), next_leg)
        again = np.where(leg == Leg.GRASP, 1.5, 1.0)  # not to and fro
        far = np.abs(left.about) > again * config.turn_angle
        there = np.abs(left.about) < config.align_angle
        grasped, flat = next_leg == Leg.GRASP, left.tilt < config.most_tilt
        next_leg = np.where(grasped & far & flat, Leg.ABOUT, next_leg)
        next_leg = np.where((next_leg == Leg.ABOUT) & there, Leg.GRASP, next_leg)
        self._leg = next_leg.astype(int)
        return left

    def left(self, now: Floats, goal: Floats) -> Left:
        """What is left from orientations ``now`` to ``goal``, wxyz ``(N, 4)``."""
        x, y, z = self._hand_to_goal(now, goal)
        about = split_turn(multiply(goal, inverse(now)), self._axis)[1]
        return Left(np.arctan2(np.hypot(x, y), z), np.arctan2(y, z), about)

    def _hand_to_goal(self, now: Floats, goal: Floats) -> tuple[Floats, Floats, Floats]:
        """Where that of the object is now which is to be along the axis: coordinates ``(N,)``.

        Along ``across``, along what completes the two to a right-handed frame, along the axis.
        """
        axis, across = self._axis, self._across
        there = rotate(now, rotate(inverse(goal), np.broadcast_to(axis, (len(now), 3))))
        return there @ across, there @ np.cross(axis, across), there @ axis

    def _first(self, now: Floats, goal: Floats) -> Floats:
        """By how much to turn about the axis before the turn across it, ``(N,)`` [rad].

        Of ``faces`` angles, the one with the least to turn altogether, of those which leave no more
        tilt than the grasp makes good.
        """
        config, count = self.config, len(now)
        best, least = np.zeros(count), np.full(count, np.inf)
        for i in range(config.faces):
            first = 2.0 * np.pi * i / config.faces
            turned = multiply(from_rotation_vector(np.tile(first * self._axis, (count, 1))), now)
            across = self.left(turned, goal).across % (2.0 * np.pi)
            turned = multiply(from_rotation_vector(across[:, None] * self._across), turned)
            tilt, _, about = self.left(turned, goal)
            # less than turn_angle is the grasp's, either way round
            last = np.where(np.abs(about) > config.turn_angle, about % (2.0 * np.pi), 0.0)
            cost = first + across + last + _UNREACHED * np.maximum(tilt - config.most_tilt, 0.0)
            best, least = np.where(cost < least, first, best), np.minimum(cost, least)
        return best


_UNREACHED = 100.0  # what a tilt that the grasp cannot make good counts as more than turning
