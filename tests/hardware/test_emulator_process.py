"""The emulator's process: it answers, refuses, outlives no one, and takes random writes."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from dexctl.exceptions import DexctlError, InvalidInput
from dexctl.settings import from_plain
from dexctl.sim import SceneConfig
from hardware import registers as R  # noqa: N812
from hardware.bus import Bus
from hardware.emulator import Emulator
from hardware.emulator.__main__ import _chain
from hardware.emulator.config import EmulatorConfig
from hardware.exceptions import BusError


def gone(pid: int, seconds: float = 60.0) -> bool:
    """Whether a process ends; one that nobody has waited for counts as ended."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        try:
            with open(f"/proc/{pid}/stat") as stat:  # noqa: PTH123 (a file of the kernel's)
                if stat.read().rsplit(")", 1)[1].split()[0] == "Z":
                    return True
        except OSError:
            return True
        time.sleep(0.05)
    return False


def test_it_ends_with_its_block() -> None:
    with pytest.raises(ZeroDivisionError), Emulator(1) as emulator:
        raise ZeroDivisionError
    assert gone(emulator.pid)
    emulator.close()
    with pytest.raises(BusError, match="the emulator has ended"):
        emulator.state()


def test_ctrl_c_in_the_terminal_is_not_for_it() -> None:
    with Emulator(1) as emulator:  # from its first moment on, not only once it ignores SIGINT
        assert os.getsid(emulator.pid) == emulator.pid != os.getsid(0)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks into /proc")
def test_it_ends_when_its_starter_is_killed() -> None:
    script = (
        "import time\nfrom hardware.emulator import Emulator\n"
        "print(Emulator(1).pid, flush=True)\ntime.sleep(600)"
    )
    path = os.pathsep.join(filter(None, sys.path))
    starter = subprocess.Popen(
        [sys.executable, "-c", script],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": path},
    )
    assert starter.stdout is not None
    try:
        pid = int(starter.stdout.readline())
    finally:
        starter.send_signal(signal.SIGKILL)
        starter.wait()
        starter.stdout.close()
    assert gone(pid)


def test_settings_that_make_no_sense() -> None:
    teapot = {"dynamics": "mujoco", "scene": SceneConfig(object=("teapot",))}
    with pytest.raises(BusError, match="unknown object 'teapot'"):
        Emulator(**teapot)
    for settings, text in (  # what its process makes of others
        ({"servos": 0}, "0 joints; expected 1 to 252"),
        ({"servos": 2, "ids": [1, 1]}, "two servos share one"),
        ({"servos": 2, "ids": [1, 300]}, "ids has 300; expected 0 to 252"),
        ({"servos": 2, "zeros": [1]}, "1 zeros; expected 2"),
        ({"scene": {"hand": "claw"}}, "unknown hand 'claw'"),
        ({"servos": "many"}, "servos is 'many'; expected a whole number"),
    ):
        with pytest.raises(DexctlError, match=text):
            _chain(from_plain(EmulatorConfig, settings))


def test_side_channel_refuses(emulator: Emulator) -> None:
    with pytest.raises(BusError, match="unknown command 'dance'"):
        emulator.ask("dance")
    with pytest.raises(BusError, match="unknown fault 'fire'"):
        emulator.fault("fire")
    with pytest.raises(BusError, match="seconds is -1"):
        emulator.advance(-1)
    with pytest.raises(BusError, match="first-order joints hold no object"):
        emulator.support(False)
    assert emulator.touch() is None


def test_time_runs_by_itself() -> None:
    with Emulator(1) as emulator:
        with pytest.raises(BusError, match="the emulator's clock runs by itself"):
            emulator.advance(1.0)
        before = emulator.state()["time"]
        time.sleep(0.1)
        assert emulator.state()["time"] > before


def test_the_watchdog_over_the_wire(bus: Bus, emulator: Emulator) -> None:
    bus.write(R.OPERATING_MODE, 5)
    bus.write(R.BUS_WATCHDOG, 0.1)
    bus.write(R.TORQUE_ENABLE, 1)
    emulator.advance(0.09)
    assert bus.read(R.BUS_WATCHDOG).raw.tolist() == [5] * 15
    emulator.advance(0.15)
    assert bus.read(R.BUS_WATCHDOG).raw.tolist() == [-1] * 15
    goals = bus.read(R.GOAL_POSITION).raw
    bus.write(R.GOAL_POSITION, 1.0)  # silently lost, as on real servos
    assert (bus.read(R.GOAL_POSITION).raw == goals).all()


def test_random_writes_through_the_bus(bus: Bus, emulator: Emulator) -> None:
    """10,000 random writes: what leaves is in range, or nothing leaves."""
    source = np.random.default_rng(3)
    draw = random.Random(3)
    kinds = (0.0, np.nan, np.inf, -np.inf, 1e-300, 1e300)
    mute = (R.SERVO_ID, R.STATUS_RETURN_LEVEL)  # these would make servos unreachable
    registers = [register for register in R.REGISTERS if register not in mute]
    refused = 0
    for _ in range(10_000):
        register = draw.choice(registers)
        value = (
            draw.choice(kinds)
            if draw.random() < 0.2
            else source.normal() * 10 ** draw.randint(-3, 6)
        )
        before = bus.statistics.bytes_sent
        try:
            sent = bus.write(register, value, [draw.randint(1, 15)])
        except InvalidInput:
            refused += 1
            assert bus.statistics.bytes_sent == before
        else:
            raw = register.to_raw(sent)
            assert register.low <= raw[0] <= register.high
    assert 1000 < refused < 9900
    assert (np.abs(bus.read(R.GOAL_CURRENT).raw) <= R.CURRENT_LIMIT.high).all()
    goals = bus.read(R.GOAL_POSITION)
    assert goals.ok.all() and (np.abs(goals.raw) <= R.MULTI_TURN).all()
    assert len(emulator.state()["position"]) == 15
