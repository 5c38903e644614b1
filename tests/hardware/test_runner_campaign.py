"""Every fault of the table, twenty times at random moments of a run; docs/hardware-faults.md.

Each trial is a run in real time: its seed draws the moment (any, not only between two ticks), the
servo and the joint. Trials that were done are kept in a file, so that a campaign that was killed
goes on where it stopped; trials of other code are not taken.

- ``DEXCTL_FAULT_TIMES``: trials of each fault, 20 by default.
- ``DEXCTL_FAULT_PATIENCE``: how much longer than a hand an emulator may be silent, 4 by default,
  because tests share their machine; 1 is the limits that a hand gets.
- ``DEXCTL_FAULT_RESULTS``: the file that keeps trials; none by default.
- ``DEXCTL_WRITE_DOCS=1``: write the table; the file is then benchmarks/results/faults.json.
"""

from __future__ import annotations

import hashlib
import json
import os
import pty
import re
import signal
import threading
import time
import tty
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
import pytest

import dexctl
from dexctl import Controller
from dexctl.report.machine import machine
from hardware.bus import Bus
from hardware.calibration import Calibration
from hardware.emulator import Emulator
from hardware.hand import ServoHand
from hardware.limits import Limits
from hardware.log import LogWriter, read_log
from hardware.run_report import RunEvent, RunReport
from hardware.runner import Runner
from hardware.state_machine import Event, State, Torque
from hardware.tactile import SerialTactile, format_line

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "hardware-faults.md"
WRITE = bool(os.environ.get("DEXCTL_WRITE_DOCS"))
TIMES = int(os.environ.get("DEXCTL_FAULT_TIMES", "20"))
PATIENCE = float(os.environ.get("DEXCTL_FAULT_PATIENCE", "4"))
RESULTS = os.environ.get("DEXCTL_FAULT_RESULTS") or (
    str(ROOT / "benchmarks" / "results" / "faults.json") if WRITE else ""
)
USUAL = Limits()
LIMITS = Limits(
    watchdog=PATIENCE * USUAL.watchdog,
    command_age=PATIENCE * USUAL.command_age,
    state_age=PATIENCE * USUAL.state_age,
    overruns=USUAL.overruns if PATIENCE == 1 else (1.0, 1.0),
)
PERIOD, TIMEOUT = 0.02, 0.01 * PATIENCE
IDS = range(1, 16)


@dataclass
class Bench:
    """What a fault is made with, and what has been seen."""

    emulator: Emulator
    random: np.random.Generator
    servo: int = 0
    runner: Runner | None = None
    naps: list[float] = field(default_factory=list)
    feeling: bool = True
    made: float | None = None
    told: dict[Event, float] = field(default_factory=dict)

    def later(self, seconds: float, deed: Callable[[], object]) -> None:
        """Do something after a while, whatever the run does then."""
        timer = threading.Timer(seconds, deed)
        timer.daemon = True
        timer.start()


@dataclass(frozen=True)
class Fault:
    """A kind of fault: the row of the table, how it is made, and where it must end.

    Attributes:
        row: of the fault table.
        name: what is done.
        make: does it; what the controller answers, where that is the fault.
        state, torque: the outcome.
        event: what the runner calls it; None where the bus only counts it.
        says: pattern of what the user is told.
        needs: seconds that the run goes on afterwards.
        by_controller: made within the controller's call, not at any moment.
        unknown: the only servos whose torque may be left unknown: "this", "all" or "".
    """

    row: str
    name: str
    make: Callable[[Bench], Any]
    state: State
    event: Event | None
    says: str = ""
    needs: float = 0.4
    by_controller: bool = False
    torque: Torque = Torque.OFF
    unknown: str = ""
    needs_tactile: bool = False
    narrow: bool = False
    limits: Limits = LIMITS


def silent_for(seconds: float) -> Callable[[Bench], None]:
    def make(b: Bench) -> None:
        b.emulator.silence(b.servo)
        b.later(seconds, lambda: b.emulator.speak(b.servo))

    return make


def lost_for(seconds: float) -> Callable[[Bench], None]:
    def make(b: Bench) -> None:
        b.emulator.drop(rate=1.0)
        b.later(seconds, lambda: b.emulator.drop(rate=0.0))

    return make


