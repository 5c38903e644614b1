"""Commands as a person at a hand types them: processes on a terminal, a port instead of --emulate.

Behind the port are emulated servos all the same, mounted in ways that nobody has told the commands.
"""

from __future__ import annotations

import contextlib
import json
import os
import pty
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import dexctl
from hardware.calibration import Calibration
from hardware.emulator import Emulator
from hardware.log import read_log

# Real-time loops: on a machine that others keep busy their deadlines pass, as they should.
pytestmark = pytest.mark.slow

# the command line without an installed entry point
MAIN = """
import sys
from importlib.metadata import EntryPoint
from dexctl.cli import commands, main
commands.entry_points = lambda group: [EntryPoint("hardware", "hardware.cli:COMMANDS", group)]
sys.exit(main())
"""
ENVIRONMENT = {
    **os.environ,
    "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
    "COLUMNS": "200",
}
SIGNS = [1, -1, 1] * 5
ZEROS = [(37 + 509 * i) % 4096 for i in range(15)]  # some wrap within the travel


class Terminal:
    """A command with a terminal for input and output."""

    def __init__(self, *words: str) -> None:
        self._master, slave = pty.openpty()
        command = [sys.executable, "-c", MAIN, "hardware", *words]
        self.process = subprocess.Popen(
            command, stdin=slave, stdout=slave, stderr=slave, env=ENVIRONMENT
        )
        os.close(slave)
        self.said = ""

    def wait_for(self, text: str, timeout: float = 60.0) -> str:
        """What was said up to ``text`` since the last such call."""
        end = time.monotonic() + timeout
        while text not in self.said and time.monotonic() < end:
            if select.select([self._master], [], [], 0.1)[0]:
                try:
                    self.said += os.read(self._master, 4096).decode(errors="replace")
                except OSError:  # the process has ended
                    break
        assert text in self.said, self.said
        before, self.said = self.said.split(text, 1)
        return before

    def press_enter(self) -> None:
        os.write(self._master, b"\n")

    def finish(self, timeout: float = 60.0) -> tuple[int, str]:
        """Exit code, and what was said at last."""
        with contextlib.suppress(AssertionError):
            self.wait_for("\x04 never said", timeout)
        return self.process.wait(timeout), self.said.replace("\r\n", "\n")

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        os.close(self._master)


@pytest.fixture
def emulator(dex5: dexctl.HandModel) -> Iterator[Emulator]:
    with Emulator(15, zeros=ZEROS, signs=SIGNS) as emulator:
        yield emulator


@pytest.fixture
def terminal() -> Iterator[list[Terminal]]:
    opened: list[Terminal] = []
    yield opened
    for one in opened:
        one.close()


