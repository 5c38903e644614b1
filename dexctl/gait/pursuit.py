"""GoalPursuit: turns an object about any axis, by who brings it to goal orientations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from dexctl.controller import BatchController, Controller, check_parts
from dexctl.exceptions import InvalidInput
from dexctl.hand import HandModel
from dexctl.rotations import from_rotation_vector, inverse, multiply, shortest, twist_angle
from dexctl.saved import batch_shape, check_names, copies, fill
from dexctl.state import Floats, GraspState
from dexctl.validation import check_mask, check_numbers, unit_axis, with_changes


@dataclass(frozen=True, kw_only=True)
class GoalPursuitConfig:
    """Settings of `GoalPursuit`."""

    lookahead: float = 1.0
    """The goal goes at most so far ahead of the object, and waits for it there [rad]."""
    speed: float = 0.5
    """Angular velocity that the object is turned with where the state tells none [rad/s]."""

    def __post_init__(self) -> None:
        check_numbers(self, positive=("lookahead", "speed"))
        if self.lookahead >= np.pi:  # from there on the other way round is shorter
            raise InvalidInput(
                f"lookahead is {self.lookahead}; expected less than half a turn, 3.14 rad"
            )


class GoalPursuitChanges(TypedDict, total=False):
    """`GoalPursuitConfig`'s fields as keywords, for type checkers."""

    lookahead: float
    speed: float


class GoalPursuit(BatchController):
    """Has an object turned as it is told, by a controller that brings it to goal orientations.

    The converse of `GoalSteering`. The goal is itself turned, with the angular velocity that is
    told (``goal_angular_velocity``), and the other controller goes after it: so a policy that was
    trained for single goals turns an object without end, about any axis, at any speed up to its
    own. This is pure pursuit (R. C. Coulter, Implementation of the Pure Pursuit Path Tracking
    Algorithm, CMU-RI-TR-92-01, 1992) along a path of orientations: the goal is never behind the
    object nor further ahead of it than ``lookahead``, both as turns about the axis that is told,
    and tilts that the object has suffered on the way are made good.

    Where another angular velocity is told, the goal starts again from where the object is, as far
    ahead as it was along the new axis; where that is zero, the object is kept as it lies. A state
    that has a ``goal_quaternion`` goes to the other controller as it is.

    Args:
        hand: the hand.
        config: the settings; None: `GoalPursuitConfig`'s own. Keyword arguments change single
            ones.
        reacher: who brings the object to a goal.
        axis: ``(3,)``, turned about where a state tells none; None: z.

    Attributes:
        reacher: as given.

    Raises:
        InvalidInput: a setting is wrong, or the reacher is no controller of this hand, or is known
            to do nothing about goals.
    """

    tracks = True

    def __init__(
        self,
        hand: HandModel,
        config: GoalPursuitConfig | None = None,
        *,
        reacher: Controller,
        axis: ArrayLike | None = None,
        **changes: Unpack[GoalPursuitChanges],
    ) -> None:
        period = check_parts(hand, {"reacher": reacher})
        super().__init__(hand, control_period=period)
        self.config = with_changes(GoalPursuitConfig, config, changes)
        if reacher.goes_to_goals is False:
            raise InvalidInput(
                f"reacher is a {type(reacher).__name__} that goes to no goals; expected one that "
                "does, such as the policy dex5-cube-goals"
            )
        self.reacher, self.object, self.gravity = reacher, reacher.object, reacher.gravity
        self.pose_age = reacher.pose_age
        self._told = self.config.speed * np.array(unit_axis("z" if axis is None else axis))
        self._start(0)

    def _start(self, count: int) -> None:
        self._met = np.zeros(count, bool)
        self._goal, self._spin = np.zeros((count, 4)), np.zeros((count, 3))

    def _arrays(self) -> dict[str, np.ndarray]:
        return {"met": self._met, "goal": self._goal, "spin": self._spin}

    def reset(self, seed: ArrayLike | None = None, mask: ArrayLike | None = None) -> None:
        self.reacher.reset(seed, mask)
        if mask is None or not len(self._met):
            self._start(0)
        else:
            self._met &= ~check_mask(mask, self._met.shape)

    def state_dict(self) -> dict[str, Any]:
        return self._signed(reacher=self.reacher.state_dict(), pursuit=copies(self._arrays()))

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        parts, own = self._parts(saved, "reacher", "pursuit"), type(self).__name__
        check_names(own, parts["pursuit"], self._arrays())
        (count,) = batch_shape(own, parts["pursuit"], "met") or (0,)
        self.reacher.load_state_dict(parts["reacher"])
        self._start(count)
        fill(own, self._arrays(), parts["pursuit"])

    def act_batch(self, state: GraspState) -> Floats:
        spin, now = state.goal_angular_velocity, state.object_quaternion
        if now is None:
            raise InvalidInput(
                "the state has no orientation of the object; expected a tracked object"
            )
        if state.goal_quaternion is not None:
            self._start(len(now))  # told again, the object is somewhere else
            action = self.reacher.act(state)
            self._diagnostics = {**self.reacher.diagnostics, "ahead": np.zeros(len(now))}
            return action
        if spin is None:
            spin = np.tile(self._told, (len(now), 1))
        ahead = self._go_ahead(spin, now)
        asked = replace(state, goal_quaternion=self._goal.copy(), goal_angular_velocity=None)
        action = self.reacher.act(asked)
        self._diagnostics = {**self.reacher.diagnostics, "ahead": ahead}
        return action

    def _go_ahead(self, spin: Floats, now: Floats) -> Floats:
        """Turn the goals by a control step; how far ahead they are then, ``(N,)`` [rad]."""
        if len(self._met) != len(now):
            self._start(len(now))
        speed = np.sqrt((spin * spin).sum(axis=1))
        axis = spin / np.maximum(speed, _SLOW)[:, None]
        most = self.config.lookahead
        goal = np.where(self._met[:, None], self._goal, now)
        along = shortest(twist_angle(multiply(goal, inverse(now)), axis))
        # told another one, only what is ahead about its axis counts any more
        anew = (spin != self._spin).any(axis=1)
        kept = np.clip(along, 0.0, most)
        goal = np.where(anew[:, None], _turned(now, axis, kept), goal)
        along = np.where(anew, kept, along)
        ahead = np.clip(along + self.control_period * speed, 0.0, most)
        self._goal = _turned(goal, axis, ahead - along)
        self._spin, self._met = spin.copy(), np.ones_like(self._met)
        return ahead


def _turned(quaternion: Floats, axis: Floats, angle: Floats) -> Floats:
    """``quaternion`` ``(N, 4)`` turned about ``axis`` ``(N, 3)`` by ``angle`` ``(N,)`` [rad]."""
    return multiply(from_rotation_vector(angle[:, None] * axis), quaternion)


_SLOW = 1e-12  # [rad/s]
