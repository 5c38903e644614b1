"""GoalSequence: brings an object to a goal by controllers for two axes, and the grasp."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from dexctl.controller import BatchController, Controller, check_parts
from dexctl.exceptions import InvalidInput
from dexctl.gait.commanded import CommandedTurning
from dexctl.gait.coordinated import CoordinatedGait
from dexctl.gait.flat_turns import FlatTurns, Ints
from dexctl.gait.goal import GoalGait
from dexctl.hand import HandModel
from dexctl.rotations import angle_between, inverse, multiply, shortest, twist_angle
from dexctl.saved import batch_shape, check_names, copies, fill
from dexctl.state import Bools, Floats, GraspState
from dexctl.validation import check_mask, check_numbers, check_whole, shown_numbers, with_changes


class Leg(IntEnum):
    """What is done about the goal now."""

    NONE = -1  # no goal yet
    READY = 0  # turned about the palm's axis, until the turn across it leads to another face
    ACROSS = 1  # turned across it, until that face looks along it
    ABOUT = 2  # turned about it
    GRASP = 3  # the rest, in the grasp
    LEVEL = 4  # laid flat, in the grasp
    LAST = 5  # turned across it, to the goal


@dataclass(frozen=True, kw_only=True)
class GoalSequenceConfig:
    """Settings of `GoalSequence`."""

    speed: float = 0.5
    """What they are told in goal_angular_velocity, about their axes [rad/s]."""
    faces: int = 4
    """Flat positions of the object in a full turn about each of the two axes: 4 for a cube."""
    images: bool = False
    """Whether controllers also turn about the images of their axes by the hand's symmetries."""
    most_tilt: float = 0.45
    """The grasp makes good what is left where it is less than this [rad]; ..."""
    lost_tilt: float = 0.7
    """... with more than this (in the grasp half as much more), other turns are looked for."""
    align_angle: float = 0.2
    """A turn about the axis is over when less than this is left [rad]; ..."""
    turn_angle: float = 0.5
    """... before the grasp it is begun where there is more than this, and begun again with half as
    much more."""
    across_angle: float = 0.1
    """A turn across it is over when less than this is left [rad]."""
    flat_tilt: float = 0.4
    """An object that is tilted by more than this is laid flat before it is turned [rad], ..."""
    level_seconds: float = 2.0
    """... for so long at most [s]."""

    def __post_init__(self) -> None:
        check_numbers(
            self,
            positive=(
                "speed", "most_tilt", "lost_tilt", "align_angle", "turn_angle", "across_angle",
                "flat_tilt", "level_seconds",
            ),
        )  # fmt: skip
        check_whole(self, faces=1)
        for least, most in (
            ("flat_tilt", "most_tilt"), ("most_tilt", "lost_tilt"), ("align_angle", "turn_angle"),
        ):  # fmt: skip
            if getattr(self, least) >= getattr(self, most):
                raise InvalidInput(
                    f"{least} is {getattr(self, least)}; expected less than {most}, "
                    f"{getattr(self, most)}"
                )


class GoalSequenceChanges(TypedDict, total=False):
    """`GoalSequenceConfig`'s fields as keywords, for type checkers."""

    speed: float
    faces: int
    images: bool
    most_tilt: float
    lost_tilt: float
    align_angle: float
    turn_angle: float
    across_angle: float
    flat_tilt: float
    level_seconds: float


