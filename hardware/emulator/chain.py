"""The emulated servos on one line: what each instruction packet does, and who answers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from hardware import registers as R  # noqa: N812
from hardware.emulator.dynamics import Joints
from hardware.emulator.servo import Servo
from hardware.models import XM430_W210, ServoModel
from hardware.protocol import BROADCAST, Instruction, Packet, build_fast_status, build_status
from hardware.registers import StatusError

_FAST = (Instruction.FAST_SYNC_READ, Instruction.FAST_BULK_READ)
_CLEAR_TURNS = b"\x01\x44\x58\x4c\x22"  # the manual's key, lest it happen by accident


class Answer(NamedTuple):
    """Bytes on their way back, and the servos that wrote them."""

    servos: tuple[int, ...]
    data: bytes


class Chain:
    """Servos with IDs 1 to n, or those given, over one set of joints.

    Args:
        joints: the shafts.
        ids: of the servos; default 1 to n.
        zeros: ticks that each shows where its shaft is at 0 rad; default half a turn.
        signs: +1 or -1, which way each is mounted.
        fast: whether they know fast reads (older firmware does not).
        models: of the servos, one each; default XM430-W210.
    """

    def __init__(
        self,
        joints: Joints,
        ids: Sequence[int] | None = None,
        zeros: Sequence[int] | None = None,
        signs: Sequence[int] | None = None,
        fast: bool = True,
        models: Sequence[ServoModel] | None = None,
    ) -> None:
        count = len(joints.q)
        numbers = list(ids) if ids is not None else list(range(1, count + 1))
        at = list(zeros) if zeros is not None else [R.TICKS_PER_TURN // 2] * count
        way = list(signs) if signs is not None else [1] * count
        self.joints = joints
        self.fast = fast
        self.silent: set[int] = set()
        kinds = list(models) if models is not None else [XM430_W210] * count
        self.servos = [Servo(numbers[i], joints, i, at[i], way[i], kinds[i]) for i in range(count)]
        self.now = 0.0
        self._found: dict[int, Servo] = {}

    def servo(self, number: int) -> Servo | None:
        """The servo of that ID, if it is there and hears."""
        servo = self._found.get(number)
        if servo is None or servo.number != number:  # IDs can be written
            self._found = {servo.number: servo for servo in reversed(self.servos)}
            servo = self._found.get(number)
        return servo if servo is not None and self._hears(servo) else None

    def advance(self, now: float) -> None:
        """Let the joints move up to time ``now`` [s]."""
        if now > self.now:
            self.joints.advance(now - self.now)
            self.now = now

    def watch(self) -> None:
        """Let every servo look at its bus watchdog."""
        for servo in self.servos:
            servo.watch(self.now)

    def handle(self, packet: Packet) -> list[Answer]:
        """Carry out one instruction packet; returns the answers in the order of the line."""
        if packet.instruction == Instruction.STATUS:  # somebody else's answer
            return []
        for servo in self.servos:
            if self._hears(servo):
                servo.last_heard = self.now
        if packet.instruction in _FAST:
            return self._fast(packet)
        return [Answer((servo.number,), data) for servo, data in self._answers(packet)]

    def _hears(self, servo: Servo) -> bool:
        return servo.number not in self.silent and self.now >= servo.silent_until

    # -- instructions -------------------------------------------------------------------------

    def _answers(self, packet: Packet) -> Iterator[tuple[Servo, bytes]]:
        code, p = packet.instruction, packet.parameters
        if code == Instruction.SYNC_READ:
            yield from self._sync_read(p)
        elif code == Instruction.BULK_READ:
            yield from self._bulk_read(p)
        elif code == Instruction.SYNC_WRITE:
            self._sync_write(p)
        elif code == Instruction.BULK_WRITE:
            self._bulk_write(p)
        elif packet.id == BROADCAST:
            for servo in [s for s in self.servos if self._hears(s)]:
                number = servo.number
                error, data = self._single(servo, code, p)
                if code == Instruction.PING:
                    yield servo, build_status(number, error, data)
        else:
            servo = self.servo(packet.id)
            if servo is None:
                return
            number, level = servo.number, servo.return_level
            error, data = self._single(servo, code, p)
            least = (
                {Instruction.PING: 0, Instruction.READ: 1}.get(Instruction(code), 2)
                if (code in list(Instruction))
                else 2
            )
            if level >= least:
                yield servo, build_status(number, error, data)

    def _single(self, servo: Servo, code: int, p: bytes) -> tuple[int, bytes]:
        """Carry out an instruction to one servo; returns (error byte, data)."""
        length = StatusError.DATA_LENGTH | servo.error
        if code == Instruction.PING:
            return servo.error, bytes(servo.table[:2]) + bytes(servo.table[6:7])
        if code == Instruction.READ:
            return servo.read(_word(p, 0), _word(p, 2), self.now) if len(p) == 4 else (length, b"")
        if code == Instruction.WRITE:
            return (servo.write(_word(p, 0), p[2:]) if len(p) > 2 else length), b""
        if code == Instruction.REG_WRITE:
            if len(p) < 3:
                return length, b""
            servo.pending = (_word(p, 0), p[2:])
            servo.put(R.REGISTERED_INSTRUCTION, 1)
            return servo.error, b""
        if code == Instruction.ACTION:
            return self._action(servo), b""
        if code == Instruction.REBOOT:
            error = servo.error
            servo.reboot(self.now)
            return error, b""
        if code == Instruction.CLEAR:
            if p != _CLEAR_TURNS:
                return StatusError.DATA_RANGE | servo.error, b""
            servo.clear_turns()
            return servo.error, b""
        return StatusError.INSTRUCTION | servo.error, b""

    def _action(self, servo: Servo) -> int:
        if servo.pending is None:
            return StatusError.RESULT_FAIL | servo.error
        address, data = servo.pending
        servo.pending = None
        servo.put(R.REGISTERED_INSTRUCTION, 0)
        return servo.write(address, data)

    def _sync_read(self, p: bytes) -> Iterator[tuple[Servo, bytes]]:
        if len(p) < 5:
            return
        address, size = _word(p, 0), _word(p, 2)
        for number in dict.fromkeys(p[4:]):
            servo = self.servo(number)
            if servo is not None and servo.return_level >= 1:
                yield servo, build_status(number, *servo.read(address, size, self.now))

    def _bulk_read(self, p: bytes) -> Iterator[tuple[Servo, bytes]]:
        for number, address, size in _bulk_items(p):
            servo = self.servo(number)
            if servo is not None and servo.return_level >= 1:
                yield servo, build_status(number, *servo.read(address, size, self.now))

    def _sync_write(self, p: bytes) -> None:
        if len(p) < 5:
            return
        address, size = _word(p, 0), _word(p, 2)
        for start in range(4, len(p) - size, size + 1):
            servo = self.servo(p[start])
            if servo is not None:
                servo.write(address, p[start + 1 : start + 1 + size])

    def _bulk_write(self, p: bytes) -> None:
        start = 0
        while start + 5 <= len(p):
            number, address, size = p[start], _word(p, start + 1), _word(p, start + 3)
            data = p[start + 5 : start + 5 + size]
            servo = self.servo(number)
            if servo is not None and len(data) == size:
                servo.write(address, data)
            start += 5 + size

    def _fast(self, packet: Packet) -> list[Answer]:
        """One packet by all; it ends short where a servo is missing, as on a real line."""
        p = packet.parameters
        if not self.fast:
            return []
        if packet.instruction == Instruction.FAST_SYNC_READ:
            if len(p) < 5:
                return []
            items = [(number, _word(p, 0), _word(p, 2)) for number in dict.fromkeys(p[4:])]
        else:
            items = _bulk_items(p)
        parts: list[tuple[int, int, bytes]] = []
        sent = 8  # the header, up to the status instruction
        whole = True
        for number, address, size in items:
            servo = self.servo(number)
            found = servo is not None and servo.return_level >= 1
            error, data = servo.read(address, size, self.now) if servo is not None else (0, b"")
            whole = whole and found and len(data) == size
            sent += size + 4 if whole else 0
            parts.append((number, error, data.ljust(size, b"\0")))
        if not items or sent == 8:
            return []
        return [Answer(tuple(number for number, _, _ in parts), build_fast_status(parts)[:sent])]

    # -- what a person sees ---------------------------------------------------------------------

    def state(self) -> dict[str, object]:
        """Joints and errors, for the side channel."""
        j = self.joints
        return {
            "time": self.now,
            "ids": [servo.number for servo in self.servos],
            "position": np.round(j.q, 9).tolist(),
            "velocity": np.round(j.velocity, 9).tolist(),
            "torque": np.round(j.torque, 9).tolist(),
            "reference": np.round(j.reference, 9).tolist(),
            "torque_on": j.commands.torque_on.tolist(),
            "watchdog": [servo.get(R.BUS_WATCHDOG) for servo in self.servos],
            "hardware_error": [servo.get(R.HARDWARE_ERROR) for servo in self.servos],
        }


def _word(data: bytes, at: int) -> int:
    return data[at] | data[at + 1] << 8


def _bulk_items(p: bytes) -> list[tuple[int, int, int]]:
    return [(p[i], _word(p, i + 1), _word(p, i + 3)) for i in range(0, len(p) - 4, 5)]
