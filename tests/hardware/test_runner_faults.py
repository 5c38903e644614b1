"""Every row of the fault table, made to happen in a run on the emulated servos."""

from __future__ import annotations

import os
import re
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np
import pytest

import dexctl
from dexctl import Controller
from dexctl.exceptions import InvalidInput
from hardware.bus import Bus
from hardware.calibration import Calibration
from hardware.emulator import Emulator
from hardware.hand import ServoHand
from hardware.limits import Limits
from hardware.log import LogWriter, read_log
from hardware.run_report import RunReport
from hardware.runner import Runner
from hardware.state_machine import Event, State, Torque
from hardware.tracking import MOST_AGE, TrackedPose

# Real-time loops: on a machine that others keep busy their deadlines pass, as they should.
pytestmark = pytest.mark.slow

PERIOD = 0.02
# Ticks that are late because the machine is busy with other tests are no fault here.
PATIENT = Limits(watchdog=2.4, command_age=0.4, state_age=3.0, overruns=(1.0, 1.0))
Deed = Callable[[], object]


class Saboteur(Controller):
    """Asks for nothing, and does a deed when it is asked for the n-th time."""

    def __init__(self, hand: dexctl.HandModel, deeds: Mapping[int, Deed]) -> None:
        super().__init__(hand, control_period=PERIOD)
        self.deeds, self.asked, self.warm = deeds, 0, True

    def reset(self, seed=None, mask=None) -> None:
        self.asked = 0

    def act(self, state: dexctl.GraspState) -> np.ndarray:
        self.asked += 1
        answer = None
        # the warm-up before the run asks about a made-up state at time 0
        if self.asked in self.deeds and state.time != 0.0:
            answer = self.deeds[self.asked]()
        return answer if isinstance(answer, np.ndarray) else np.zeros(15)


@pytest.fixture(scope="module")
def emulator() -> Iterator[Emulator]:
    with Emulator(15, start=[0.1] * 15) as emulator:
        yield emulator


@pytest.fixture
def bus(emulator: Emulator) -> Iterator[Bus]:
    with Bus(emulator.port, range(1, 16), timeout=0.25) as bus:
        yield bus
    emulator.speak()
    emulator.voltage(12.0)
    emulator.overheat(*range(1, 16), celsius=25)


def hand_on(bus: Bus, dex5: dexctl.HandModel, limits: Limits = PATIENT) -> ServoHand:
    wide = Calibration.nominal(dex5)
    return ServoHand(bus, dex5, wide, limits=limits, control_period=PERIOD)


def run(
    bus: Bus,
    dex5: dexctl.HandModel,
    deeds: Mapping[int, Deed],
    *,
    limits: Limits = PATIENT,
    seconds: float = 0.6,
    **options,
) -> RunReport:
    hand = hand_on(bus, dex5, limits)
    options.setdefault("needs_tactile", False)
    return Runner(hand, Saboteur(dex5, deeds), **options).run(seconds)


def detail(report: RunReport, event: Event) -> str:
    return next(said.detail for said in report.events if said.event is event)


def test_a_quiet_run(emulator: Emulator, bus: Bus, dex5: dexctl.HandModel, tmp_path: Path) -> None:
    log = LogWriter(tmp_path / "a.mcap")
    with log:
        report = run(bus, dex5, {}, log=log)
    assert (report.outcome, report.cause, report.torque) == (State.IDLE, None, Torque.OFF)
    assert report.torque_message == "torque off, confirmed by all 15 servos"
    assert [said.event for said in report.events] == [Event.ARM, Event.START, Event.FINISHED]
    assert not any(emulator.state()["torque_on"])
    kept = read_log(tmp_path / "a.mcap")
    assert len(kept.ticks["time"]) == report.ticks and kept.summary["outcome"] == "idle"
    np.testing.assert_allclose(kept.ticks["q"][0], 0.1, atol=1e-3)


def test_a_missed_read_is_counted(emulator: Emulator, bus: Bus, dex5: dexctl.HandModel) -> None:
    report = run(bus, dex5, {5: lambda: emulator.silence(4), 6: lambda: emulator.speak(4)})
    assert (report.outcome, report.torque) == (State.IDLE, Torque.OFF)
    assert report.counts[Event.READ_MISSED] >= 1
    assert "servo 4" in detail(report, Event.READ_MISSED)


def test_reads_lost(emulator: Emulator, bus: Bus, dex5: dexctl.HandModel) -> None:
    try:
        report = run(bus, dex5, {5: lambda: emulator.silence(4, 9)}, seconds=5.0)
    finally:
        emulator.speak()
    assert (report.outcome, report.cause) == (State.FAULT, Event.READS_LOST)
    said = detail(report, Event.READS_LOST)
    assert "servo 4, 9" in said and "cable" in said and "latency timer" in said
    # the two that say nothing cannot be known; the thirteen others have confirmed
    assert report.torque is Torque.UNKNOWN
    assert "torque state of servo 4, 9 UNKNOWN: cut power" in report.torque_message
    assert sum(emulator.state()["torque_on"]) == 2
    assert hand_on(bus, dex5).disarm().state is Torque.OFF


