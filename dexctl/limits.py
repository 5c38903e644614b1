"""SetPointLimits: keeps set-point changes within what a hand should be asked to do."""

from __future__ import annotations

import numpy as np

from dexctl.hand import HandModel
from dexctl.state import Floats


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
