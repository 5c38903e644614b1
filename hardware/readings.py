"""What the bus hands out: readings of registers per servo, pings, counts of what went wrong."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import NamedTuple

import numpy as np

from dexctl.exceptions import InvalidInput
from dexctl.state import Bools, Floats
from hardware.protocol import MAX_ID
from hardware.registers import ALERT, Register


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
        model: model number; those that are known: `hardware.models`.
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
        scale: SI units per raw unit, of each servo where their models differ.
    """

    register: Register
    ids: tuple[int, ...]
    raw: np.ndarray
    ok: Bools
    alert: Bools
    error: np.ndarray
    time: float
    scale: Floats | float

    @property
    def value(self) -> Floats:
        """SI values, ``(n,)`` in the register's unit; NaN where missing."""
        return np.where(self.ok, self.raw * self.scale, np.nan)

    @property
    def missing(self) -> tuple[int, ...]:
        """IDs of the servos without a value."""
        return tuple(np.array(self.ids)[~self.ok].tolist())


class Answer(NamedTuple):
    """What one servo answered.

    Attributes:
        error: the error byte, alert bit included.
        data: what it was asked for; empty where it refused.
    """

    error: int
    data: bytes


def cut_readings(
    registers: Sequence[Register],
    ids: tuple[int, ...],
    start: int,
    size: int,
    answers: dict[int, Answer],
) -> list[Readings]:
    """Readings of ``registers`` out of answers of ``size`` bytes from address ``start`` on."""
    now, empty, none = time.monotonic(), bytes(size), Answer(0, b"")
    rows = [answers.get(servo, none) for servo in ids]
    good = [bool(row.data) and not row.error & ~ALERT for row in rows]
    block = np.frombuffer(
        b"".join(row.data if fine else empty for row, fine in zip(rows, good, strict=True)),
        np.uint8,
    ).reshape(len(ids), size)
    ok = np.array(good, bool)
    error = np.array([row.error for row in rows], np.int64)
    found = []
    for register in registers:
        at = register.address - start
        kind = f"<{'i' if register.signed else 'u'}{register.size}"
        column = np.ascontiguousarray(block[:, at : at + register.size])
        raw = column.view(kind)[:, 0].astype(np.int64)
        found.append(
            Readings(
                register, ids, raw, ok, (error & ALERT) != 0, error & ~ALERT, now, register.scale
            )
        )
    return found


def joined(
    registers: Sequence[Register],
    ids: tuple[int, ...],
    parts: Sequence[tuple[Sequence[int], Sequence[Readings]]],
) -> list[Readings]:
    """Readings of servos of several models as one: (rows, readings of those rows) of each."""
    found = []
    for k, register in enumerate(registers):
        raw, error = np.zeros((2, len(ids)), np.int64)
        ok, alert = np.zeros((2, len(ids)), bool)
        scale, now = np.ones(len(ids)), 0.0
        for rows, readings in parts:
            part, at = readings[k], list(rows)
            raw[at], error[at], ok[at], alert[at] = part.raw, part.error, part.ok, part.alert
            scale[at], now = part.scale, max(now, part.time)
        found.append(Readings(register, ids, raw, ok, alert, error, now, scale))
    return found


def checked_id(servo: int) -> int:
    """The ID of one servo, or InvalidInput."""
    if isinstance(servo, bool) or not isinstance(servo, (int, np.integer)):
        raise InvalidInput(f"servo ID is {servo!r}; expected a whole number, 0 to {MAX_ID}")
    if not 0 <= servo <= MAX_ID:
        raise InvalidInput(f"servo ID is {servo}; expected 0 to {MAX_ID}")
    return int(servo)


def checked_ids(ids: Iterable[int]) -> tuple[int, ...]:
    """IDs of several servos, or InvalidInput."""
    found = tuple(checked_id(servo) for servo in ids)
    if not found or len(set(found)) != len(found):
        raise InvalidInput(f"servo IDs are {found}; expected at least one, none of them twice")
    return found