def test_overload(emulator: Emulator, bus: Bus, dex5: dexctl.HandModel) -> None:
    report = run(bus, dex5, {5: lambda: emulator.overload(7)}, seconds=5.0)
    assert (report.outcome, report.cause, report.torque) == (
        State.FAULT,
        Event.ALERT,
        Torque.OFF,
    )
    said = detail(report, Event.ALERT)
    assert "servo 7: overload" in said and "--reboot" in said
    with pytest.raises(dexctl.DexctlError, match=r"servo 7 .* reports overload"):
        hand_on(bus, dex5).arm()
    bus.reboot(7)


def test_brown_out(emulator: Emulator, bus: Bus, dex5: dexctl.HandModel) -> None:
    try:
        report = run(bus, dex5, {5: lambda: emulator.voltage(5.0, 3)}, seconds=5.0)
    finally:
        emulator.voltage(12.0)
        time.sleep(0.5)
    assert report.outcome is State.FAULT
    assert report.cause in (Event.ALERT, Event.READS_LOST)
    assert not any(emulator.state()["torque_on"])


def test_set_points_are_clamped(emulator: Emulator, bus: Bus, dex5: dexctl.HandModel) -> None:
    change = np.zeros(15)
    change[1] = 5.0
    report = run(bus, dex5, {5: lambda: change})
    assert report.outcome is State.IDLE and report.counts[Event.CLAMPED] == 1
    assert "f1_flexion1" in detail(report, Event.CLAMPED)


def test_a_set_point_that_is_no_number(
    emulator: Emulator, bus: Bus, dex5: dexctl.HandModel
) -> None:
    change = np.zeros(15)
    change[4] = np.nan
    report = run(bus, dex5, {5: lambda: change})
    assert (report.outcome, report.cause, report.torque) == (
        State.HOLD,
        Event.GOAL_NOT_FINITE,
        Torque.OFF,
    )
    assert "f2_flexion1" in detail(report, Event.GOAL_NOT_FINITE)


def test_a_controller_that_stalls(emulator: Emulator, bus: Bus, dex5: dexctl.HandModel) -> None:
    report = run(bus, dex5, {5: lambda: time.sleep(0.8)}, seconds=1.0)
    assert (report.outcome, report.cause) == (State.HOLD, Event.COMMAND_STALE)
    # it holds, and the bus goes on: nobody is surprised by the watchdog
    assert report.counts[Event.WATCHDOG] == 0 and report.torque is Torque.OFF


def test_a_controller_that_fails(emulator: Emulator, bus: Bus, dex5: dexctl.HandModel) -> None:
    report = run(bus, dex5, {5: lambda: 1 / 0})
    assert (report.outcome, report.cause) == (State.HOLD, Event.CONTROLLER_FAILED)
    assert "ZeroDivisionError" in detail(report, Event.CONTROLLER_FAILED)


def test_heat_is_warned_of_then_held(emulator: Emulator, bus: Bus, dex5: dexctl.HandModel) -> None:
    deeds = {5: lambda: emulator.overheat(2, celsius=75)}
    try:
        report = run(bus, dex5, deeds, seconds=2.0)
    finally:
        emulator.overheat(*range(1, 16), celsius=25)
    assert (report.outcome, report.cause) == (State.HOLD, Event.HEALTH_LASTS)
    assert report.counts[Event.HEALTH_WARNING] > 1
    assert "servo 2: 75 C" in detail(report, Event.HEALTH_WARNING)


def test_low_voltage_for_a_moment_is_only_warned_of(
    emulator: Emulator, bus: Bus, dex5: dexctl.HandModel
) -> None:
    deeds = {5: lambda: emulator.voltage(9.8), 12: lambda: emulator.voltage(12.0)}
    report = run(bus, dex5, deeds)
    assert report.outcome is State.IDLE and report.counts[Event.HEALTH_WARNING] >= 1
    assert "9.8 V" in detail(report, Event.HEALTH_WARNING)


def test_the_watchdog(emulator: Emulator, bus: Bus, dex5: dexctl.HandModel) -> None:
    naps = iter([0.0] * 10 + [0.4] + [0.0] * 1000)

    def nap() -> dict:
        time.sleep(next(naps))
        return {}

    limits = Limits(watchdog=0.2, state_age=1.0, command_age=1.0, overruns=(1.0, 1.0))
    with LogWriter(os.devnull) as log:
        report = run(bus, dex5, {}, limits=limits, log=log, extra=nap, seconds=3.0)
    assert (report.outcome, report.cause, report.torque) == (
        State.FAULT,
        Event.WATCHDOG,
        Torque.OFF,
    )
    assert "bus silent" in detail(report, Event.WATCHDOG)
    # armed again by hand, it runs
    assert run(bus, dex5, {}, seconds=0.1).outcome is State.IDLE


def test_overruns(emulator: Emulator, bus: Bus, dex5: dexctl.HandModel) -> None:
    def nap() -> dict:
        time.sleep(0.03)
        return {}

    limits = Limits(watchdog=2.4, state_age=3.0, command_age=1.0)
    with LogWriter(os.devnull) as log:
        report = run(bus, dex5, {}, limits=limits, log=log, extra=nap, seconds=3.0)
    assert (report.outcome, report.cause) == (State.HOLD, Event.OVERRUNS)
    assert report.skipped > 10


