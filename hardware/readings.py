"""What the bus hands out: readings of registers per servo, pings, and counts of what went wrong."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import NamedTuple

import numpy as np

from dexctl.state import Bools, Floats
from hardware.registers import Register


@dataclass
class Statistics:
    """What has happened on the bus since it was opened.

    Attributes:
        packets: instruction packets sent.
        bytes_sent, bytes_received: on the port.
        retries: instructions that were sent again.
        timeouts: answers that did not come in time.
        crc_errors: packets that came damaged.
        skipped_bytes: bytes that belonged to no good packet.
        fast_fallbacks: fast reads that failed and were done again as plain ones.
        status_errors: answers in which a servo refused an instruction.
        alerts: answers with the alert bit set.
    """

    packets: int = 0
    bytes_sent: int = 0
    bytes_received: int = 0
    retries: int = 0
    timeouts: int = 0
    crc_errors: int = 0
    skipped_bytes: int = 0
    fast_fallbacks: int = 0
    status_errors: int = 0
    alerts: int = 0

    def as_dict(self) -> dict[str, int]:
        """The counts by name."""
        return asdict(self)


class Ping(NamedTuple):
    """Answer to a ping.

    Attributes:
        model: model number; 1030 is the XM430-W210.
        firmware: version.
        error: error byte of the answer; bit 0x80 is the alert.
    """

    model: int
    firmware: int
    error: int


@dataclass(frozen=True)
class Readings:
    """One register of n servos.

    Attributes:
        register: which one.
        ids: the servos, ``(n,)``.
        raw: raw values, ``(n,)`` int64; 0 where missing.
        ok: which servos answered with a value, ``(n,)``.
        alert: which of the answers carried the alert bit (a hardware error), ``(n,)``.
        error: error numbers of the answers without the alert bit, ``(n,)`` int; 0 where missing.
        time: when the answer was in, by `time.monotonic` [s].
    """

    register: Register
    ids: tuple[int, ...]
    raw: np.ndarray
    ok: Bools
    alert: Bools
    error: np.ndarray
    time: float

    @property
    def value(self) -> Floats:
        """SI values, ``(n,)`` in the register's unit; NaN where missing."""
        return np.where(self.ok, self.raw * self.register.scale, np.nan)

    @property
    def missing(self) -> tuple[int, ...]:
        """IDs of the servos without a value."""
        return tuple(np.array(self.ids)[~self.ok].tolist())
