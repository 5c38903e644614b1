"""How far and how fast set-points may move: for controllers, the simulator and the servo hand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dexctl.exceptions import InvalidInput
from dexctl.hand import HandModel
from dexctl.state import Floats
from dexctl.validation import check_numbers

REAL_SPEED, REAL_TORQUE, REAL_LATENCY = 0.6, 0.5, 0.05
"""Of the thesis's hand (chapter 5, "Hardware") [rad/s], [N m], [s]."""


@dataclass(frozen=True, kw_only=True)
class HandLimits:
    """What a real hand makes of its set-points: slow, weak and late.

    Raises:
        InvalidInput: a number out of range.
    """

    speed_limit: float | None = None
    """Fastest set-point [rad/s]; none: as the controller asks."""
    torque_limit: float | None = None
    """Largest joint torque [N m]; none: as the hand's file has it."""
    action_latency: float = 0.0
    """From a set-point to its effect [s]."""

    def __post_init__(self) -> None:
        given = [n for n in ("speed_limit", "torque_limit") if getattr(self, n) is not None]
        check_numbers(self, positive=tuple(given), not_negative=("action_latency",))
        if self.action_latency > 10.0:
            raise InvalidInput(f"action_latency is {self.action_latency}; expected 0 to 10 s")

    def __bool__(self) -> bool:
        return self != HandLimits()

    @classmethod
    def real(cls) -> HandLimits:
        """Those of the thesis's hand."""
        return cls(speed_limit=REAL_SPEED, torque_limit=REAL_TORQUE, action_latency=REAL_LATENCY)


class SetPointLimits:
    """Limits the speed of set-points, their distance from the joints, and their range.

    Where a speed is too high the whole change of that hand is scaled down, so that the fingers
    keep moving together. Joints whose change is zero are left alone, so controllers that own
    different fingers stay orthogonal.

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
        return np.where(change != 0, target - q_target, 0.0)
