"""Bus: a client for Dynamixel servos that says what happened to each of them.

It opens the port with dynamixel-sdk (see `hardware.port`) and brings its own packet layer,
`hardware.protocol`, because the SDK's

- gives up a whole sync read for one silent servo, and drops every servo's alert bit there;
- spins on the processor while it waits, 34 ms and more before it gives up;
- leaves ``port.is_using`` set when a port vanishes, after which not even torque-off is sent;
- never locks the port, so that two programs can talk over each other.

The SDK and rustypot are the independent witnesses in the tests.
"""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from dexctl.exceptions import InvalidInput
from dexctl.state import Floats
from hardware.exceptions import ServoError
from hardware.guarding import Guard
from hardware.line import Line
from hardware.models import BY_NUMBER, ServoModel, known_numbers
from hardware.port import SerialPort
from hardware.protocol import (
    BROADCAST,
    MAX_ID,
    Instruction,
    build,
    split_fast_status,
)
from hardware.readings import (
    Answer,
    Ping,
    Readings,
    Statistics,
    checked_id,
    checked_ids,
    cut_readings,
    joined,
)
from hardware.registers import ALERT, MODEL, TORQUE_ENABLE, Register, describe_status_error

REBOOT_TIMEOUT = 3.0  # s until a rebooted servo must answer
EVERYONE_SECONDS = 0.8  # the servo of the highest ID answers last, 3 ms after each one before it
FAST_TRIALS = 3  # fast reads that may fail before the servos count as not knowing them
FAST_PAUSE = 50  # plain reads after a servo was missing, before a fast one is tried again