def volts(volts: float, seconds: float = 0.0) -> Callable[[Bench], None]:
    def make(b: Bench) -> None:
        b.emulator.voltage(volts, b.servo)
        if seconds:
            b.later(seconds, lambda: b.emulator.voltage(12.0, b.servo))

    return make


def degrees(celsius: int, seconds: float = 0.0) -> Callable[[Bench], None]:
    def make(b: Bench) -> None:
        b.emulator.overheat(b.servo, celsius=celsius)
        if seconds:
            b.later(seconds, lambda: b.emulator.overheat(b.servo, celsius=25))

    return make


def asks(change: float) -> Callable[[Bench], np.ndarray]:
    def make(b: Bench) -> np.ndarray:
        return np.where(np.arange(15) == b.servo - 1, change, 0.0)

    return make


def raises(b: Bench) -> None:
    raise RuntimeError("on purpose")


def naps(seconds: float, count: int = 1, every: int = 1) -> Callable[[Bench], None]:
    def make(b: Bench) -> None:
        b.naps[:] = ([seconds] + [0.0] * (every - 1)) * count

    return make


def ctrl_c(times: int) -> Callable[[Bench], None]:
    def make(b: Bench) -> None:
        for i in range(times):
            if i:
                time.sleep(float(b.random.uniform(0.002, 0.1)))  # within the 0.2 s of the first
            os.kill(os.getpid(), signal.SIGINT)

    return make


def numb(b: Bench) -> None:
    b.feeling = False


def brown_out(b: Bench) -> None:
    b.emulator.voltage(5.0, b.servo)
    b.emulator.voltage(12.0, b.servo)


P, S, E = PATIENCE, State, Event
FAULTS = (
    Fault("one missed or corrupt read", "17 answers lost", lambda b: b.emulator.drop(17),
          S.IDLE, None),
    Fault("one missed or corrupt read", "17 answers damaged", lambda b: b.emulator.corrupt(17),
          S.IDLE, None),
    Fault("one missed or corrupt read", "a servo silent for 60 ms", silent_for(0.06 * P),
          S.IDLE, E.READ_MISSED, "servo {servo}"),
    Fault("3 in a row, or state older than 100 ms", "a servo silent for 0.25 s",
          silent_for(0.25 * P), S.FAULT, E.READS_LOST,
          "servo {servo}.* times in a row.*cable.*latency timer", 0.6 * P),
    Fault("3 in a row, or state older than 100 ms", "no answer at all for 0.3 s",
          lost_for(0.3 * P), S.FAULT, E.READS_LOST, "servo 1, 2, 3,.*for \\d+ ms.*cable", 0.6 * P),
    Fault("3 in a row, or state older than 100 ms", "a servo silent for good",
          lambda b: b.emulator.silence(b.servo), S.FAULT, E.READS_LOST, "servo {servo}.*cable",
          0.6 * P, torque=Torque.UNKNOWN, unknown="this"),
    Fault("alert bit, or 70 not 0", "overload", lambda b: b.emulator.overload(b.servo),
          S.FAULT, E.ALERT, "servo {servo}: overload.*--reboot"),
    Fault("alert bit, or 70 not 0", "85 C: the servo lets go", degrees(85), S.FAULT, E.ALERT,
          "servo {servo}: overheating.*--reboot"),
    Fault("alert bit, or 70 not 0", "9.0 V: an alert, torque kept", volts(9.0), S.FAULT, E.ALERT,
          "servo {servo}: input voltage"),
    Fault("alert bit, or 70 not 0", "brown-out: the servo starts anew", brown_out, S.FAULT,
          None, "servo {servo}", 0.6 * P),
    Fault("goal outside a limit, or too large a step", "0.03 rad too fast", asks(0.04), S.IDLE,
          E.CLAMPED, "{joint}: too fast, sent -?\\d", by_controller=True),
    Fault("goal outside a limit, or too large a step", "out of range", asks(0.011), S.IDLE,
          E.CLAMPED, "{joint}: out of range, sent -?\\d", by_controller=True, narrow=True),
    Fault("NaN goal", "NaN", asks(np.nan), S.HOLD, E.GOAL_NOT_FINITE, "{joint}",
          by_controller=True),
    Fault("command older than 100 ms", "the controller takes 0.3 s",
          lambda b: time.sleep(0.3 * P), S.HOLD, E.COMMAND_STALE, "controller stalled.*ms",
          0.4 * P, by_controller=True),
    Fault("command older than 100 ms", "the controller raises", raises, S.HOLD,
          E.CONTROLLER_FAILED, "RuntimeError: on purpose", by_controller=True),
    Fault("temperature 70 C, or voltage out of range", "75 C for 0.4 s", degrees(75, 0.4),
          S.IDLE, E.HEALTH_WARNING, "servo {servo}: 75 C", 0.8),
    Fault("temperature 70 C, or voltage out of range", "75 C for good", degrees(75),
          S.HOLD, E.HEALTH_LASTS, "servo {servo}: 75 C", 1.5),
    Fault("temperature 70 C, or voltage out of range", "9.8 V for 0.4 s", volts(9.8, 0.4),
          S.IDLE, E.HEALTH_WARNING, "servo {servo}: 9.8 V", 0.8),
    Fault("temperature 70 C, or voltage out of range", "9.8 V for good", volts(9.8),
          S.HOLD, E.HEALTH_LASTS, "servo {servo}: 9.8 V", 1.5),
    Fault("watchdog tripped", "bus silent for 0.15 s", naps(0.15 * P), S.FAULT, E.WATCHDOG,
          "bus silent \\d+ ms", 0.4 * P),
    Fault("overruns above 5 %, above 20 %", "every tenth tick too long", naps(0.024, 30, 10),
          S.IDLE, E.OVERRUNS_WARNING, "\\d+% of the last", 2.0,
          limits=replace(LIMITS, overruns=USUAL.overruns)),
    Fault("overruns above 5 %, above 20 %", "every tick too long", naps(0.024, 400),
          S.HOLD, E.OVERRUNS, "\\d+% of the last", 2.0,
          limits=replace(LIMITS, overruns=USUAL.overruns)),
    Fault("tactile stale", "fingertips fall silent, needed", numb, S.HOLD, E.TACTILE_NEEDED,
          "finger 0, 1, 2, 3, 4: \\d+ ms old", 0.6, needs_tactile=True),
    Fault("tactile stale", "fingertips fall silent, not needed", numb, S.IDLE, E.TACTILE_STALE,
          "finger 0, 1, 2, 3, 4: \\d+ ms old", 0.6),
    Fault("Ctrl-C", "Ctrl-C", ctrl_c(1), S.IDLE, E.INTERRUPT, "holding for 0.2 s"),
    Fault("Ctrl-C", "Ctrl-C twice", ctrl_c(2), S.IDLE, E.INTERRUPT_AGAIN, "interrupted twice"),
    Fault("unplugged", "unplugged", lambda b: b.emulator.unplug(), S.FAULT, E.UNPLUGGED,
          "torque state UNKNOWN: cut power", torque=Torque.UNKNOWN, unknown="all"),
)  # fmt: skip


