"""The same controllers in the simulator and through bus and emulated servos, holding a cylinder.

First the traces: each controller with one seed, once on the simulator and once through wire and
servos, in manual time so that a busy machine changes nothing. The controller sees the same on
both: no object pose, touch from 1 N on, set-points of 0.6 rad/s at most. A figure shows rotation
and joints side by side.

Then 60 s in real time through the runner, with the limits of the thesis's hand (0.6 rad/s, 0.5 N m)
and 0.05 s from a set-point to its effect, for in-grasp manipulation and the coordinated gait;
beside it the bare simulator, which tells the object's pose, and the simulator with those limits and
touch alone. The object counts as dropped when its centre has moved by more than 0.05 m; rotation is
counted up to there.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from measuring.results import Figure, read, write
from measuring.settings import Settings, progress, settings
from measuring.shares import over_seeds, share

from dexctl import Controller, GraspState, controllers
from dexctl.exceptions import MissingExtra
from dexctl.limits import REAL_SPEED, REAL_TORQUE, HandLimits
from dexctl.plant import Plant
from dexctl.sim import BatchSimulator, LimitedHand, Scene, run
from dexctl.sim.trial import DROP_DISTANCE, rotation_about
from hardware.bus import Bus
from hardware.emulated_touch import EmulatedTactile
from hardware.emulator import Emulator
from hardware.hand import ServoHand
from hardware.limits import Limits
from hardware.log import LogWriter, read_log
from hardware.runner import Runner
from hardware.scene import HOLDING
from hardware.tactile import TRUSTED_FORCE
from hardware.units import SimGains, to_servo

HELD = replace(HOLDING, hand="dex5", object=("cylinder",), gravity="up")
PERIOD, TIMESTEP, SETTLE = 0.02, 0.005, 1.0
ROW = 25  # ticks between those of the traces that are kept in the result
REAL = HandLimits.real()
GAINS = to_servo(SimGains(3.0, 0.15, REAL_TORQUE, REAL_SPEED))
# the emulator's time stands still between ticks; the wall clock says nothing
UNHURRIED = Limits(watchdog=2.0, state_age=10.0, command_age=10.0)
NAMES = ("igm", "coordinated")


@dataclass(frozen=True, kw_only=True)
class GraspSettings(Settings):
    """Simulator and servo bus side by side."""

    seconds: float = 60.0
    """Of each run through the bus, in real time, and in the simulator."""
    trace_seconds: float = 60.0
    """Of the traces."""
    trials: int = 16
    """In the simulator."""
    repeats: int = 3
    """Through the bus."""
    patience: float = 1.0
    """Allow so many times more silence and age than on a hand: on a busy machine."""
    picture: Path | None = None
    """Where the traces are drawn, such as docs/images/hardware-trace.png."""


class Unseeing:
    """A plant whose object nobody tracks, as on a real hand."""

    def __init__(self, plant: Plant) -> None:
        self._plant = plant
        self.hand, self.control_period = plant.hand, plant.control_period
        self.write, self.step = plant.write, plant.step

    def read(self) -> GraspState:
        return replace(self._plant.read(), object_position=None, object_quaternion=None)


def _scene() -> Scene:
    (scene,) = HELD.scenes()
    return scene


def _simulator(scene: Scene, count: int | None, *, disturbance: float) -> BatchSimulator:
    return BatchSimulator(
        scene,
        count,
        control_period=PERIOD,
        substeps=round(PERIOD / TIMESTEP),
        touch_threshold=TRUSTED_FORCE,
        disturbance=disturbance,
    )


# -- traces ---------------------------------------------------------------------------------


def _follow(plant: Plant, controller: Controller, seconds: float, seed: int, pose, wait) -> dict:
    """Rows of a run: joints ``(T, d)`` and the object's attitude ``(T, 4)``."""
    controller.reset(seed)
    q, attitude, contacts = [], [], []
    for _ in range(round(seconds / PERIOD)):
        state = plant.read()
        q.append(state.q)
        attitude.append(pose())
        contacts.append(int(state.in_contact.sum()))
        plant.write(state.q_target + controller.act(state))
        wait()
    angle = rotation_about(np.array(attitude))
    return {"q": np.array(q), "rotation": angle, "contacts": np.array(contacts)}