def test_a_person_calibrates_and_checks(
    emulator: Emulator, terminal: list[Terminal], dex5: dexctl.HandModel, tmp_path: Path
) -> None:
    path = tmp_path / "hand.toml"
    shell = Terminal("calibrate", "--port", emulator.port, "--patience", "10", "--out", str(path))
    terminal.append(shell)
    q = np.full(15, 0.3)
    emulator.turn(q.tolist())
    shell.wait_for("put all joints at zero, as the model draws them, and press Enter")
    q[:] = 0.0
    emulator.turn(q.tolist())
    shell.press_enter()
    for end, angles in (("upper", dex5.upper), ("lower", dex5.lower)):
        for i, joint in enumerate(dex5.joint_names):
            shell.wait_for(f"turn {joint} to its {end} end, and press Enter")
            q[i] = angles[i]
            emulator.turn(q.tolist())
            shell.press_enter()
    code, said = shell.finish()
    assert code == 0 and f"written: {path}; torque off" in said
    found = Calibration.load(path)
    np.testing.assert_array_equal(found.sign, SIGNS)
    turned = (found.zero - np.array(ZEROS) * 2 * np.pi / 4096 + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(turned, 0.0, atol=2e-3)
    np.testing.assert_allclose(found.lower, dex5.lower, atol=4e-3)
    np.testing.assert_allclose(found.upper, dex5.upper, atol=4e-3)

    emulator.turn([0.05] * 15)
    words = ["--port", emulator.port, "--patience", "10", "--calibration", str(path)]
    shell = Terminal("check", "--move", *words)
    terminal.append(shell)
    for joint in dex5.joint_names:  # one after the other, each named before it moves
        shell.wait_for(f"moving {joint}")
    code, said = shell.finish()
    assert code == 0, said
    assert "all is well" in said and "torque off, confirmed by all 15 servos" in said
    for joint in dex5.joint_names:
        asked, moved = (
            float(word.rstrip(","))
            for word in said.split(f"{joint}: asked ")[1].split("\n")[0].split()[::3]
        )
        assert abs(asked) == pytest.approx(0.12, abs=1e-3)
        assert moved == pytest.approx(asked, abs=0.02)
    np.testing.assert_allclose(emulator.state()["position"], 0.05, atol=0.02)
    assert not any(emulator.state()["torque_on"])


def test_a_joint_that_is_held_fast_shows(
    emulator: Emulator, terminal: list[Terminal], dex5: dexctl.HandModel, tmp_path: Path
) -> None:
    ones = np.ones(15)
    zero = np.array(ZEROS) * 2 * np.pi / 4096
    Calibration(hand="dex5", joint_names=tuple(dex5.joint_names), servo=np.arange(1, 16),
                sign=np.array(SIGNS), zero=zero, lower=dex5.lower, upper=dex5.upper,
                torque_constant=1.3 * ones).save(tmp_path / "hand.toml")  # fmt: skip
    emulator.block(6)
    words = ["--port", emulator.port, "--patience", "10", "--json"]
    shell = Terminal("check", "--move", "--calibration", str(tmp_path / "hand.toml"), *words)
    terminal.append(shell)
    code, said = shell.finish()
    assert code == 1
    found = json.loads(said[said.index("{") :])
    (problem,) = found["problems"]
    assert f"{dex5.joint_names[5]} was asked to move" in problem and "moved by 0.00" in problem
    assert found["torque"] == "torque off, confirmed by all 15 servos"


def test_calibrating_without_a_terminal_says_so(emulator: Emulator, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", MAIN, "hardware", "calibrate", "--port", emulator.port,
         "--out", str(tmp_path / "c.toml")],
        stdin=subprocess.DEVNULL, capture_output=True, text=True, env=ENVIRONMENT, timeout=60,
        check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert "calibrating asks on the terminal; there is none" in done.stderr
    assert not (tmp_path / "c.toml").exists()


def test_ctrl_c_at_a_prompt_and_in_a_run(
    emulator: Emulator, terminal: list[Terminal], tmp_path: Path
) -> None:
    words = ["--port", emulator.port, "--patience", "10"]
    shell = Terminal("calibrate", *words, "--out", str(tmp_path / "c.toml"))
    terminal.append(shell)
    shell.wait_for("put all joints at zero")
    # between printing its prompt and waiting for input Python only notes a signal, until Enter
    time.sleep(1.0)
    shell.process.send_signal(signal.SIGINT)
    assert shell.finish()[0] == 130
    assert not (tmp_path / "c.toml").exists() and not any(emulator.state()["torque_on"])

    with Emulator(15) as straight:
        words = ["--port", straight.port, "--patience", "10", "--out", str(tmp_path)]
        shell = Terminal("run", "sine", "--seconds", "60", *words)
        terminal.append(shell)
        shell.wait_for("started: Sine")
        time.sleep(0.5)
        assert all(straight.state()["torque_on"])
        shell.process.send_signal(signal.SIGINT)
        code, said = shell.finish()
        assert code == 130 and "torque off, confirmed by all 15 servos" in said
        assert not any(straight.state()["torque_on"])
    kept = read_log(tmp_path / "run.mcap")
    assert not kept.cut and "interrupted" in [event["event"] for event in kept.events]


def test_a_log_without_messages_is_refused(tmp_path: Path) -> None:
    from mcap.writer import Writer

    with (tmp_path / "empty.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.finish()
    (tmp_path / "cut.mcap").write_bytes(b"")
    for name, cut in (("empty", ""), ("cut", ", cut off before the first of them")):
        done = subprocess.run(
            [sys.executable, "-c", MAIN, "hardware", "report", str(tmp_path / f"{name}.mcap")],
            capture_output=True, text=True, env=ENVIRONMENT, timeout=60, check=False,
        )  # fmt: skip
        assert done.returncode == 2
        assert done.stderr.strip().endswith(f"{name}.mcap holds no messages of a run{cut}")
        assert len(done.stderr.strip().splitlines()) == 1
        assert not (tmp_path / "report.html").exists()
