"""Starting an emulator in a process of its own, and steering it from a test."""

from __future__ import annotations

import contextlib
import json
import os
import select
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from typing import Any

from dexctl.settings import to_plain
from hardware.emulator.config import EmulatorConfig
from hardware.exceptions import BusError

START_TIMEOUT = 120.0  # s: MuJoCo has to settle a grasp first, on a busy machine
ANSWER_TIMEOUT = 30.0


class Emulator:
    """Emulated servos on a pseudo-terminal, in a process of their own; use it in a ``with``.

    The process ends when the block does, and also when this process dies however it dies: it
    watches its standard input.

    Args:
        servos: how many first-order joints.
        settings: others of `EmulatorConfig`, by name.

    Attributes:
        port: path of the pseudo-terminal.
        pid: of the process.

    Raises:
        BusError: it does not start; the message says why.
    """

    def __init__(self, servos: int = 15, **settings: Any) -> None:
        config = EmulatorConfig(servos=servos, **settings)
        command = [sys.executable, "-m", "hardware.emulator", json.dumps(to_plain(config))]
        self._lock = threading.Lock()
        self._line = b""
        # a session of its own: Ctrl-C in the terminal is for the run, and it may still be starting
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        )
        try:
            hello = self._receive(START_TIMEOUT)
            if "port" not in hello:
                raise BusError(f"the emulator does not start: {hello.get('error', hello)}")
        except BaseException:
            self.close()
            raise
        self.port: str = hello["port"]
        self.pid: int = self._process.pid

    def ask(self, do: str, **arguments: Any) -> Any:
        """Send one command to the side channel and return its result.

        Raises:
            BusError: the emulator refuses it, or is gone.
        """
        line = json.dumps({"do": do, **arguments}) + "\n"
        with self._lock:
            stdin = self._process.stdin
            assert stdin is not None
            try:
                stdin.write(line.encode())
                stdin.flush()
            except (OSError, ValueError):
                raise BusError("the emulator has ended") from None
            answer = self._receive(ANSWER_TIMEOUT)
        if not answer["ok"]:
            raise BusError(f"emulator: {answer['error']}")
        return answer["result"]

    # -- faults; each until undone, unless it says otherwise --------------------------------

    def fault(self, name: str, **arguments: Any) -> None:
        """Make a fault of `hardware.emulator.faults.Faults` by its name."""
        self.ask("fault", name=name, **arguments)

    def drop(self, count: int = 0, *, rate: float = 0.0, ids: Sequence[int] | None = None) -> None:
        """Lose the next ``count`` answers, or each with probability ``rate``."""
        self.fault("drop", count=count, rate=rate, ids=_list(ids))

    def corrupt(
        self, count: int = 0, *, rate: float = 0.0, ids: Sequence[int] | None = None
    ) -> None:
        """Flip a bit in the next ``count`` answers, or in each with probability ``rate``."""
        self.fault("corrupt", count=count, rate=rate, ids=_list(ids))

    def delay(self, seconds: float) -> None:
        """Answer so much later [s]; 0 ends it."""
        self.fault("delay", seconds=seconds)

    def silence(self, *ids: int) -> None:
        """Cut servos off the line."""
        self.fault("silence", ids=list(ids))

    def speak(self, *ids: int) -> None:
        """Put silent servos (all, or these) back on the line."""
        self.fault("speak", ids=list(ids) or None)

    def overload(self, *ids: int) -> None:
        """Raise the overload error of servos: their torque goes off until a reboot."""
        self.fault("overload", ids=list(ids))

    def overheat(self, *ids: int, celsius: int = 85) -> None:
        """Let servos measure this temperature [C]; above their limit they shut down."""
        self.fault("overheat", ids=list(ids), celsius=celsius)

    def voltage(self, volts: float, *ids: int) -> None:
        """Let servos (all, or these) measure this voltage [V]; below 6.5 V they reset."""
        self.fault("voltage", volts=volts, ids=list(ids) or None)

    def block(self, *ids: int, blocked: bool = True) -> None:
        """Hold shafts of first-order joints fast, or let them go."""
        self.fault("block", ids=list(ids), blocked=blocked)

    def unplug(self) -> None:
        """Pull the plug: the port vanishes; the servos keep their power and torque."""
        self.ask("unplug")

    def replug(self) -> str:
        """Plug in again; returns the new port."""
        self.port = self.ask("replug")
        return self.port

    # -- what is going on -------------------------------------------------------------------

    def advance(self, seconds: float) -> float:
        """Let time pass in a manual emulator; returns its time [s]."""
        return self.ask("advance", seconds=seconds)

    def reset(self) -> None:
        """Servos and joints as at the start, no faults; an unplugged port stays unplugged."""
        self.ask("reset")

    def state(self) -> dict[str, Any]:
        """Truth about the servos, a list entry each, in their order.

        Keys: time, ids, position, velocity, torque (of the shaft), reference (of the profile),
        torque_on, watchdog (raw), hardware_error (raw).
        """
        return self.ask("state")

    def support(self, supported: bool) -> None:
        """Hold the simulated object still, or let it go at once.

        It is held from the start until every finger has pressed on it for 0.3 s, with 1 N or nearly
        as much as in the settled grasp; or three fingers for 1 s.
        """
        self.ask("support", supported=supported)

    def turn(self, q: Sequence[float]) -> None:
        """Turn the limp shafts of first-order joints by hand, to ``(n,)`` [rad]."""
        self.ask("turn", q=[float(angle) for angle in q])

    def grasp(self) -> list[float] | None:
        """Set-points of the grasp that a simulated hand starts in [rad]; None where it is empty."""
        return self.ask("grasp")

    def touch(self) -> dict[str, Any] | None:
        """What the simulated fingertips feel, or None with first-order joints.

        Keys: time [s], age [s], in_contact, position [m], normal (into the object), force [N], one
        entry for each finger; supported (somebody holds the object still); object_position [m] and
        object_quaternion (wxyz), the truth; tracked_position and tracked_quaternion, as the
        scene's tracker tells them.
        """
        return self.ask("touch")

    # -- life -------------------------------------------------------------------------------

    def _receive(self, timeout: float) -> dict[str, Any]:
        stdout = self._process.stdout
        assert stdout is not None
        end = time.monotonic() + timeout
        while b"\n" not in self._line:
            ready, _, _ = select.select([stdout], [], [], max(end - time.monotonic(), 0.0))
            if not ready:
                raise BusError(f"the emulator says nothing for {timeout:g} s")
            data = os.read(stdout.fileno(), 65536)
            if not data:
                raise BusError(f"the emulator has ended (exit code {self._process.wait(10)})")
            self._line += data
        line, self._line = self._line.split(b"\n", 1)
        return json.loads(line)

    def close(self) -> None:
        """End the process and wait for it; harmless when repeated."""
        process = self._process
        if process.stdin is not None and not process.stdin.closed:
            with contextlib.suppress(OSError):
                process.stdin.close()
        try:
            process.wait(5)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        if process.stdout is not None:
            process.stdout.close()

    def __enter__(self) -> Emulator:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _list(ids: Sequence[int] | None) -> list[int] | None:
    return None if ids is None else list(ids)