def simulated_trace(scene: Scene, controller: Controller, seconds: float, seed: int) -> dict:
    """The run in the simulator."""
    with _simulator(scene, None, disturbance=0.0) as sim:
        for _ in range(round(SETTLE / PERIOD)):
            sim.step()
        plant = LimitedHand(Unseeing(sim), replace(REAL, action_latency=0.0), scene.stiffness)
        return _follow(plant, controller, seconds, seed,
                       lambda: sim.read().object_quaternion, plant.step)  # fmt: skip


def emulated_trace(scene: Scene, controller: Controller, seconds: float, seed: int) -> dict:
    """The run through bus and emulated servos."""
    grasp = scene.settled.q_target
    with (
        Emulator(dynamics="mujoco", scene=HELD, manual=True) as emulator,
        Bus(emulator.port, range(1, 16), timeout=0.5) as bus,
    ):
        source = EmulatedTactile(emulator)
        plant = ServoHand(bus, scene.hand, limits=UNHURRIED, gains=GAINS, tactile=source,
                          control_period=PERIOD)  # fmt: skip
        plant.arm()
        for _ in range(round(30.0 / PERIOD)):  # to the grasp; the object is held meanwhile
            plant.write(grasp)
            emulator.advance(PERIOD)
            plant.sample()
            touch = emulator.touch()
            if touch is not None and not touch["supported"]:
                break
        else:
            raise SystemExit("the fingers do not press on the object")
        for _ in range(round(SETTLE / PERIOD)):
            plant.write(grasp)
            emulator.advance(PERIOD)
        found = _follow(plant, controller, seconds, seed,
                        lambda: source.truth["object_quaternion"],
                        lambda: emulator.advance(PERIOD))  # fmt: skip
        plant.disarm()
        return found


def traces(given: GraspSettings, scene: Scene) -> tuple[dict[str, Any], dict[str, dict]]:
    """Figures of each controller's two traces, and the traces."""
    made: dict[str, dict] = {}
    found: dict[str, Any] = {}
    for name in NAMES:
        made[name] = {}
        for where, follow in (("simulator", simulated_trace), ("bus", emulated_trace)):
            progress(f"trace of {name}, {where}")
            controller = controllers.make(name, scene.hand, control_period=PERIOD)
            made[name][where] = follow(scene, controller, given.trace_seconds, given.seed)
        found[name] = {"seconds": given.trace_seconds, **_apart(made[name])}
    return found, made


def _apart(pair: dict[str, dict]) -> dict[str, Any]:
    apart = pair["simulator"]["q"] - pair["bus"]["q"]
    turn = np.abs(pair["simulator"]["rotation"] - pair["bus"]["rotation"])
    return {
        "joint_rms_mrad": round(1e3 * float(np.sqrt(np.mean(apart**2))), 2),
        # before small differences have grown: the same hand, the same controller
        "joint_rms_first_20_s_mrad": round(
            1e3 * float(np.sqrt(np.mean(apart[: round(20 / PERIOD)] ** 2))), 2
        ),
        "joint_worst_mrad": round(1e3 * float(np.abs(apart).max()), 1),
        "rotation_rad": {k: round(float(v["rotation"][-1]), 4) for k, v in pair.items()},
        "rotation_apart_worst_rad": round(float(turn.max()), 4),
        "mean_contacts": {k: round(float(v["contacts"].mean()), 2) for k, v in pair.items()},
        "over_time": {
            "time_s": [round(PERIOD * i, 2) for i in range(0, len(apart), ROW)],
            "joint_rms_mrad": [
                round(1e3 * float(np.sqrt(np.mean(apart[i] ** 2))), 2)
                for i in range(0, len(apart), ROW)
            ],
            **{
                f"rotation_{where}_rad": np.round(trace["rotation"][::ROW], 4).tolist()
                for where, trace in pair.items()
            },
        },
    }


