"""The emulator's loop: a pseudo-terminal on one side, a side channel for tests on the other.

The side channel is standard input and output, one JSON object a line: ``{"do": "fault", "name":
"silence", "ids": [3]}`` is answered by ``{"ok": true, "result": null}`` or ``{"ok": false,
"error": "..."}``. When standard input ends the emulator ends, so it never outlives whoever
started it.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import sys
import termios
import time
import tty
from collections.abc import Callable
from typing import Any

from dexctl.exceptions import DexctlError, InvalidInput, UnknownName
from hardware.emulator.chain import Chain
from hardware.emulator.faults import Faults
from hardware.protocol import Parser

IDLE = 0.02  # s between looks at a line that nobody has opened
LONGEST_CATCH_UP = 0.5  # s of motion made up after the process was kept waiting


class Server:
    """Serves a chain of servos on a pseudo-terminal until told to stop.

    Args:
        build: makes the servos, now and at every reset.
        manual: time stands still but for ``{"do": "advance", "seconds": s}``; else it is the
            clock's.
        seed: of faults that strike at random.
        baudrate: what the other end must have set to be heard [bit/s]; None: anything.

    Attributes:
        chain: the servos.
        port: path of the pseudo-terminal; None while unplugged.
    """

    def __init__(
        self,
        build: Callable[[], Chain],
        manual: bool = False,
        seed: int = 0,
        baudrate: int | None = None,
    ) -> None:
        self._build, self._seed = build, seed
        self._speed = None if baudrate is None else _speed(baudrate)
        self._time = time.monotonic
        self._reset()
        self.port: str | None = None
        self._manual = manual
        self._parser = Parser()
        self._master = -1
        self._poll = select.poll()
        self._line = bytearray()
        self._running = True
        self._packets = 0
        self._commands: dict[str, Callable[..., Any]] = {
            "fault": lambda name, **arguments: self.faults.make(name, **arguments),
            "advance": self._advance,
            "state": lambda: self.chain.state(),
            "support": lambda supported: self.chain.joints.support(supported),
            "grasp": lambda: self.chain.joints.grasp(),
            "touch": lambda: self.chain.joints.touch(),
            "turn": lambda q: self.chain.joints.turn(q),
            "reset": self._reset,
            "unplug": self._unplug,
            "replug": self._plug,
            "count": lambda: {"packets": self._packets, "crc_errors": self._parser.crc_errors},
            "stop": self._stop,
        }
        self._plug()

    def serve(self) -> None:
        """Run until standard input ends or ``stop`` is asked for."""
        stdin = sys.stdin.fileno()
        self._poll.register(stdin, select.POLLIN)
        wait = max(self.chain.joints.timestep, 0.005) * 1000
        while self._running:
            hung_up = False
            for descriptor, event in self._poll.poll(wait):
                if descriptor == stdin:
                    self._take_commands(stdin)
                elif event & select.POLLIN:
                    self._take_packets()
                else:
                    hung_up = True  # nobody has the line open
            if hung_up:
                time.sleep(IDLE)
            # Packets first: those that wait because this process was kept waiting are not silence.
            self._tick()
            self.chain.watch()
        self._unplug()

    # -- the line -----------------------------------------------------------------------------

    def _plug(self) -> str:
        if self.port is None:
            master, slave = os.openpty()
            tty.setraw(slave, termios.TCSANOW)
            self.port = os.ttyname(slave)
            os.close(slave)
            os.set_blocking(master, False)
            self._master = master
            self._parser.clear()
            self._poll.register(master, select.POLLIN)
        return self.port

    def _unplug(self) -> None:
        if self.port is not None:
            self._poll.unregister(self._master)
            os.close(self._master)
            self._master, self.port = -1, None

    def _take_packets(self) -> None:
        try:
            data = os.read(self._master, 4096)
        except (BlockingIOError, OSError):
            return
        self._tick()
        if self._speed is not None and termios.tcgetattr(self._master)[5] != self._speed:
            return  # at another speed it is noise
        for packet in self._parser.feed(data):
            self._packets += 1
            answers = self.chain.handle(packet)
            if answers:
                self._send(self.faults.on_line(answers))

    def _send(self, parts: list[bytes]) -> None:
        if self.faults.delay_seconds:
            time.sleep(self.faults.delay_seconds)
        # A reader that never reads must not stop the servos: what does not fit is lost.
        with contextlib.suppress(BlockingIOError, OSError):
            os.write(self._master, b"".join(parts))

    # -- time and side channel ------------------------------------------------------------------

    def _tick(self) -> None:
        now = self._time()
        passed, self._last = now - self._last, now
        if not self._manual:
            self.chain.advance(self.chain.now + min(passed, LONGEST_CATCH_UP))

    def _advance(self, seconds: float) -> float:
        if not self._manual:
            raise InvalidInput("advance: the emulator's clock runs by itself; start it manual")
        if not 0 <= seconds <= 3600:
            raise InvalidInput(f"seconds is {seconds}; expected 0 to 3600")
        end = self.chain.now + seconds
        while self.chain.now < end - 1e-9:  # in pieces, so that watchdogs trip on time
            self.chain.advance(min(self.chain.now + 0.005, end))
            self.chain.watch()
        return self.chain.now

    def _reset(self) -> None:
        self.chain = self._build()
        self.faults = Faults(self.chain, self._seed)
        self._last = self._time()

    def _stop(self) -> None:
        self._running = False

    def _take_commands(self, stdin: int) -> None:
        data = os.read(stdin, 65536)
        if not data:
            self._running = False
        self._line += data
        while (end := self._line.find(b"\n")) >= 0:
            line = bytes(self._line[:end])
            del self._line[: end + 1]
            if line.strip():
                say(self._obey(line))

    def _obey(self, line: bytes) -> dict[str, Any]:
        try:
            asked = json.loads(line)
            if not isinstance(asked, dict) or not isinstance(asked.get("do"), str):
                raise InvalidInput('expected a line like {"do": "state"}')
            name = asked.pop("do")
            if name not in self._commands:
                raise UnknownName("command", name, self._commands)
            return {"ok": True, "result": self._commands[name](**asked)}
        except (DexctlError, ValueError, TypeError) as error:
            return {"ok": False, "error": str(error)}


def _speed(baudrate: int) -> int:
    """The terminal's own number for a speed."""
    found = getattr(termios, f"B{baudrate}", None)
    if found is None:
        raise InvalidInput(f"baudrate is {baudrate}; no terminal has it")
    return found


def say(message: dict[str, Any]) -> None:
    """One line of JSON on standard output."""
    print(json.dumps(message), flush=True)
