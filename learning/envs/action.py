"""SetPointAction: from actions in [-1, 1] to changes of joint set-points, and back."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dexctl.exceptions import InvalidInput
from dexctl.hand import HandModel
from dexctl.limits import SetPointLimits
from dexctl.state import Floats, GraspState


class SetPointAction:
    """An action ``(..., d)`` in [-1, 1] is a set-point change of ``action * max_change`` [rad].

    `limited` then keeps the set-points within reach of the joints and within their range, as the
    controllers do; environments and trained policies share it, so that a policy does on a plant
    what it did in training.

    Args:
        hand: whose set-points.
        max_speed: of set-points, what an action of 1 means [rad/s].
        max_lead: greatest distance of a set-point from its measured joint [rad].
        control_period: [s].

    Attributes:
        max_speed, max_lead, control_period: as given.
        max_change: what an action of 1 means in one control step [rad].
    """

    def __init__(
        self, hand: HandModel, *, max_speed: float, max_lead: float, control_period: float
    ) -> None:
        self.max_speed, self.max_lead = float(max_speed), float(max_lead)
        self.control_period = float(control_period)
        self.max_change = self.max_speed * self.control_period
        self._limits = SetPointLimits(hand, max_speed, max_lead, control_period)

    def to_change(self, action: ArrayLike) -> Floats:
        """Set-point changes [rad] of actions ``(..., d)``; what is beyond [-1, 1] is cut off."""
        return np.clip(np.asarray(action, float), -1.0, 1.0) * self.max_change

    def from_change(self, change: ArrayLike) -> Floats:
        """Actions in [-1, 1] of set-point changes ``(..., d)`` [rad], cut off where too large."""
        return np.clip(np.asarray(change, float) / self.max_change, -1.0, 1.0)

    def limited(self, state: GraspState, change: Floats) -> Floats:
        """The change ``(..., d)`` [rad] that is within reach, speed and range."""
        return self._limits(state.q, state.q_target, change)

    def to_dict(self) -> dict[str, Any]:
        """As JSON can hold it."""
        return {
            "max_speed": self.max_speed,
            "max_lead": self.max_lead,
            "control_period": self.control_period,
        }


def check_action(action: ArrayLike, shape: tuple[int, ...]) -> Floats:
    """Finite actions of the shape given.

    Raises:
        InvalidInput: they are not.
    """
    values = np.asarray(action, float)
    if values.shape != shape:
        raise InvalidInput(f"actions have shape {values.shape}; expected {shape}")
    if not np.isfinite(values.sum()):
        where = np.argwhere(~np.isfinite(values))[0].tolist()
        raise InvalidInput(f"the action at {where} is {values[tuple(where)]}; expected a number")
    return values
