"""Line: one exchange of packets with the servos, and what is counted on the way."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

from hardware.port import SerialPort
from hardware.protocol import Instruction, Packet, Parser
from hardware.readings import Answer, Statistics
from hardware.registers import ALERT

QUIET = 0.002  # s without a byte after which a late answer is taken to be over
_BITS_PER_BYTE = 10  # start and stop bit included


class Line:
    """Instruction packets out, status packets in, each exchange within its time.

    Args:
        port: open; the line closes it.
        timeout: how long an answer may take beyond its time on the wire [s].

    Attributes:
        counts: what happened so far; those of the parser are added by `statistics`.
    """

    def __init__(self, port: SerialPort, timeout: float) -> None:
        self.counts = Statistics()
        self._port, self._timeout = port, timeout
        self._parser = Parser()
        self._unsettled = False  # a late answer may still come

    @property
    def path(self) -> str:
        """Path of the port."""
        return self._port.path

    @property
    def descriptor(self) -> int:
        """See `SerialPort.descriptor`."""
        return self._port.descriptor

    @property
    def latency_timer(self) -> float | None:
        """See `SerialPort.latency_timer`."""
        return self._port.latency_timer

    def statistics(self) -> Statistics:
        """A copy of all counts."""
        return replace(
            self.counts, crc_errors=self._parser.crc_errors, skipped_bytes=self._parser.skipped
        )

    def close(self) -> None:
        """Give the port back."""
        self._port.close()

    def exchange(self, packet: bytes, ids: tuple[int, ...], size: int) -> dict[int, Answer]:
        """Send ``packet`` and take the status packet of each servo, until all or the time is in.

        An answer that carries an error number and no data counts as one; an answer of another size
        is none.
        """
        answers: dict[int, Answer] = {}

        def take(found: Packet) -> bool:
            if found.id in ids and found.id not in answers:
                data, error = found.data, found.error
                if len(data) == size or (error & ~ALERT and not data):
                    answers[found.id] = Answer(error, data)
                    self.count_errors(error)
            return len(answers) == len(ids)

        self.collect(packet, len(ids) * (11 + size), take, missing=len(ids), answers=answers)
        return answers

    def collect(
        self,
        packet: bytes,
        expected: int,
        take: Callable[[Packet], bool],
        missing: int = 1,
        answers: dict[int, Answer] | None = None,
    ) -> Packet | None:
        """Send ``packet``, give status packets to ``take`` until it says True; returns the last.

        None, and a count of timeouts, where that does not happen in time. ``expected`` is the
        number of bytes of the answer.
        """
        self.settle()
        self._port.clear()
        self._parser.clear()
        self.send(packet)
        wire = (len(packet) + expected) * _BITS_PER_BYTE / self._port.baudrate
        deadline = time.monotonic() + self._timeout + wire
        while data := self._port.receive(deadline):
            self.counts.bytes_received += len(data)
            for found in self._parser.feed(data):
                if found.instruction == Instruction.STATUS and take(found):
                    return found
            if time.monotonic() > deadline:  # a babbling line must not hold us
                break
        self.counts.timeouts += missing - len(answers or ())
        self._unsettled = True
        return None

    def gather(self, packet: bytes, seconds: float) -> list[Packet]:
        """Send ``packet`` and take every status packet that comes within ``seconds``."""
        self.settle()
        self._port.clear()
        self._parser.clear()
        self.send(packet)
        found: list[Packet] = []
        deadline = time.monotonic() + seconds
        while data := self._port.receive(deadline):
            self.counts.bytes_received += len(data)
            found += [p for p in self._parser.feed(data) if p.instruction == Instruction.STATUS]
            if time.monotonic() > deadline:
                break
        return found

    def settle(self) -> None:
        """After a timeout, let a late answer pass before the next instruction."""
        if not self._unsettled:
            return
        self._unsettled = False
        end = time.monotonic() + self._timeout
        while time.monotonic() < end and self._port.receive(time.monotonic() + QUIET):
            pass

    def send(self, packet: bytes) -> None:
        """Send an instruction that nobody answers, or whose answer `collect` takes."""
        self._port.send(packet, self._timeout)
        self.counts.packets += 1
        self.counts.bytes_sent += len(packet)

    def count_errors(self, error: int) -> None:
        """Count what an error byte says."""
        if error:
            self.counts.alerts += bool(error & ALERT)
            self.counts.status_errors += bool(error & ~ALERT)