class Saboteur(Controller):
    """Asks for nothing; makes the fault at a moment of the run, or in its n-th answer."""

    def __init__(self, hand: dexctl.HandModel, fault: Fault, bench: Bench, moment: float) -> None:
        super().__init__(hand, control_period=PERIOD)
        self._fault, self._bench, self._moment = fault, bench, moment
        self._asked = 0

    def reset(self, seed=None, mask=None) -> None:
        self._asked = 0

    def act(self, state: dexctl.GraspState) -> np.ndarray:
        self._asked += state.time != 0.0  # not in the warm-up
        fault, answer = self._fault, None
        if self._asked == 1 and not fault.by_controller:
            self._bench.later(self._moment, self._deed)
        elif self._asked == 1 + round(self._moment / PERIOD) and fault.by_controller:
            answer = self._deed()
        return answer if isinstance(answer, np.ndarray) else np.zeros(15)

    def _deed(self) -> Any:
        if self._bench.made is None:
            self._bench.made = time.monotonic()
            return self._fault.make(self._bench)
        return None


class Fingertips:
    """The far end of the tactile port: a line of every finger at each tick, until numb."""

    def __init__(self) -> None:
        self.master, slave = pty.openpty()
        tty.setraw(slave)
        self.source = SerialTactile(os.ttyname(slave), 5)
        os.close(slave)
        self._lines = b"".join(
            format_line(i, np.array([0.05, 0.0, 0.1]), np.array([-1.0, 0.0, 0.0]), 2.0)
            for i in range(5)
        )

    def feel(self) -> None:
        os.write(self.master, self._lines)

    def close(self) -> None:
        self.source.close()
        os.close(self.master)


