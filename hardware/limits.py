"""What set-points may be sent: joint range, speed, torque and how old a command may be.

The speed and torque are what the thesis set on its hand (evaluation on the real hand: 0.6 rad/s
and 0.5 N m). Speed and torque are also written into the servos, so that two things would have to
fail.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np

from dexctl.exceptions import InvalidInput
from dexctl.state import Bools, Floats
from dexctl.validation import check_numbers

MOST_SPEED, MOST_TORQUE = 3.0, 3.0


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Limits of a hand; they cannot be switched off, only set otherwise.

    Attributes:
        speed: of set-points, and the servos' profile velocity [rad/s], at most 3.
        torque: of each joint, as a current limit of its servo [N m], at most 3.
        command_age: how old the controller's command may be [s].
        state_age: how old what is known of the joints may be [s].
        watchdog: silence of the bus after which the servos stop by themselves [s].
        temperature: of a servo, above which is warned [degC]; 10 below where it shuts down.
        voltage: lowest and highest supply [V].
        overruns: share of ticks that may overrun before a warning, and before the hand is held.
    """

    speed: float = 0.6
    torque: float = 0.5
    command_age: float = 0.1
    state_age: float = 0.1
    watchdog: float = 0.1
    temperature: float = 70.0
    voltage: tuple[float, float] = (10.0, 14.8)
    overruns: tuple[float, float] = (0.05, 0.20)

    def __post_init__(self) -> None:
        check_numbers(self, positive=_numbers(self))
        for name, most in (("speed", MOST_SPEED), ("torque", MOST_TORQUE)):
            if getattr(self, name) > most:
                raise InvalidInput(f"{name} is {getattr(self, name)}; expected at most {most}")
        low, high = self.voltage
        if not 0 < low < high < np.inf:
            raise InvalidInput(f"voltage is {self.voltage}; expected (lowest, highest) above 0")
        warn, hold = self.overruns
        if not 0 < warn <= hold <= 1:
            raise InvalidInput(f"overruns is {self.overruns}; expected two shares, rising, to 1")


def _numbers(limits: Limits) -> tuple[str, ...]:
    return tuple(f.name for f in fields(limits) if f.name not in ("voltage", "overruns"))


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
    asked: Floats, previous: Floats, lower: Floats, upper: Floats, step: float
) -> LimitedGoal:
    """The set-point nearest to ``asked`` that is in range and not more than ``step`` away.

    Each joint for itself. One that stands out of its range, as after being pushed, may come back
    at the speed allowed and never goes further out.

    Args:
        asked: wanted set-points, ``(d,)`` [rad].
        previous: what was sent last, ``(d,)`` [rad], finite.
        lower, upper: ``(d,)`` [rad].
        step: greatest change [rad].
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
