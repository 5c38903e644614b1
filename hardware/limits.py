"""Limits of a servo hand: speed, torque, how old what is known may be, temperature and voltage.

Speed and torque default to those of the hand in the thesis, and are also written into the servos,
so that two things would have to fail. What becomes of a set-point out of its limits is
`dexctl.limits.limit_goal`'s.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

from dexctl.exceptions import InvalidInput
from dexctl.limits import REAL_SPEED, REAL_TORQUE
from dexctl.validation import check_numbers

MOST_SPEED, MOST_TORQUE = 3.0, 3.0
_MOST: dict[str, float] = {
    "speed_limit": MOST_SPEED, "torque_limit": MOST_TORQUE, "command_age": 10.0,
    "state_age": 10.0, "watchdog": 2.54, "temperature": 100.0,
}  # fmt: skip
_LEAST_WATCHDOG = 0.02  # less is rounded to 0, which switches it off in the servo
_VOLTAGES = 1.0, 60.0


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Limits of a hand; they cannot be switched off, only set otherwise.

    Raises:
        InvalidInput: a value out of range.
    """

    speed_limit: float = REAL_SPEED
    """Of set-points, and the servos' profile velocity [rad/s], at most 3."""
    torque_limit: float = REAL_TORQUE
    """Of each joint, as a current limit of its servo [N m], at most 3."""
    command_age: float = 0.1
    """How old the controller's command may be [s], at most 10."""
    state_age: float = 0.1
    """How old what is known of the joints may be [s], at most 10."""
    watchdog: float = 0.1
    """Silence of the bus after which the servos stop by themselves [s], 0.02 to 2.54."""
    temperature: float | None = None
    """Of a servo, above which is warned [degC], at most 100; none: 10 below where its model shuts
    down."""
    voltage: tuple[float, float] | None = None
    """Lowest and highest supply [V], of 1 to 60; none: as the servos' models are made for."""
    overruns: tuple[float, float] = (0.05, 0.20)
    """Share of ticks that may overrun before a warning, and before the hand is held."""

    def __post_init__(self) -> None:
        check_numbers(self, positive=_numbers(self))
        for name, most in _MOST.items():
            value = getattr(self, name)
            if value is not None and value > most:
                raise InvalidInput(f"{name} is {value}; expected at most {most}")
        if self.watchdog < _LEAST_WATCHDOG:
            raise InvalidInput(f"watchdog is {self.watchdog}; expected {_LEAST_WATCHDOG} s or more")
        if self.voltage is not None:
            low, high = self.voltage
            if not _VOLTAGES[0] <= low < high <= _VOLTAGES[1]:
                raise InvalidInput(
                    f"voltage is {self.voltage}; expected (lowest, highest) of "
                    f"{_VOLTAGES[0]:g} to {_VOLTAGES[1]:g} V"
                )
        warn, hold = self.overruns
        if not 0 < warn <= hold <= 1:
            raise InvalidInput(f"overruns is {self.overruns}; expected two shares, rising, to 1")

    def patient(self, factor: float) -> Limits:
        """These, with so many times more silence, age and overruns: for a busy machine.

        Raises:
            InvalidInput: ``factor`` is not from 1 to 10.
        """
        if not 1.0 <= factor <= 10.0:
            raise InvalidInput(f"patience is {factor}; expected 1 to 10")
        warn, hold = self.overruns
        return replace(
            self,
            command_age=factor * self.command_age,
            state_age=factor * self.state_age,
            watchdog=factor * self.watchdog,
            overruns=(min(factor * warn, 1.0), min(factor * hold, 1.0)),
        )


def _numbers(limits: Limits) -> tuple[str, ...]:
    other = {"voltage", "overruns"} | ({"temperature"} if limits.temperature is None else set())
    return tuple(f.name for f in fields(limits) if f.name not in other)
