"""Whatever ends a run says what is known of the torque, and a killed run leaves none on."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dexctl
from dexctl import Controller
from dexctl.cli import main
from dexctl.exceptions import InvalidInput
from hardware import registers
from hardware.bus import Bus
from hardware.cli import run as commands_run
from hardware.cli.options import in_a_line, teller
from hardware.emulator import Emulator
from hardware.exceptions import BusError, ServoError, tell_torque
from hardware.hand import _PATIENCE, ServoHand
from hardware.limits import Limits
from hardware.log import LogWriter, read_log
from hardware.run_report import RunEvent, RunReport
from hardware.runner import Runner
from hardware.state_machine import Event, State, Torque

pytest.importorskip("dynamixel_sdk", reason="needs the extra 'hardware'")

PATIENT = Limits(watchdog=2.4, command_age=2.0, state_age=3.0, overruns=(1.0, 1.0))
ALL = tuple(range(1, 16))


class Still(Controller):
    """Asks for nothing, and says what it is told to say."""

    said: Mapping[Any, Any] = {}

    def reset(self, seed=None, mask=None) -> None: ...

    def act(self, state: dexctl.GraspState) -> np.ndarray:
        return np.zeros(15)

    @property
    def diagnostics(self) -> Mapping[Any, Any]:
        return self.said


@pytest.fixture(scope="module")
def emulator() -> Iterator[Emulator]:
    with Emulator(15, start=[0.1] * 15) as emulator:
        yield emulator


@pytest.fixture
def hand(emulator: Emulator, dex5: dexctl.HandModel) -> Iterator[ServoHand]:
    with Bus(emulator.port, ALL, timeout=0.05) as bus:
        yield ServoHand(bus, dex5, limits=PATIENT, control_period=0.02)
        emulator.reset()


def as_torque_comes_on(hand: ServoHand, deed: Callable[[], object]) -> None:
    """Do something in the moment in which the torque is on and nobody has asked yet."""
    write = hand.bus.write

    def writing(register, value, ids=None):
        sent = write(register, value, ids)
        if register is registers.TORQUE_ENABLE and np.all(value):
            time.sleep(0.1)  # the emulator has taken it
            deed()
        return sent

    hand.bus.write = writing


@pytest.mark.parametrize("silent", [(7,), ALL])
@pytest.mark.parametrize("through", ["arm", "run"])
def test_servos_that_fall_silent_as_torque_comes_on(
    silent: tuple[int, ...], through: str, emulator: Emulator, hand: ServoHand
) -> None:
    as_torque_comes_on(hand, lambda: emulator.silence(*silent))
    runner = Runner(hand, Still(hand.hand, control_period=0.02), needs_tactile=False)
    with pytest.raises(ServoError) as caught:
        hand.arm() if through == "arm" else runner.run(0.2)
    who = "all servos" if len(silent) == 15 else "servo 7"
    ids = ", ".join(map(str, silent))
    said = f"torque state of {who} ({ids}) UNKNOWN: cut power".replace("servo 7 (7)", "servo 7")
    assert str(caught.value).count(said) == 1
    on = emulator.state()["torque_on"]
    assert [servo for servo, on in zip(ALL, on, strict=True) if on] == list(silent)
    assert hand.torque_report.state is Torque.UNKNOWN
    if through == "run":
        assert runner.report.torque is Torque.UNKNOWN and said in runner.report.torque_message


def test_a_servo_that_comes_back_is_known_to_be_off(emulator: Emulator, hand: ServoHand) -> None:
    read, asked = hand.bus.read, []

    def reading(register, ids=None):
        asked.append(register)
        if len(asked) == _PATIENCE + 2:  # arming has lost its patience: this is the disarming
            emulator.speak()
        return read(register, ids)

    def blink() -> None:
        emulator.silence(*ALL)
        hand.bus.read = reading

    as_torque_comes_on(hand, blink)
    with pytest.raises(ServoError, match="torque off, confirmed by all 15 servos"):
        hand.arm()
    assert not any(emulator.state()["torque_on"])


@pytest.fixture
def ctrl_c() -> Iterator[None]:
    """Ctrl-C as in a terminal: what a shell starts in the background ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("ctrl_c")