def test_tactile_silence_matters_to_those_who_need_it(
    emulator: Emulator, bus: Bus, dex5: dexctl.HandModel
) -> None:
    report = run(bus, dex5, {}, needs_tactile=True)
    assert (report.outcome, report.cause) == (State.HOLD, Event.TACTILE_NEEDED)
    report = run(bus, dex5, {}, needs_tactile=False)
    # without fingertips there is nothing that could have fallen silent
    assert report.outcome is State.IDLE and report.counts[Event.TACTILE_STALE] == 0


class Tracker:
    """Tells the same pose until it falls silent."""

    def __init__(self) -> None:
        self.silent_since: float | None = None

    def read(self) -> TrackedPose:
        since = self.silent_since
        time_ = time.monotonic() if since is None else since
        stale = time.monotonic() - time_ > MOST_AGE
        return TrackedPose(np.array([0.0, 0.0, 0.13]), np.array([1.0, 0, 0, 0]), time_, stale)

    def silence(self) -> None:
        self.silent_since = time.monotonic()

    def close(self) -> None:
        pass


def test_a_tracker_that_falls_silent(
    emulator: Emulator, bus: Bus, dex5: dexctl.HandModel, tmp_path: Path
) -> None:
    tracker = Tracker()
    hand = ServoHand(bus, dex5, limits=PATIENT, tracker=tracker)
    with LogWriter(tmp_path / "a.mcap") as log:
        controller = Saboteur(dex5, {10: tracker.silence})
        runner = Runner(hand, controller, needs_tactile=False, log=log)
        report = runner.run(2.0)
    assert (report.outcome, report.cause) == (State.HOLD, Event.POSE_STALE)
    assert re.match(r"3\d\d ms old; does the tracker see it\?", detail(report, Event.POSE_STALE))
    ticks = read_log(tmp_path / "a.mcap").ticks
    assert ticks["tracked_position"].shape == (len(ticks["time"]), 3)
    assert ticks["tracked_age"][5] < 0.1 and ticks["tracked_age"].max() > MOST_AGE


def test_ctrl_c_holds_then_releases(emulator: Emulator, bus: Bus, dex5: dexctl.HandModel) -> None:
    before = signal.getsignal(signal.SIGINT)
    start = time.monotonic()
    report = run(bus, dex5, {5: lambda: os.kill(os.getpid(), signal.SIGINT)}, seconds=20.0)
    assert time.monotonic() - start < 5.0
    assert (report.outcome, report.cause, report.torque) == (State.IDLE, None, Torque.OFF)
    interrupted = next(said for said in report.events if said.event is Event.INTERRUPT)
    assert interrupted.state is State.HOLD
    assert signal.getsignal(signal.SIGINT) is before
    assert not any(emulator.state()["torque_on"])


def test_ctrl_c_twice_releases_at_once(
    emulator: Emulator, bus: Bus, dex5: dexctl.HandModel
) -> None:
    def twice() -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.001)
        os.kill(os.getpid(), signal.SIGINT)

    report = run(bus, dex5, {5: twice}, seconds=20.0)
    assert report.events[-1].event is Event.INTERRUPT_AGAIN
    assert (report.outcome, report.torque) == (State.IDLE, Torque.OFF)


def test_unplugged(dex5: dexctl.HandModel) -> None:
    with Emulator(15) as emulator, Bus(emulator.port, range(1, 16), timeout=0.25) as bus:
        report = run(bus, dex5, {5: emulator.unplug}, seconds=5.0)
        assert (report.outcome, report.cause) == (State.FAULT, Event.UNPLUGGED)
        assert report.torque is Torque.UNKNOWN
        assert "torque state UNKNOWN: cut power" in detail(report, Event.UNPLUGGED)
        assert "cut power" in report.torque_message
        assert all(emulator.state()["torque_on"])  # which is why


def test_an_approach_goes_first(emulator: Emulator, bus: Bus, dex5: dexctl.HandModel) -> None:
    hand = hand_on(bus, dex5)
    goal = np.full(15, 0.2)
    report = Runner(hand, Saboteur(dex5, {}), needs_tactile=False).run(0.2, approach=goal)
    assert report.outcome is State.IDLE and report.counts[Event.START] == 1
    np.testing.assert_allclose(hand.q_target, 0.2, atol=1e-9)
    np.testing.assert_allclose(emulator.state()["position"], 0.2, atol=0.02)


def test_bad_seconds(bus: Bus, dex5: dexctl.HandModel) -> None:
    for seconds in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(InvalidInput, match=f"seconds is {seconds}"):
            run(bus, dex5, {}, seconds=seconds)


def test_controllers_of_other_periods(bus: Bus, dex5: dexctl.HandModel) -> None:
    hand = ServoHand(bus, dex5, control_period=0.01)
    with pytest.raises(InvalidInput, match="the controller has a control_period of 0.02 s; .*0.01"):
        Runner(hand, Saboteur(dex5, {}))