class Campaign:
    """Trials done, in a file where one is given."""

    def __init__(self, path: str) -> None:
        self._path = Path(path) if path else None
        self.about = {"code": _fingerprint(), "patience": PATIENCE}
        self.trials: dict[str, dict[str, Any]] = {}
        if self._path is not None and self._path.is_file():
            found = json.loads(self._path.read_text())
            if all(found[key] == value for key, value in self.about.items()):
                self.trials = found["trials"]

    def keep(self, name: str, number: int, trial: dict[str, Any]) -> None:
        self.trials.setdefault(name, {})[str(number)] = trial
        if self._path is not None:
            aside = self._path.with_suffix(".part")
            content = {**self.about, "machine": machine(), "trials": self.trials}
            aside.write_text(json.dumps(content, default=str) + "\n")
            aside.replace(self._path)


def _fingerprint() -> str:
    """Of the code that the trials are about; where a fault here changes, remove the file."""
    digest = hashlib.sha256()
    for path in sorted((ROOT / "hardware").rglob("*.py")):
        if "cli" not in path.parts and path.name not in ("report.py", "figures.py"):
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


@pytest.fixture(scope="module")
def emulator() -> Iterator[Emulator]:
    with Emulator(15) as emulator:
        yield emulator


@pytest.fixture(scope="module")
def campaign() -> Campaign:
    return Campaign(RESULTS)


def trial(fault: Fault, number: int, emulator: Emulator, hand: dexctl.HandModel, path: Path):
    """One run with one fault; None where the fault came too late to be one."""
    random = np.random.default_rng([crc32(fault.name.encode()), number])
    bench = Bench(emulator, random, servo=int(random.integers(1, 16)))
    moment = float(random.uniform(0.05, 0.5))
    emulator.reset()
    calibration = Calibration.nominal(hand)
    if fault.narrow:
        calibration = replace(calibration, lower=np.full(15, -0.01), upper=np.full(15, 0.01))
    tips = Fingertips()

    def extra() -> dict:
        if bench.feeling:
            tips.feel()
        if bench.naps:
            time.sleep(bench.naps.pop(0))
        return {}

    def told(said: RunEvent) -> None:
        bench.told.setdefault(said.event, time.monotonic())

    try:
        tips.feel()
        with Bus(emulator.port, IDS, timeout=TIMEOUT) as bus, LogWriter(path) as log:
            plant = ServoHand(bus, hand, calibration, limits=fault.limits, tactile=tips.source)
            runner = Runner(plant, Saboteur(hand, fault, bench, moment), log=log, extra=extra,
                            needs_tactile=fault.needs_tactile, on_event=told)  # fmt: skip
            tips.feel()
            report = runner.run(moment + fault.needs)
    finally:
        tips.close()
    if bench.made is None:  # so busy a machine that the run was over before
        return None
    judge(fault, bench, report, path, hand)
    event = fault.event or report.cause
    told_at = bench.told.get(event) if event else None
    return {
        "servo": bench.servo,
        "moment_s": round(moment, 4),
        "outcome": report.outcome.value,
        "cause": report.cause.value if report.cause else None,
        "torque": report.torque.value,
        "told_after_s": round(told_at - bench.made, 4) if told_at else None,
        "said": next((f"{e.event.value}: {e.detail}" for e in report.events
                      if e.event in (fault.event, report.cause)), ""),
        "real_time": report.real_time,
    }  # fmt: skip