class Bus:
    """Servos on one port; use it in a ``with``.

    Every call returns or raises within about (retries + 2) x 2 timeouts, whatever the other end
    does. A servo that stays silent is marked in the readings and costs the others nothing but that
    time. Calls from several threads wait for each other.

    Protocol 2.0 numbers no packets, so an answer that comes later than ``timeout`` could be taken
    for that of the next read: after a timeout the bus waits until the line has been quiet for
    2 ms. Choose a timeout longer than the adapter's latency timer.

    Args:
        port: path of the device, such as "/dev/ttyUSB0".
        ids: the servos that calls without ``ids`` mean, in this order.
        baudrate: [bit/s].
        timeout: how long an answer may take beyond its time on the wire [s].
        retries: how often an instruction is sent again for the servos that did not answer.

    Attributes:
        ids: as given.
        models: of the servos that `identify` has asked; others are taken for an XM430-W210.
        statistics: counts since the bus was opened.

    Raises:
        InvalidInput: an argument out of range.
        MissingExtra: dynamixel-sdk is not installed.
        PortBusy, PortLost, BusError: the port cannot be opened.
    """

    def __init__(
        self,
        port: str,
        ids: Sequence[int],
        *,
        baudrate: int = 4_000_000,
        timeout: float = 0.01,
        retries: int = 1,
    ) -> None:
        self.ids = checked_ids(ids)
        if not (np.isfinite(timeout) and 0 < timeout <= 10):
            raise InvalidInput(f"timeout is {timeout}; expected seconds above 0, up to 10")
        if not 0 <= retries <= 20:
            raise InvalidInput(f"retries is {retries}; expected 0 to 20")
        self.timeout = float(timeout)
        self.retries = int(retries)
        self._lock = threading.Lock()
        self.models: dict[int, ServoModel] = {}
        self._grouped: dict[tuple[int, ...], list[tuple[ServoModel | None, list[int]]]] = {}
        self._fast: bool | None = None
        self._fast_failures = 0
        self._fast_pause = 0
        self._sync_read_packets: dict[tuple[int, int, int, tuple[int, ...]], bytes] = {}
        self._line = Line(SerialPort(port, baudrate), self.timeout)

    # -- public calls ---------------------------------------------------------------------------

    @property
    def port(self) -> str:
        """Path of the device."""
        return self._line.path

    @property
    def latency_timer(self) -> float | None:
        """Latency timer of an FTDI adapter [s], None for other ports; it should be 1 ms."""
        return self._line.latency_timer

    @property
    def fast(self) -> bool | None:
        """Whether the servos know fast sync reads; None before the first read of several."""
        return self._fast

    @property
    def statistics(self) -> Statistics:
        """Counts since the bus was opened (a copy)."""
        return self._line.statistics()

    def ping(self, servo: int) -> Ping:
        """Ask one servo who it is.

        Raises:
            ServoError: it does not answer.
        """
        with self._lock:
            answer = self._ask(servo, Instruction.PING, b"", 3)
        model, firmware = struct.unpack("<HB", answer.data)
        return Ping(model, firmware, answer.error)

    def scan(self, ids: Iterable[int] = range(1, MAX_ID + 1)) -> dict[int, Ping]:
        """Ping each ID by itself, without retries; returns those that answer."""
        found = {}
        for servo in ids:
            with self._lock:
                answer = self._once(servo, build(checked_id(servo), Instruction.PING), 3)
            if answer is not None:
                found[servo] = Ping(*struct.unpack("<HB", answer.data), answer.error)
        return found

    def read(self, register: Register, ids: Sequence[int] | None = None) -> Readings:
        """Read one register of servos (default: all); silent servos are marked, not raised.

        Raises:
            PortLost: the port has vanished.
        """
        return self.read_many([register], ids)[0]

    def read_many(
        self, registers: Sequence[Register], ids: Sequence[int] | None = None
    ) -> list[Readings]:
        """Read several registers in one go, all from the same instant of each servo.

        Everything from the lowest to the highest address goes over the wire, so neighbours are
        cheap: present current, velocity and position are ten bytes.

        Returns:
            Readings of each register, in the order given.

        Raises:
            PortLost: the port has vanished.
        """
        if not registers:
            raise InvalidInput("no registers to read")
        chosen = self.ids if ids is None else checked_ids(ids)
        groups = []
        for model, rows in self._groups(chosen):
            own = [model.register(register) for register in registers] if model else registers
            start = min(register.address for register in own)
            groups.append((own, rows, (start, max(register.end for register in own) - start)))
        answers: dict[int, Answer] = {}
        with self._lock:
            for span in dict.fromkeys(span for _, _, span in groups):  # one, where models agree
                rows = sorted(row for _, some, other in groups if other == span for row in some)
                answers |= self._sync_read(span[0], span[1], tuple(chosen[row] for row in rows))
        cut = []
        for own, rows, (start, size) in groups:
            some = tuple(chosen[row] for row in rows)
            cut.append((rows, cut_readings(own, some, start, size, answers)))
        return cut[0][1] if len(cut) == 1 else joined(registers, chosen, cut)

    def write(
        self, register: Register, value: ArrayLike, ids: Sequence[int] | None = None
    ) -> Floats:
        """Write SI values to servos (default: all) in one sync write; no servo confirms it.

        Args:
            register: which one.
            value: ``(n,)`` or one number for all, in the register's unit.
            ids: which servos, n of them.

        Returns:
            What was sent: the values rounded to the register's resolution, ``(n,)``.

        Raises:
            InvalidInput: a value that is not finite or out of the register's range (then nothing
                is sent), or a register that is read-only.
            PortLost: the port has vanished.
        """
        chosen = self.ids if ids is None else checked_ids(ids)
        raw, scale, own = self.to_raw(register, value, chosen)
        packets = []
        for known in dict.fromkeys(own):
            rows = [row for row, other in enumerate(own) if other is known]
            packets.append(_sync_write(known, raw[rows], tuple(chosen[row] for row in rows)))
        with self._lock:
            self._line.settle()
            for packet in packets:
                self._line.send(packet)
        return raw * scale

    def to_raw(
        self, register: Register, value: ArrayLike, ids: Sequence[int]
    ) -> tuple[np.ndarray, Floats, list[Register]]:
        """Raw values ``(n,)``, SI units per raw unit ``(n,)`` and each servo's own register.

        Raises:
            InvalidInput: a value not finite or out of a servo's range, or a read-only register.
        """
        count = len(ids)
        values = np.asarray(value, np.float64)
        if values.shape not in ((), (1,), (count,)):
            raise InvalidInput(
                f"{register.name} has values of shape {values.shape}; expected one, or ({count},)"
            )
        values = np.broadcast_to(values.reshape(-1), (count,))
        raw, scale, own = np.zeros(count, np.int64), np.ones(count), [register] * count
        for model, rows in self._groups(tuple(ids)):
            known = model.register(register) if model else register
            if not known.writable:
                raise InvalidInput(f"{known.name} is read-only")
            raw[rows], scale[rows] = known.to_raw(values[rows]), known.scale
            for row in rows:
                own[row] = known
        return raw, scale, own

    def identify(self, ids: Sequence[int] | None = None, attempts: int = 6) -> list[ServoModel]:
        """Ask servos (default: all) for their models; from then on their registers are theirs.

        Raises:
            ServoError: a servo does not answer, or is of a model that nobody has described.
        """
        chosen = self.ids if ids is None else checked_ids(ids)
        found = self.read(MODEL, chosen)
        for _ in range(attempts - 1):
            if found.ok.all():
                break
            found = self.read(MODEL, chosen)
        if found.missing:
            raise ServoError(
                f"no answer from servo {', '.join(map(str, found.missing))} about its model: check "
                "cable, power and ID",
                found.missing[0],
                answered=False,
            )
        for servo, number in zip(chosen, found.raw.tolist(), strict=True):
            if number not in BY_NUMBER:
                raise ServoError(
                    f"servo {servo} has model {number}; expected one of {known_numbers()}", servo
                )
            self.models[servo] = BY_NUMBER[number]
        self._grouped.clear()
        return [self.models[servo] for servo in chosen]

    def everyone(self) -> dict[int, Ping]:
        """All servos that answer a ping to everybody, by ID; takes 0.8 s."""
        with self._lock:
            answers = self._line.gather(build(BROADCAST, Instruction.PING), EVERYONE_SECONDS)
        return {
            packet.id: Ping(*struct.unpack("<HB", packet.data), packet.error)
            for packet in answers
            if len(packet.data) == 3
        }

    def _groups(self, ids: tuple[int, ...]) -> list[tuple[ServoModel | None, list[int]]]:
        """Rows of ``ids`` by model; None: not asked yet, taken for an XM430-W210."""
        groups = self._grouped.get(ids)
        if groups is None:
            by_model: dict[ServoModel | None, list[int]] = {}
            for row, servo in enumerate(ids):
                by_model.setdefault(self.models.get(servo), []).append(row)
            groups = list(by_model.items())
            if len(self._grouped) < 256:
                self._grouped[ids] = groups
        return groups

    def guard(self, ids: Sequence[int] | None = None) -> Guard:
        """Start a process that takes the torque of servos (default: all) off if this one dies.

        Raises:
            BusError: it cannot be started, or the port is closed.
        """
        chosen = self.ids if ids is None else checked_ids(ids)
        packet = _sync_write(TORQUE_ENABLE, np.zeros(len(chosen), np.int64), chosen)
        return Guard(self._line.descriptor, packet)

    def write_checked(self, register: Register, value: float, servo: int) -> float:
        """Write one SI value to one servo, which confirms it; returns what was sent.

        Raises:
            InvalidInput: as for :meth:`write`.
            ServoError: the servo refuses it, or does not answer.
            PortLost: the port has vanished.
        """
        values, scale, (known,) = self.to_raw(register, value, (checked_id(servo),))
        raw = int(values[0])
        what = f"write {known.name} = {raw}"
        parameters = struct.pack("<H", known.address) + known.encode(raw)
        with self._lock:
            answer = self._ask(servo, Instruction.WRITE, parameters, 0, what)
        _raise_refusal(answer.error, servo, what)
        return float(raw * scale[0])

    def reboot(self, servo: int) -> Ping:
        """Restart one servo and wait until it answers: torque off, errors and turns forgotten.

        Raises:
            ServoError: it does not answer within `REBOOT_TIMEOUT`.
        """
        with self._lock:
            self._once(checked_id(servo), build(servo, Instruction.REBOOT), 0)
            deadline = time.monotonic() + REBOOT_TIMEOUT
            while time.monotonic() < deadline:
                time.sleep(0.02)
                answer = self._once(servo, build(servo, Instruction.PING), 3)
                if answer is not None:
                    return Ping(*struct.unpack("<HB", answer.data), answer.error)
        raise ServoError(
            f"servo {servo} does not answer {REBOOT_TIMEOUT:g} s after its reboot",
            servo,
            answered=False,
        )

    def close(self) -> None:
        """Give the port back. Torque stays as it is."""
        self._line.close()

    def __enter__(self) -> Bus:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # -- one servo --------------------------------------------------------------------------------

    def _ask(
        self, servo: int, code: Instruction, parameters: bytes, size: int, what: str = ""
    ) -> Answer:
        """The answer of one servo, sent again where it does not come."""
        packet = build(checked_id(servo), code, parameters)
        for attempt in range(self.retries + 1):
            self._line.counts.retries += attempt > 0
            answer = self._once(servo, packet, size)
            if answer is not None:
                return answer
        raise ServoError(
            f"servo {servo} does not answer ({what or code.name.lower()}, "
            f"{self.retries + 1} attempts); check its ID, cable and power, and the baud rate",
            servo,
            answered=False,
        )

    def _once(self, servo: int, packet: bytes, size: int) -> Answer | None:
        answers = self._line.exchange(packet, (servo,), size)
        return answers.get(servo)

    # -- several servos ---------------------------------------------------------------------------

    def _sync_read(self, start: int, size: int, ids: tuple[int, ...]) -> dict[int, Answer]:
        tried = len(ids) > 1 and self._fast is not False and self._fast_pause == 0
        if tried:
            together = self._fast_read(start, size, ids)
            if together is not None:
                return together
            self._line.counts.fast_fallbacks += 1
        self._fast_pause = max(self._fast_pause - 1, 0)
        answers: dict[int, Answer] = {}
        for attempt in range(self.retries + 1):
            missing = tuple(servo for servo in ids if servo not in answers)
            self._line.counts.retries += attempt > 0
            packet = self._read_packet(Instruction.SYNC_READ, start, size, missing)
            answers |= self._line.exchange(packet, missing, size)
            if len(answers) == len(ids):
                break
        if tried:  # a plain read that followed no fast one says nothing about it
            self._judge_fast(complete=len(answers) == len(ids))
        return answers

    def _fast_read(self, start: int, size: int, ids: tuple[int, ...]) -> dict[int, Answer] | None:
        """Answers of all servos in one packet; None if it is not whole."""
        packet = self._read_packet(Instruction.FAST_SYNC_READ, start, size, ids)
        found = self._line.collect(packet, 10 + len(ids) * (size + 4), lambda p: p.id == BROADCAST)
        if found is None:
            return None
        parts = split_fast_status(found.parameters, size)
        answers = {servo: Answer(error, data) for servo, error, data in parts}
        whole = all(len(data) == size for _, _, data in parts)
        if len(parts) != len(ids) or answers.keys() != set(ids) or not whole:
            return None
        self._fast, self._fast_failures = True, 0
        for answer in answers.values():
            self._line.count_errors(answer.error)
        return answers

    def _judge_fast(self, complete: bool) -> None:
        """After a plain read: was it the fast read that failed before, or a servo?"""
        if not complete:
            self._fast_pause = FAST_PAUSE
        elif self._fast is None:
            self._fast_failures += 1
            if self._fast_failures >= FAST_TRIALS:
                self._fast = False

    def _read_packet(self, code: Instruction, start: int, size: int, ids: tuple[int, ...]) -> bytes:
        key = (code, start, size, ids)
        packet = self._sync_read_packets.get(key)
        if packet is None:
            packet = build(BROADCAST, code, struct.pack("<HH", start, size) + bytes(ids))
            if len(self._sync_read_packets) < 256:
                self._sync_read_packets[key] = packet
        return packet


def _sync_write(register: Register, raw: np.ndarray, ids: tuple[int, ...]) -> bytes:
    """The packet that writes raw values ``(n,)`` to n servos."""
    fields = raw.astype(f"<i{register.size}")[:, None].view(np.uint8)
    rows = np.concatenate([np.array(ids, np.uint8)[:, None], fields], axis=1)
    head = struct.pack("<HH", register.address, register.size)
    return build(BROADCAST, Instruction.SYNC_WRITE, head + rows.tobytes())


def _raise_refusal(error: int, servo: int, what: str) -> None:
    if error & ~ALERT:
        raise ServoError(
            f"servo {servo} refuses to {what}: {describe_status_error(error)}",
            servo,
            status=error & ~ALERT,
            alert=bool(error & ALERT),
        )
