"""How far and how fast set-points may move: of controllers, of the simulator and of servo hands.

`SetPointLimits` limits what controllers ask for, `HandLimits` makes a simulated hand as slow, weak
and late as a real one, and `limit_goal` is the last check before a goal is sent to servos.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from dexctl.exceptions import InvalidInput
from dexctl.hand import HandModel
from dexctl.state import Bools, Floats
from dexctl.validation import check_numbers

REAL_SPEED, REAL_TORQUE, REAL_LATENCY = 0.6, 0.5, 0.05
"""Of the hand in the thesis (chapter 5, "Hardware"): fastest set-point [rad/s], largest joint
torque [N m], and the time from a set-point to its effect [s]."""
LONGEST_LATENCY = 10.0  # [s]


@dataclass(frozen=True, kw_only=True)
class HandLimits:
    """What a hand makes of its set-points; by itself nothing is limited.

    Raises:
        InvalidInput: a limit that is no number above 0, or a latency out of range.
    """

    speed_limit: float | None = None
    """Fastest set-point [rad/s]; none: no limit."""
    torque_limit: float | None = None
    """Largest joint torque [N m]; none: no limit but the hand's own."""
    action_latency: float = 0.0
    """Time from a set-point to its effect [s], at most 10."""

    def __post_init__(self) -> None:
        given = ("speed_limit", "torque_limit")
        check_numbers(
            self,
            positive=tuple(name for name in given if getattr(self, name) is not None),
            not_negative=("action_latency",),
        )
        if self.action_latency > LONGEST_LATENCY:
            raise InvalidInput(
                f"action_latency is {self.action_latency}; expected 0 to {LONGEST_LATENCY:g} s"
            )

    @classmethod
    def real(cls) -> HandLimits:
        """Those of the hand in the thesis."""
        return cls(speed_limit=REAL_SPEED, torque_limit=REAL_TORQUE, action_latency=REAL_LATENCY)

    def __bool__(self) -> bool:
        """Whether anything is limited."""
        return self != HandLimits()


class SetPointLimits:
    """Limits the speed of set-points, their distance from the joints, and their range.

    Where a speed is too high the whole change of that hand is scaled down, so that the fingers
    keep moving together. The speed is kept whatever was measured: a set-point that a joint has left
    behind, or that is out of its range, comes back at the speed allowed, so that an encoder that
    reads nonsense for a step moves no motor far. Joints whose change is zero are left alone, so
    controllers that own different fingers stay orthogonal.

    Args:
        hand: the hand, for its joint and speed limits.
        max_speed: of set-points [rad/s].
        max_lead: greatest distance of a set-point from its measured joint [rad].
        control_period: [s].
    """

    def __init__(
        self, hand: HandModel, max_speed: float, max_lead: float, control_period: float
    ) -> None:
        self._lower, self._upper = hand.lower, hand.upper
        self._step = np.minimum(max_speed, hand.velocity) * control_period
        self._lead = max_lead

    def __call__(self, q: Floats, q_target: Floats, change: Floats) -> Floats:
        """The limited change ``(..., d)`` [rad] of set-points ``q_target`` for joints at ``q``."""
        excess = np.abs(change / self._step).max(axis=-1, keepdims=True)
        target = q_target + change / np.maximum(excess, 1.0)
        low = np.maximum(q - self._lead, self._lower)
        high = np.minimum(q + self._lead, self._upper)
        # a joint beyond its limit would turn the bounds round: the limit wins
        target = np.minimum(np.maximum(target, np.minimum(low, self._upper)), high)
        target = np.maximum(target, self._lower)
        moved = np.minimum(np.maximum(target - q_target, -self._step), self._step)
        return np.where(change != 0, moved, 0.0)


class LimitedGoal(NamedTuple):
    """A set-point within the limits.

    Attributes:
        q_target: what may be sent, ``(d,)`` [rad].
        out_of_range: joints that were asked beyond their range, ``(d,)`` bool.
        too_fast: joints that were asked to go further than the speed allows, ``(d,)`` bool.
        not_finite: joints that were asked for NaN or infinity; they stay, ``(d,)`` bool.
    """

    q_target: Floats
    out_of_range: Bools
    too_fast: Bools
    not_finite: Bools

    @property
    def clamped(self) -> Bools:
        """Joints that do not get what was asked, ``(d,)`` bool."""
        return self.out_of_range | self.too_fast | self.not_finite


def limit_goal(
    asked: Floats, previous: Floats, lower: Floats, upper: Floats, step: Floats | float
) -> LimitedGoal:
    """The set-point nearest to ``asked`` that is in range and not more than ``step`` away.

    Each joint for itself. One that stands out of its range, as after being pushed, may come back
    at the speed allowed and never goes further out.

    Args:
        asked: wanted set-points, ``(d,)`` [rad].
        previous: what was sent last, ``(d,)`` [rad], finite.
        lower, upper: ``(d,)`` [rad].
        step: greatest change, of all or of each ``(d,)`` [rad].
    """
    not_finite = ~np.isfinite(asked)
    wanted = np.where(not_finite, previous, asked)
    inside = np.minimum(np.maximum(wanted, lower), upper)
    # standing out of range and not asked further out is no fault of the asker
    outside = (wanted > np.maximum(upper, previous)) | (wanted < np.minimum(lower, previous))
    out_of_range = outside & ~not_finite
    change = inside - previous
    # rounding must not count as being too fast: a step of exactly the limit is the usual case
    too_fast = (np.abs(change) > step * (1.0 + 1e-9)) & ~not_finite
    limited = previous + np.minimum(np.maximum(change, -step), step)
    goal = np.where(not_finite, previous, np.where(too_fast, limited, inside))
    return LimitedGoal(goal, out_of_range, too_fast, not_finite)