class GoalSequence(BatchController):
    """Turns the object from one flat position to another, then towards the goal, then in the grasp.

    The thesis's hand-centric decomposition (chapter 3) with controllers, such as trained policies,
    that each turn an object without end about one axis: one about the palm's axis, which here is
    that of ``about``, one across it; as a setting also with their images by the hand's symmetries,
    which on dex5 turn either way about the one and about ten across it. An object is turned
    about the palm's axis where it lies flat, and across it where it is square to the axis; so a
    goal is come to by a turn that brings the right face up, one about the axis, one across it that
    may end on an edge, and the rest, up to half a radian, in the grasp by `GoalGait`, which does
    not let go. The object has to lie flat, and square to the axis of ``across``, when an episode
    begins. Of all such ways the one with the least to turn is taken (`dexctl.gait.flat_turns`),
    and another where something else comes of it.

    Args:
        hand: the hand.
        config: the settings; None: `GoalSequenceConfig`'s own. Keyword arguments change single
            ones.
        about, across: who turns the object about the palm's axis and across it, with an attribute
            ``axis``, ``(3,)``; they are told it in ``goal_angular_velocity``, too. None: a
            `CoordinatedGait`, about z and x.
        control_period: [s].

    Raises:
        InvalidInput: a setting is wrong, one of them is no controller of this period or turns about
            no axis, or their axes are not at right angles.
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
        self.config = config = with_changes(GoalSequenceConfig, config, changes)
        self.grasp = GoalGait(hand, control_period=control_period)

        def gait(axis: tuple[float, float, float]) -> Controller:
            return CoordinatedGait(hand, control_period=control_period, axis=axis)

        self.about = gait((0, 0, 1)) if about is None else about
        self.across = gait((1, 0, 0)) if across is None else across
        check_parts(hand, {"about": self.about, "across": self.across}, control_period)
        self.turner = CommandedTurning(hand, (self.about, self.across), images=config.images)
        self.tracks = self.turner.tracks
        axes = self.turner.axes
        along = axes @ axes[0]  # the first is the first controller's own
        lying = axes[np.abs(along) < _SQUARE]
        if not len(lying):
            raise InvalidInput(
                f"across turns about {shown_numbers(self.across.axis)}; expected an axis at right "  # type: ignore[attr-defined]
                f"angles to {shown_numbers(axes[0])}"
            )
        # in a mirror image both turn the other way: what follows on each other is of one kind
        ways = self.turner.ways[np.abs(along) < _SQUARE]
        self._turns = FlatTurns(axes[0], lying, ways, config.faces)
        self._start(0)

    def _start(self, count: int) -> None:
        self._leg = np.full(count, int(Leg.NONE))
        self._goal, self._flat = np.zeros((count, 4)), np.zeros((count, 4))
        self._place, self._aim = np.zeros((count, 3)), np.zeros((count, 4))
        self._since = np.zeros(count, int)
        self._faces = np.zeros((count, 2), int)  # before and after the turn across
        self._axes = np.full((count, 2), -1)  # of the first and the last turn across
        self._yaws = np.zeros((count, 2))  # before and after the first one [rad]
        self._way = np.ones(count, int)  # of the turns about the palm's axis

    def _controllers(self) -> dict[str, Controller]:
        return {"turner": self.turner, "grasp": self.grasp}

    def _arrays(self) -> dict[str, np.ndarray]:
        return {
            "leg": self._leg, "goal": self._goal, "flat": self._flat, "place": self._place,
            "aim": self._aim, "since": self._since, "faces": self._faces, "axes": self._axes,
            "yaws": self._yaws, "way": self._way,
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
            return self._turn(state, np.broadcast_to(self._turns.axis, (len(state.q), 3)))
        if now is None or place is None:
            raise InvalidInput(
                "the state has a goal and no pose of the object; expected a tracked object"
            )
        if len(self._leg) != len(now):
            self._start(len(now))
        begun = self._leg == Leg.NONE
        self._place = np.where(begun[:, None], place, self._place)
        self._flat = np.where(begun[:, None], now, self._flat)
        before, spin = self._leg, self._go_on(now, goal, begun)
        grasped = np.isin(self._leg, _IN_GRASP)
        taken_over = grasped & ~np.isin(before, _IN_GRASP)
        if taken_over.any() and not begun.all():
            self.grasp.reset(None, taken_over)
        aim = np.where((self._leg == Leg.LEVEL)[:, None], self._aim, goal)
        self.grasp.refer_to(self._place, aim)
        told = replace(state, goal_quaternion=aim, goal_angular_velocity=None)
        action = np.where(grasped[:, None], self.grasp.act(told), self._turn(state, spin))
        self._diagnostics = {"leg": self._leg.copy(), "left": angle_between(now, goal)}
        return action

    def _turn(self, state: GraspState, axis: Floats) -> Floats:
        """What is done to turn objects about axes ``(N, 3)``."""
        spin = self.config.speed * axis
        return self.turner.act(replace(state, goal_quaternion=None, goal_angular_velocity=spin))

    def _go_on(self, now: Floats, goal: Floats, begun: Bools) -> Floats:
        """Decide what is done next; the axes to turn about, ``(N, 3)``."""
        config, turns, leg = self.config, self._turns, self._leg
        turn, wanted = multiply(now, inverse(self._flat)), multiply(goal, inverse(self._flat))
        face, tilt, yaw = turns.lies(turn)
        self._since = self._since + 1
        other = ~begun & (np.abs((goal * self._goal).sum(axis=1)) < 1.0 - 1e-9)
        self._goal = goal.copy()
        turned = leg == Leg.ACROSS
        left = turns.across_left(turn, self._faces[:, 1], self._axes[:, 0])
        # one that goes the long way round has more than half a turn left
        turned &= (left < config.across_angle) & (left > -config.lost_tilt)
        tipped = np.isin(leg, (Leg.READY, Leg.ABOUT)) & (tilt > config.lost_tilt)
        lost = (leg == Leg.GRASP) & (angle_between(now, goal) > _LOST * config.lost_tilt)
        levelled = (leg == Leg.LEVEL) & (
            (tilt < 0.5 * config.flat_tilt)
            | (self._since * self.control_period > config.level_seconds)
        )
        in_grasp = begun | lost | levelled | (other & np.isin(leg, _IN_GRASP))
        new = in_grasp | other | turned | tipped
        if new.any():
            self._decide(np.flatnonzero(new), turn, wanted, face, tilt, yaw, in_grasp, levelled)
        leg = self._leg
        ready = turns.yaw_left(turn, self._faces[:, 0], self._yaws[:, 0], self._way)
        readied = (leg == Leg.READY) & (ready < config.align_angle)
        leg = np.where(readied, int(Leg.ACROSS), leg)
        about = turns.yaw_left(turn, self._faces[:, 1], self._yaws[:, 1], self._way)
        there = (leg == Leg.ABOUT) & (about < config.align_angle)
        goes_on = self._axes[:, 1] >= 0
        leg = np.where(there, np.where(goes_on, int(Leg.LAST), int(Leg.GRASP)), leg)
        u = turns.across[self._axes[:, 1]]
        rest = shortest(twist_angle(multiply(goal, inverse(now)), u))
        leg = np.where((leg == Leg.LAST) & (rest < config.across_angle), int(Leg.GRASP), leg)
        self._leg = leg
        spin = self._way[:, None] * turns.axis
        for one, k in ((Leg.ACROSS, self._axes[:, 0]), (Leg.LAST, self._axes[:, 1])):
            spin = np.where((leg == one)[:, None], turns.across[k], spin)
        return spin

    def _decide(
        self,
        rows: Ints,
        turn: Floats,
        goal: Floats,
        face: Ints,
        tilt: Floats,
        yaw: Floats,
        in_grasp: Bools,
        levelled: Bools,
    ) -> None:
        """Find out what is to be done from now on."""
        config, turns = self.config, self._turns
        turn, goal, face, tilt, yaw = turn[rows], goal[rows], face[rows], tilt[rows], yaw[rows]
        bound = np.where(in_grasp[rows], 0, self._way[rows])
        most, near = config.most_tilt, config.turn_angle
        plan = turns.plan(turn, goal, bound, most, near, config.align_angle)
        across, last = plan.first >= 0, plan.last >= 0
        far = np.abs(shortest(turns.yaw_left(turn, plan.face, plan.yaw, plan.way)))
        about = far > np.where(last, config.align_angle, config.turn_angle)
        leg = np.where(about, int(Leg.ABOUT), np.where(last, int(Leg.LAST), int(Leg.GRASP)))
        leg = np.where(across, int(Leg.READY), leg)
        faces = np.stack([face, plan.face], axis=1)
        axes = np.stack([plan.first, plan.last], axis=1)
        there = angle_between(turn, goal) < most
        flat = (tilt < config.flat_tilt) | levelled[rows]
        level = ~there & ~flat & (tilt < most)
        edge = ~there & ~flat & ~level
        to, k = turns.back(turn, plan.way)
        faces[:, 1], axes[:, 0] = np.where(edge, to, plan.face), np.where(edge, k, plan.first)
        leg = np.where(level, int(Leg.LEVEL), np.where(edge, int(Leg.ACROSS), leg))
        leg = np.where(there, int(Leg.GRASP), leg)
        found = {
            "_leg": leg, "_since": 0, "_aim": multiply(turns.flat(face, yaw), self._flat[rows]),
            "_faces": faces, "_axes": axes, "_way": plan.way,
            "_yaws": np.stack([plan.ready, plan.yaw], axis=1),
        }  # fmt: skip
        for name, value in found.items():
            changed = getattr(self, name).copy()
            changed[rows] = value
            setattr(self, name, changed)


_IN_GRASP = (Leg.GRASP, Leg.LEVEL)
_SQUARE = 1e-3
_LOST = 1.5
