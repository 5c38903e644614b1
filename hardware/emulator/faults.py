"""Faults of line and servos that the emulator makes on request."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

from dexctl.exceptions import InvalidInput, UnknownName
from hardware.emulator.chain import Answer, Chain
from hardware.registers import HardwareError

LONGEST_DELAY = 2.0  # s


class Faults:
    """What goes wrong on the way back, and in the servos.

    Every fault is a method called by its name from the side channel. ``count`` faults the next so
    many answers, ``rate`` each one with that probability until it is set to 0.

    Args:
        chain: the servos.
        seed: of the random choices.
    """

    def __init__(self, chain: Chain, seed: int = 0) -> None:
        self._chain = chain
        self._random = random.Random(seed)
        self._drop = _Chance(self._random)
        self._corrupt = _Chance(self._random)
        self.delay_seconds = 0.0
        self._known: dict[str, Callable[..., Any]] = {
            "drop": self._drop.set,
            "corrupt": self._corrupt.set,
            "delay": self.delay,
            "silence": self.silence,
            "speak": self.speak,
            "overload": self.overload,
            "overheat": self.overheat,
            "voltage": self.voltage,
            "block": self.block,
        }

    def make(self, name: str, **arguments: Any) -> None:
        """Make the fault of that name.

        Raises:
            UnknownName: no such fault.
            InvalidInput: an argument that it does not take.
        """
        if name not in self._known:
            raise UnknownName("fault", name, self._known)
        try:
            self._known[name](**arguments)
        except TypeError as error:
            raise InvalidInput(f"fault {name}: {error}") from None

    def on_line(self, answers: list[Answer]) -> list[bytes]:
        """What reaches the other end of ``answers``."""
        sent = []
        for answer in answers:
            if self._drop.strikes(answer.servos):
                continue
            data = answer.data
            if self._corrupt.strikes(answer.servos):
                at = self._random.randrange(len(data))
                flipped = data[at] ^ (1 << self._random.randrange(8))
                data = data[:at] + bytes((flipped,)) + data[at + 1 :]
            sent.append(data)
        return sent

    def delay(self, seconds: float) -> None:
        """Answer so much later [s], 0 to `LONGEST_DELAY`."""
        if not 0 <= seconds <= LONGEST_DELAY:
            raise InvalidInput(f"delay is {seconds}; expected 0 to {LONGEST_DELAY} s")
        self.delay_seconds = seconds

    def silence(self, ids: list[int]) -> None:
        """Cut these servos off the line: they neither hear nor answer."""
        self._chain.silent |= set(ids)

    def speak(self, ids: list[int] | None = None) -> None:
        """Put silent servos (all, or these) back on the line."""
        self._chain.silent -= set(self._chain.silent if ids is None else ids)

    def overload(self, ids: list[int]) -> None:
        """Raise the overload error."""
        for servo in self._servos(ids):
            servo.fail(HardwareError.OVERLOAD)

    def overheat(self, ids: list[int], celsius: int = 85) -> None:
        """Let servos measure this temperature [C]."""
        for servo in self._servos(ids):
            servo.set_temperature(min(max(int(celsius), 0), 255))

    def voltage(self, volts: float, ids: list[int] | None = None) -> None:
        """Let servos (all, or these) measure this voltage [V]; too little of it resets them."""
        if not 0 <= volts <= 30:
            raise InvalidInput(f"voltage is {volts}; expected 0 to 30 V")
        for servo in self._servos(ids):
            servo.set_voltage(volts, self._chain.now)

    def block(self, ids: list[int], blocked: bool = True) -> None:
        """Hold the shafts of first-order joints fast, or let them go."""
        rows = getattr(self._chain.joints, "blocked", None)
        if rows is None:
            raise InvalidInput("fault block: only first-order joints can be blocked")
        for servo in self._servos(ids):
            rows[servo.row] = blocked

    def _servos(self, ids: list[int] | None) -> list[Any]:
        known = {servo.number: servo for servo in self._chain.servos}
        for number in ids or ():
            if number not in known:
                raise UnknownName("servo", number, [str(k) for k in known])
        return list(known.values()) if ids is None else [known[number] for number in ids]


class _Chance:
    """Strikes the next answers, or some of them at random."""

    def __init__(self, source: random.Random) -> None:
        self._random = source
        self._count, self._rate = 0, 0.0
        self._ids: set[int] | None = None

    def set(self, count: int = 0, rate: float = 0.0, ids: list[int] | None = None) -> None:
        if not (count >= 0 and 0 <= rate <= 1):
            raise InvalidInput(f"count is {count}, rate {rate}; expected >= 0, and 0 to 1")
        self._count, self._rate = int(count), float(rate)
        self._ids = None if ids is None else set(ids)

    def strikes(self, servos: tuple[int, ...]) -> bool:
        if self._ids is not None and not self._ids.intersection(servos):
            return False
        if self._count:
            self._count -= 1
            return True
        return self._rate > 0 and self._random.random() < self._rate
