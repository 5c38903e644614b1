"""The control loop on a servo hand: the driver's cycle with all checks on, and 100 Hz for 60 s.

The cycle is what `ServoHand` does: positions, velocities and currents of 15 emulated servos read
over a pseudo-terminal, every answer checked, state and set-points made of them, 15 set-points sent
through the limits of range and speed. The loop is the runner's, log and health questions included:
a tick is late if it begins more than a millisecond after its time, or not at all.

The emulated servos take their share of the same machine's time. Real-time scheduling is taken where
it is permitted; one loop goes without it all the same.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from measuring.results import Figure, write
from measuring.settings import Settings, progress, settings
from measuring.timing import in_turns, spread

import dexctl
from dexctl import Controller
from dexctl.limits import REAL_SPEED, REAL_TORQUE
from hardware import ticker
from hardware.bus import Bus
from hardware.emulated_touch import EmulatedTactile
from hardware.emulator import Emulator
from hardware.hand import ServoHand
from hardware.limits import Limits
from hardware.log import LogWriter, read_log
from hardware.motions import Sine
from hardware.runner import Runner
from hardware.scene import HOLDING
from hardware.units import SimGains, to_servo

IDS = range(1, 16)
GOAL_HZ = 700
LATE = 1e-3  # [s]
MOST_LATE = {True: 0.01, False: 0.05}  # share of ticks, by whether real-time scheduling is there
GAINS = to_servo(SimGains(3.0, 0.15, REAL_TORQUE, REAL_SPEED))


@dataclass(frozen=True, kw_only=True)
class LoopSettings(Settings):
    """Cycles per second of the driver, and lateness of the runner."""

    cycles: int = 1000
    """Cycles in a row of each kind."""
    rounds: int = 10
    """How often the kinds take turns."""
    seconds: float = 60.0
    """Of each loop."""
    rate: float = 100.0
    """Of each loop [Hz]."""
    patience: float = 1.0
    """Allow so many times more silence and age than on a hand: on a busy machine."""


def cycles(given: LoopSettings) -> tuple[dict[str, np.ndarray], dict[str, int]]:
    """Seconds per cycle, and what the bus counted."""
    hand = dexctl.hands.load("dex5")
    # the cycles come one after the other, so a period of a cycle is what the speed limit reckons by
    with Emulator() as emulator, Bus(emulator.port, IDS, timeout=0.1) as bus:
        limits = Limits().patient(given.patience)
        plant = ServoHand(bus, hand, limits=limits, gains=GAINS, control_period=0.001)
        plant.arm()
        start = plant.q_target.copy()

        def cycle(i: int) -> None:
            state = plant.read()
            plant.write(start + 1e-4 * (i % 10))
            if state.age > 0.05:
                raise SystemExit(f"joints {1e3 * state.age:.0f} ms old")

        def watched(i: int) -> None:
            cycle(i)
            plant.health()

        calls: dict[str, Callable[[int], Any]] = {"read and write": cycle, "and health": watched}
        taken = in_turns(calls, given.cycles, given.rounds)
        plant.disarm()
        return taken, bus.statistics.as_dict()


@contextmanager
def grasping(seed: int) -> Iterator[tuple[Emulator, np.ndarray | None]]:
    """A hand in MuJoCo that holds a cylinder, and the set-points of its grasp."""
    with Emulator(dynamics="mujoco", scene=HOLDING, seed=seed) as emulator:
        yield emulator, np.array(emulator.grasp())


@contextmanager
def empty(seed: int) -> Iterator[tuple[Emulator, np.ndarray | None]]:
    """First-order joints."""
    with Emulator(seed=seed) as emulator:
        yield emulator, None


def loop(
    given: LoopSettings, controller: Controller, held: bool, real_time: bool
) -> dict[str, Any]:
    """Run ``controller`` for the time asked for; figures of its report and log."""
    refused = patch.object(ticker, "_real_time", lambda *_: None)
    with (
        tempfile.TemporaryDirectory() as folder,
        (grasping if held else empty)(given.seed) as (emulator, grasp),
        Bus(emulator.port, IDS, timeout=0.03) as bus,
    ):
        source = EmulatedTactile(emulator) if held else None
        # late ticks are what is measured here: they must not end the run
        limits = replace(Limits().patient(given.patience), overruns=(1.0, 1.0))
        plant = ServoHand(bus, controller.hand, limits=limits, gains=GAINS, tactile=source,
                          control_period=controller.control_period)  # fmt: skip
        path = Path(folder) / "run.mcap"
        with LogWriter(path) as log:
            runner = Runner(plant, controller, needs_tactile=held, log=log, seed=given.seed)
            if real_time:
                report = runner.run(given.seconds, approach=grasp)
            else:
                with refused:
                    report = runner.run(given.seconds, approach=grasp)
        ticks = read_log(path).ticks
    late, wanted = ticks["lateness"], len(ticks["lateness"]) + report.skipped
    return {
        "controller": type(controller).__name__,
        "joints": "MuJoCo hand with a cylinder" if held else "first order",
        "real_time_scheduling": report.real_time,
        "outcome": report.outcome.value,
        "cause": report.cause.value if report.cause else None,
        "ticks": report.ticks,
        "skipped": report.skipped,
        "late_over_1ms": float(((late > LATE).sum() + report.skipped) / wanted),
        "lateness_s": {name: float(np.percentile(late, q)) for name, q in
                       (("p50", 50), ("p99", 99), ("p99.9", 99.9), ("max", 100))},
        "figures_s": report.figures,
        "log_messages_dropped": report.dropped,
        "load": os.getloadavg()[0],
    }  # fmt: skip


def main() -> None:
    given = settings(LoopSettings, __doc__)
    progress("cycles of the driver")
    taken, counts = cycles(given)
    spreads = {name: spread(seconds) for name, seconds in taken.items()}
    hand, period = dexctl.hands.load("dex5"), 1.0 / given.rate
    loops: list[dict[str, Any]] = []
    for controller, held, real_time in (
        (Sine(hand, control_period=period), False, True),
        (dexctl.InGraspManipulation(hand, control_period=period), True, True),
        (dexctl.InGraspManipulation(hand, control_period=period), True, False),
    ):
        progress(
            f"{type(controller).__name__}, real-time scheduling "
            f"{'asked for' if real_time else 'left out'}"
        )
        loops.append(loop(given, controller, held, real_time))
        figures = [
            _rate("", spreads["read and write"], GOAL_HZ),
            _rate(", and a question about the servos' health", spreads["and health"]),
            *(_lateness(given, row) for row in loops),
        ]
        write(
            "hardware_loop",
            given,
            figures,
            say=len(loops) == 3,
            spread=spreads,
            loops=loops,
            statistics=counts,
            processors=sorted(os.sched_getaffinity(0)),
        )


def _rate(more: str, found: dict[str, float], goal: int | None = None) -> Figure:
    rate = 1e6 / found["median_us"]
    return Figure(
        f"driver's cycle, 15 servos over a pseudo-terminal, all checks and limits on{more}",
        f"{rate:.0f} Hz median, p99 {found['p99_us'] / 1000:.2f} ms",
        f"at least {goal} Hz median" if goal else "",
        rate >= goal if goal else None,
    )


def _lateness(given: LoopSettings, row: dict[str, Any]) -> Figure:
    granted = row["real_time_scheduling"]
    return Figure(
        f"runner at {given.rate:g} Hz for {given.seconds:g} s, {row['controller']} on "
        f"{row['joints']}, {'with' if granted else 'without'} real-time scheduling: ticks late by "
        "more than 1 ms",
        f"{100 * row['late_over_1ms']:.2f} % of {row['ticks'] + row['skipped']}, p99 "
        f"{1e3 * row['lateness_s']['p99']:.2f} ms, load {row['load']:.1f}{_ended(row)}",
        f"under {100 * MOST_LATE[granted]:.0f} %",
        row["late_over_1ms"] < MOST_LATE[granted] and row["outcome"] == "idle",
    )


def _ended(row: dict[str, Any]) -> str:
    return "" if row["outcome"] == "idle" else f"; ended in {row['outcome']}: {row['cause']}"


if __name__ == "__main__":
    main()