def draw(made: dict[str, dict], path: Path) -> None:
    """Rotation, joints in the simulator, joints through the bus, and their difference."""
    try:
        from dexctl.report.style import drawing, finger_colour, new_figure
    except ImportError:
        raise MissingExtra("--picture", "viz") from None
    with drawing():
        figure = new_figure(10.0, 9.0)
        grid = figure.subplots(4, len(made), sharex="col")
        for (name, pair), column in zip(made.items(), grid.T, strict=True):
            time = PERIOD * np.arange(len(pair["bus"]["q"]))
            column[0].plot(time, pair["simulator"]["rotation"], label="simulator")
            column[0].plot(time, pair["bus"]["rotation"], "--", label="bus, emulated servos")
            column[0].set(title=f"{controllers.entry(name).title}: rotation", ylabel="rad")
            column[0].legend(loc="lower right")
            apart = 1e3 * (pair["simulator"]["q"] - pair["bus"]["q"])
            panels = (
                ("joints, simulator", "rad", pair["simulator"]["q"]),
                ("joints, through bus and emulated servos", "rad", pair["bus"]["q"]),
                ("joints, simulator less bus", "mrad", apart),
            )
            for axes, (title, unit, values) in zip(column[1:], panels, strict=True):
                for j in range(values.shape[1]):
                    axes.plot(time, values[:, j], color=finger_colour(j // 3), linewidth=0.7)
                axes.set(title=title, ylabel=unit)
            column[-1].set(xlabel="time [s]")
        figure.savefig(path, dpi=110)


# -- 60 s -----------------------------------------------------------------------------------


def simulated(scene: Scene, name: str, given: GraspSettings, *, as_real: bool) -> dict[str, Any]:
    """Trials in the simulator, bare or with the limits and senses of the servo hand."""
    controller = controllers.make(name, scene.hand, control_period=PERIOD)
    with _simulator(scene, given.trials, disturbance=0.02) as sim:
        sim.reset(given.seed)
        controller.reset(given.seed)
        plant = LimitedHand(Unseeing(sim), REAL, scene.stiffness)
        trace = run(controller, sim, given.seconds, plant=plant if as_real else None)
    return {
        "controller": name,
        "where": "simulator, limits and touch of the servo hand" if as_real else "bare simulator",
        "rotation_rad": over_seeds(trace.final_rotation),
        "holding": share(trace.held[-1]),
        "latency_s": REAL.action_latency if as_real else 0.0,
    }


def _outcome(position: np.ndarray, quaternion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    away = np.linalg.norm(position - position[0], axis=-1)
    held = np.logical_and.accumulate(away <= DROP_DISTANCE, axis=0)
    return rotation_about(quaternion, held=held)[-1], held[-1]


def emulated(scene: Scene, name: str, given: GraspSettings, seed: int) -> dict[str, Any]:
    """One run through the bus, in real time."""
    controller = controllers.make(name, scene.hand, control_period=PERIOD)
    with (
        tempfile.TemporaryDirectory() as folder,
        Emulator(dynamics="mujoco", scene=replace(HELD, limits=REAL), seed=seed) as emulator,
        Bus(emulator.port, range(1, 16), timeout=0.03) as bus,
    ):  # fmt: skip
        source = EmulatedTactile(emulator)
        plant = ServoHand(bus, scene.hand, limits=Limits().patient(given.patience), gains=GAINS,
                          tactile=source, control_period=PERIOD)  # fmt: skip
        path = Path(folder) / "run.mcap"
        with LogWriter(path) as log:
            runner = Runner(plant, controller, log=log, seed=seed, extra=lambda: source.truth)
            report = runner.run(given.seconds, approach=scene.settled.q_target)
        ticks = read_log(path).ticks
    ran = ticks["state"] == "run"
    rotation, held = _outcome(
        *(np.array(ticks[key][ran].tolist(), float)
          for key in ("object_position", "object_quaternion"))
    )  # fmt: skip
    return {
        "controller": name,
        "where": "bus and emulated servos",
        "seed": seed,
        "rotation_rad": round(float(rotation), 4),
        "holding": bool(held),
        "outcome": report.outcome.value,
        "cause": report.cause.value if report.cause else None,
        "torque": report.torque_message,
        "seconds": round(float(np.ptp(ticks["time"][ran])), 2),
        "ticks": report.ticks,
        "skipped": report.skipped,
        "late_over_1ms": round(float((ticks["lateness"] > 1e-3).mean()), 5),
        "real_time_scheduling": report.real_time,
        "counts": {event.value: count for event, count in report.counts.items()},
    }


def _kept(given: GraspSettings) -> tuple[dict[str, Any] | None, list[dict[str, Any]]]:
    """With --resume, the earlier result but for the runs in real time, which the machine shapes."""
    path = given.out / "hardware_grasp.json"
    if not (given.resume and path.is_file()):
        return None, []
    found = read(path)
    fixed = ("seed", "trials", "seconds", "trace_seconds")
    if any(found["settings"][key] != getattr(given, key) for key in fixed):
        return None, []
    return found["trace"], [row for row in found["runs"] if "seed" not in row]


def main() -> None:
    given = settings(GraspSettings, __doc__)
    scene = _scene()
    compared, rows = _kept(given)
    if compared is None:
        compared, made = traces(given, scene)
        if given.picture is not None:
            draw(made, given.picture)
    for name in NAMES:
        for as_real in (False, True):
            if not any(r["controller"] == name and ("limits" in r["where"]) is as_real
                       for r in rows):  # fmt: skip
                progress(f"{name} in the simulator{', as real' if as_real else ''}")
                rows.append(simulated(scene, name, given, as_real=as_real))
        for i in range(given.repeats):
            progress(f"{name} through the bus, {given.seconds:g} s")
            rows.append(emulated(scene, name, given, given.seed + i))
    write("hardware_grasp", given, _figures(given, compared, rows), [_table(given, rows)],
          trace=compared, runs=rows)  # fmt: skip


def _bus(rows: list[dict[str, Any]], name: str) -> list[dict[str, Any]]:
    return [row for row in rows if row["controller"] == name and "seed" in row]


def _figures(
    given: GraspSettings, compared: dict[str, Any], rows: list[dict[str, Any]]
) -> list[Figure]:
    found = []
    for name in NAMES:
        pair = compared[name]
        turned = pair["rotation_rad"]
        found.append(
            Figure(
                f"{controllers.entry(name).title} of a cylinder for {pair['seconds']:g} s, same "
                "seed, in the simulator and through bus and emulated servos",
                f"{turned['simulator']:.2f} and {turned['bus']:.2f} rad; joints "
                f"{pair['joint_rms_first_20_s_mrad']:.1f} mrad RMS apart over the first 20 s, "
                f"{pair['joint_rms_mrad']:.1f} over all",
            )
        )
    for name in NAMES:
        runs = _bus(rows, name)
        whole = [row for row in runs if row["holding"] and row["outcome"] == "idle"]
        angles = ", ".join(f"{row['rotation_rad']:.2f}" for row in runs)
        found.append(
            Figure(
                f"{controllers.entry(name).title} for {given.seconds:g} s in real time through the "
                f"emulated bus, {REAL_SPEED:g} rad/s, {REAL_TORQUE:g} N m, "
                f"{REAL.action_latency:g} s latency",
                f"{len(whole)} of {len(runs)} runs to the end; {angles} rad",
                "to the end",
                len(whole) == len(runs),
            )
        )
    return found


def _table(given: GraspSettings, rows: list[dict[str, Any]]) -> dict[str, Any]:
    def sim(name: str, where: str) -> str:
        row = next(r for r in rows if r["controller"] == name and r["where"].startswith(where))
        angle, held = row["rotation_rad"], row["holding"]
        return (
            f"{angle['median']:.2f} ({angle['p10']:.2f} to {angle['p90']:.2f}) rad, "
            f"{held['count']} of {held['of']} hold"
        )

    def bus(name: str) -> str:
        runs = _bus(rows, name)
        angles = ", ".join(f"{row['rotation_rad']:.2f}" for row in runs)
        return f"{angles} rad, {sum(row['holding'] for row in runs)} of {len(runs)} hold"

    return {
        "title": f"A cylinder turned for {given.seconds:g} s, palm up, control at 50 Hz: simulator "
        "(median, 10 % to 90 %) and emulated servo bus (each run)",
        "header": ["", "bare simulator", "simulator with the hand's limits, latency and touch",
                   "through bus and emulated servos"],
        "rows": [
            [controllers.entry(name).title, sim(name, "bare"), sim(name, "simulator"), bus(name)]
            for name in NAMES
        ],
    }  # fmt: skip


if __name__ == "__main__":
    main()