def test_a_second_ctrl_c_waits_for_the_torque(emulator: Emulator, hand: ServoHand) -> None:
    """It ended the disarming half-way, and the guard was told that all was done."""
    write, sent = hand.bus.write, []

    def writing(register, value, ids=None):
        if register is registers.TORQUE_ENABLE and not sent:
            sent.append(register)
            signal.raise_signal(signal.SIGINT)
        return write(register, value, ids)

    hand.arm()
    hand.bus.write = writing
    with pytest.raises(KeyboardInterrupt):
        hand.disarm()
    assert sent and not any(emulator.state()["torque_on"])
    assert hand.torque_report.state is Torque.OFF


def test_the_guard_goes_on_where_disarming_ends_half_way(
    emulator: Emulator, hand: ServoHand, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(attempts: int) -> None:
        raise MemoryError

    hand.arm()
    monkeypatch.setattr(hand, "_let_go", fails)
    with pytest.raises(MemoryError):
        hand.disarm()
    assert not any(emulator.state()["torque_on"])


def test_an_armed_hand_is_not_armed_again(emulator: Emulator, hand: ServoHand) -> None:
    """The guard of the first time outlived the disarming, and took the torque off later."""
    hand.arm()
    with pytest.raises(BusError, match=r"the hand is armed already; disarm\(\) it first"):
        hand.arm()
    assert all(emulator.state()["torque_on"])
    assert hand.disarm().state is Torque.OFF
    hand.arm()
    assert hand.disarm().state is Torque.OFF


def test_what_ended_a_run_does_not_end_the_next(emulator: Emulator, hand: ServoHand) -> None:
    runner = Runner(hand, Still(hand.hand, control_period=0.02), needs_tactile=False)
    runner.interrupt()
    assert runner.run(5.0).counts[Event.INTERRUPT] == 1
    again = runner.run(0.2)
    assert not again.counts[Event.INTERRUPT] and again.counts[Event.FINISHED] == 1


@pytest.mark.parametrize("asked", [0, 1, 2])
def test_a_servo_that_was_rebooted_is_well(asked: int, emulator: Emulator, hand: ServoHand) -> None:
    """What was known of its health was that of the run before: the next one ended at once."""

    def overload(said: RunEvent) -> None:
        if said.event is Event.START:
            emulator.overload(3)

    still = Still(hand.hand, control_period=0.02)
    runner = Runner(hand, still, needs_tactile=False, on_event=overload)
    assert runner.run(5.0).outcome is State.FAULT
    for _ in range(asked):
        hand.health()
    hand.bus.reboot(3)
    assert Runner(hand, still, needs_tactile=False).run(0.3).outcome is State.IDLE


def test_a_setting_that_cannot_be_says_that_the_torque_is_off(hand: ServoHand) -> None:
    hand.calibration.lower[:] = 0.5
    with pytest.raises(InvalidInput, match=r"out of its range .*; torque off, confirmed by all 15"):
        Runner(hand, Still(hand.hand, control_period=0.02), needs_tactile=False).run(0.2)


@pytest.mark.parametrize("silent", [(), (4,)])
def test_on_event_that_raises(
    silent: tuple[int, ...], emulator: Emulator, hand: ServoHand, tmp_path: Path
) -> None:
    def told(said: RunEvent) -> None:
        if said.event is Event.START:
            emulator.silence(*silent)
            raise RuntimeError("the screen is full")

    with LogWriter(tmp_path / "run.mcap") as log:
        runner = Runner(
            hand, Still(hand.hand, control_period=0.02), needs_tactile=False, log=log, on_event=told
        )
        with pytest.raises(RuntimeError, match="^the screen is full") as caught:
            runner.run(0.5)
    known = "torque state of servo 4 UNKNOWN: cut power" if silent else "torque off, confirmed"
    (note,) = caught.value.__notes__
    assert known in note and known in runner.report.torque_message
    assert known in read_log(tmp_path / "run.mcap").summary["torque_message"]
    assert sum(emulator.state()["torque_on"]) == len(silent)


class Bracketed(Still):
    """Raises what rich would take for markup, once it has been warmed up."""

    asked = 0

    def act(self, state: dexctl.GraspState) -> np.ndarray:
        self.asked += 1
        if self.asked > 5:
            raise ValueError("[servos] has no [/x] :warning:")
        return np.zeros(15)


@pytest.mark.parametrize("closed", [False, True])
def test_what_is_printed_does_not_end_a_run(
    closed: bool, hand: ServoHand, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    if closed:
        reading, writing = os.pipe()
        os.close(reading)
        screen = os.fdopen(writing, "w")
        monkeypatch.setattr("sys.stderr", screen)
    runner = Runner(
        hand, Bracketed(hand.hand, control_period=0.02), needs_tactile=False,
        on_event=teller(in_a_line),
    )  # fmt: skip
    report = runner.run(0.3)
    assert (report.outcome, report.cause) == (State.HOLD, Event.CONTROLLER_FAILED)
    assert report.torque is Torque.OFF
    if not closed:
        said = capsys.readouterr().err
        assert "controller failed: ValueError: [servos] has no [/x] :warning:" in said


def test_what_an_error_says_reaches_the_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for error, code in (
        (OSError("no space"), 1),
        (KeyboardInterrupt(), 130),
        (InvalidInput("a"), 2),
    ):
        tell_torque(error, "torque off")

        def fails(arguments: list[str], error: BaseException = error) -> int:
            raise error

        monkeypatch.setattr("dexctl.cli.app._dispatch", fails)
        assert main(["hands"]) == code
        said = capsys.readouterr().err
        assert said.endswith("; torque off\n") and said.count("torque off") == 1


class Unspeakable:
    def __str__(self) -> str:
        raise RuntimeError("never")


@pytest.mark.parametrize(
    "said",
    [
        {("a", 1): 2.0},
        {"ragged": [[1.0], [1.0, 2.0]]},
        {"object": Unspeakable(), "complex": 1j, "deep": [[[[]]]]},
    ],
)
def test_diagnostics_that_cannot_be_logged_do_not_end_a_run(
    said: Mapping[Any, Any], emulator: Emulator, hand: ServoHand, tmp_path: Path
) -> None:
    controller = Still(hand.hand, control_period=0.02)
    controller.said = said
    with LogWriter(tmp_path / "run.mcap") as log:
        report = Runner(hand, controller, needs_tactile=False, log=log).run(0.3)
    assert (report.outcome, report.torque) == (State.IDLE, Torque.OFF)
    assert len(read_log(tmp_path / "run.mcap").ticks["time"]) > 5


def test_ticks_that_cannot_be_logged_are_counted_and_told(
    emulator: Emulator, hand: ServoHand, tmp_path: Path
) -> None:
    with LogWriter(tmp_path / "run.mcap") as log:
        report = Runner(
            hand, Still(hand.hand, control_period=0.02), needs_tactile=False, log=log,
            extra=lambda: {"what": Unspeakable()},
        ).run(0.3)  # fmt: skip
    assert (report.outcome, report.torque) == (State.IDLE, Torque.OFF)
    told = [e.detail for e in report.events if e.event is Event.LOG_LOST]
    assert told == ["/tick: RuntimeError: never"]
    assert report.dropped == report.counts[Event.LOG_LOST] >= report.ticks - 1


def test_a_log_folder_that_is_deleted_is_told_of_and_written_anew(
    emulator: Emulator, hand: ServoHand, tmp_path: Path
) -> None:
    folder = tmp_path / "out"
    folder.mkdir()

    def told(said: RunEvent) -> None:
        if said.event is Event.START:
            shutil.rmtree(folder)

    with LogWriter(folder / "run.mcap") as log:
        report = Runner(
            hand, Still(hand.hand, control_period=0.02), needs_tactile=False, log=log, on_event=told
        ).run(1.2)
    assert (report.outcome, report.torque) == (State.IDLE, Torque.OFF)
    (detail,) = [e.detail for e in report.events if e.event is Event.LOG_LOST]
    assert f"{folder / 'run.mcap'} was deleted during the run" in detail
    kept = read_log(folder / "run.mcap")
    assert not kept.cut and kept.summary["outcome"] == "idle"
    assert len(kept.ticks["time"]) == report.ticks


def test_an_earlier_run_is_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    commands_run.keep_earlier(tmp_path)
    assert not list(tmp_path.iterdir())
    for number in (1, 2):
        (tmp_path / "run.mcap").write_text(f"log {number}")
        (tmp_path / "report.html").write_text(f"page {number}")
        commands_run.keep_earlier(tmp_path)
        assert f"is kept as run-{number}.mcap" in capsys.readouterr().err.replace("\n", "")
    assert (tmp_path / "run-1.mcap").read_text() == "log 1"
    assert (tmp_path / "report-2.html").read_text() == "page 2"
    assert not (tmp_path / "run.mcap").exists()


def test_a_log_that_is_gone_does_not_hide_the_torque(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = RunReport(torque=Torque.OFF, torque_message="torque off, confirmed by all 15 servos")
    assert commands_run.finish(report, tmp_path, as_json=False) == 1
    said = capsys.readouterr()
    assert "torque off, confirmed by all 15 servos" in said.out
    assert "the log is lost: cannot read" in said.err.replace("\n", " ")


RUN = """
import sys, os, signal, ctypes
import numpy as np
import dexctl
from hardware.bus import Bus
from hardware.hand import ServoHand
from hardware.limits import Limits
from hardware.motions import Sine
from hardware.runner import Runner

port, way = sys.argv[1:]
model = dexctl.hands.load("dex5")
limits = Limits(watchdog=2.4, command_age=2.0, state_age=3.0, overruns=(1.0, 1.0))
ended = {"abort": os.abort, "segfault": lambda: ctypes.string_at(0), "wait": lambda: None}[way]

def told(said):
    if said.event.value == "started":
        print("started", flush=True)
        ended()

with Bus(port, range(1, 16), timeout=0.2) as bus:
    hand = ServoHand(bus, model, limits=limits, control_period=0.02)
    runner = Runner(hand, Sine(model, control_period=0.02), needs_tactile=False, on_event=told)
    report = runner.run(30.0)
print(report.outcome.value, report.torque_message, report.signal or "", flush=True)
"""


def start(emulator: Emulator, way: str) -> subprocess.Popen[str]:
    """A run in a process of its own, until the controller has started."""
    process = subprocess.Popen(
        [sys.executable, "-c", RUN, emulator.port, way],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )  # fmt: skip
    assert process.stdout is not None
    assert process.stdout.readline() == "started\n"
    return process


@pytest.mark.parametrize("name", ["SIGQUIT", "SIGABRT", "SIGTERM", "SIGHUP"])
def test_signals_from_outside_end_a_run_in_order(name: str, emulator: Emulator) -> None:
    emulator.reset()
    process = start(emulator, "wait")
    assert all(emulator.state()["torque_on"])
    process.send_signal(getattr(signal, name))
    out, _ = process.communicate(timeout=30)
    assert process.returncode == 0
    assert out == f"idle torque off, confirmed by all 15 servos {name}\n"
    assert not any(emulator.state()["torque_on"])


def test_a_run_that_is_stopped_and_continued_ends_in_order(emulator: Emulator) -> None:
    emulator.reset()
    process = start(emulator, "wait")
    process.send_signal(signal.SIGSTOP)
    time.sleep(0.2)
    process.send_signal(signal.SIGCONT)
    process.send_signal(signal.SIGQUIT)
    out, _ = process.communicate(timeout=30)
    assert out.endswith("torque off, confirmed by all 15 servos SIGQUIT\n")


@pytest.mark.parametrize("way", ["abort", "segfault", "kill"])
def test_the_guard_takes_the_torque_off_after_a_crash(way: str, emulator: Emulator) -> None:
    emulator.reset()
    process = start(emulator, "wait" if way == "kill" else way)
    if way == "kill":
        process.kill()
    process.wait(30)
    assert process.returncode < 0
    end = time.monotonic() + 10
    while any(emulator.state()["torque_on"]) and time.monotonic() < end:
        time.sleep(0.05)
    assert not any(emulator.state()["torque_on"])
    _, said = process.communicate(timeout=30)  # until the guard has ended, too
    assert "has ended with its torque on; torque-off was sent, unconfirmed" in said
    with Bus(emulator.port, ALL, timeout=0.2) as bus:  # and the port is free again
        assert bus.ping(1).model == 1030