def judge(
    fault: Fault, bench: Bench, report: RunReport, path: Path, hand: dexctl.HandModel
) -> None:
    """The state that the table names, torque known and reported, log readable."""
    story = " | ".join(f"{e.time:.2f} {e.event.value}: {e.detail}" for e in report.events)
    assert report.outcome is fault.state, story
    assert report.torque is fault.torque, report.torque_message
    if fault.event is not None:
        assert report.counts[fault.event], story
    else:
        counts = report.bus
        assert report.outcome is State.FAULT or counts["timeouts"] + counts["crc_errors"], counts
    says = fault.says.replace("{servo}", rf"(?:\d+, )*{bench.servo}\b")
    says = says.replace("{joint}", hand.joint_names[bench.servo - 1])
    assert re.search(says, story), (says, story)
    assert report.events[-1].event is not Event.FINISHED or fault.state is State.IDLE
    # the truth about the torque
    on = np.array(bench.emulator.state()["torque_on"])
    if fault.unknown == "this":
        assert f"torque state of servo {bench.servo} UNKNOWN: cut power" in report.torque_message
        assert not np.delete(on, bench.servo - 1).any()
    elif fault.unknown == "all":
        assert "cut power" in report.torque_message
        bench.emulator.replug()
    else:
        assert not on.any() and "confirmed by all 15 servos" in report.torque_message
    # the log, whole and cut off anywhere
    kept = read_log(path)
    assert not kept.cut and kept.summary["torque"] == fault.torque.value
    assert [e["event"] for e in kept.events] == [e.event.value for e in report.events]
    content = path.read_bytes()
    cut = path.with_name("cut.mcap")
    cut.write_bytes(content[: int(bench.random.integers(0, len(content)))])
    assert len(read_log(cut).ticks.get("time", ())) <= len(kept.ticks["time"])


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_fault(
    fault: Fault, emulator: Emulator, campaign: Campaign, dex5: dexctl.HandModel, tmp_path: Path
) -> None:
    done = campaign.trials.get(fault.name, {})
    late = 0
    for number in range(TIMES):
        if str(number) in done:
            continue
        while (found := trial(fault, number, emulator, dex5, tmp_path / "run.mcap")) is None:
            late += 1
            assert late < 10, "the runs end before their faults: the machine is too busy"
        campaign.keep(fault.name, number, found)
    assert len(campaign.trials[fault.name]) >= TIMES


def table(trials: dict[str, dict[str, Any]]) -> list[str]:
    """Lines of the table in the docs."""
    lines = []
    for fault in FAULTS:
        rows = list(trials[fault.name].values())
        ended = Counter(f"{row['outcome'].upper()}, torque {row['torque']}" for row in rows)
        assert len(ended) == 1, (fault.name, ended)
        after = [1e3 * row["told_after_s"] for row in rows if row["told_after_s"] is not None]
        told = f"{np.median(after):.0f} ({max(after):.0f})" if after else ""
        said = rows[0]["said"].replace("|", "/")
        said = said if len(said) < 110 else said[:107] + "..."
        lines.append(
            f"| {fault.row} | {fault.name} | {len(rows)} | {next(iter(ended))} | {told} | {said} |"
        )
    return lines


@pytest.mark.slow
def test_write_the_table(campaign: Campaign) -> None:
    if not WRITE or any(len(campaign.trials.get(f.name, ())) < TIMES for f in FAULTS):
        pytest.skip("DEXCTL_WRITE_DOCS=1 writes it, once every fault has all its trials")
    real_time = all(t["real_time"] for rows in campaign.trials.values() for t in rows.values())
    limits = "those of a hand" if PATIENCE == 1 else f"{PATIENCE:g} times those of a hand"
    granted = "granted" if real_time else "not always granted"
    PAGE.write_text(
        "\n".join(
            [
                "# Faults, injected",
                "",
                "Every row of the fault table in [Servo hands](hardware.md), made on the emulated",
                "servos at random moments of runs at 50 Hz (seeded: moment, servo, joint) by",
                "`tests/hardware/test_runner_campaign.py`, which also wrote this table. Limits",
                f"were {limits}; real-time scheduling was {granted}.",
                "",
                "In every trial the log could be read, whole and cut off at a random byte, and",
                "the emulator agreed with what was said of the torque of all 15 servos. HOLD keeps",
                "the torque on until Ctrl-C or the end of the run's time; the torque given here is",
                "what was known when the run returned. IDLE is a run that went on to its end, or",
                "that Ctrl-C ended. *After* is the time from making the fault",
                "to the runner's saying so: median, and the longest in brackets.",
                "",
                "| row of the table | made | times | ended in | after [ms] | for example |",
                "|---|---|---|---|---|---|",
                *table(campaign.trials),
                "",
                "A servo that is silent for good cannot confirm that its torque is off, so it is",
                "named as unknown, and so is a whole hand that was unplugged: cut the power.",
            ]
        )
        + "\n"
    )


def test_the_table_in_the_docs_has_every_fault() -> None:
    page = PAGE.read_text()
    for fault in FAULTS:
        times = re.search(rf"\| {re.escape(fault.name)} \| (\d+) \| (\w+), torque (\w+) \|", page)
        assert times is not None, fault.name
        assert int(times[1]) >= 20
        assert times[2] == fault.state.value.upper() and times[3] == fault.torque.value
