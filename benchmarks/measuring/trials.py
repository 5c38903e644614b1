"""Trials of a controller in simulation, what they came to, and tables of them by scene."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product
from typing import Any

import numpy as np

from dexctl.controller import Controller
from dexctl.rotations import inverse, multiply
from dexctl.sim import Scene, SceneConfig, Simulation, Trace, run
from measuring.results import earlier, write
from measuring.settings import check_chosen, progress
from measuring.shares import over_seeds, percent_interval, rounded, share

FULL_TURN = 2 * np.pi
PALMS = ("up", "down")


def trials(
    controller: Controller,
    config: SceneConfig,
    seconds: float,
    count: int,
    *,
    seed: int = 0,
    parameters: dict[str, float] | None = None,
) -> Trace:
    """``count`` trials by the protocol of every measurement (see `dexctl.sim.run`)."""
    with Simulation(config, count, seed, hand=controller.hand) as sim:
        if parameters:
            sim.sim.set_parameters(**parameters)
        sim.reset(seed)
        controller.reset(seed)
        return run(controller, sim, seconds)


def controls(scene: Scene, q_target: np.ndarray, substeps: int) -> np.ndarray:
    """What MuJoCo gets to hold set-points ``(N, d)``, ``(N, substeps, nu)``."""
    ctrl = np.zeros((len(q_target), scene.model.nu))
    ctrl[:, scene.actuators] = q_target * scene.ctrl_per_radian
    return np.repeat(ctrl[:, None], substeps, axis=1)


def outcome(trace: Trace, target: float = FULL_TURN) -> dict[str, Any]:
    """What trials came to: rotation up to the drop, time held, and what stopped them.

    ``reached`` counts trials that turned the object by ``target`` [rad] before any drop;
    ``stalled`` those that still hold it and turned it by less than 0.1 rad in the last quarter.
    ``drift_mm`` is how far its centre was from where it had been at the start, the largest while
    it was held.
    """
    rotation, held = trace.rotation, trace.held
    quarter = len(rotation) - max(len(rotation) // 4, 1)
    last = rotation[-1] - rotation[quarter - 1]
    reached = rotation.max(axis=0) >= target
    other = (trace.other_contact > 0) & held
    away = np.linalg.norm(trace.object_position - trace.object_position[0], axis=-1)
    drift = 1000 * np.where(held, away, 0.0).max(axis=0)
    return {
        "rotation_rad": over_seeds(rotation[-1]),
        "time_held_s": over_seeds(trace.time_held),
        "holding": share(held[-1]),
        "target_rad": rounded(target),
        "reached": share(reached),
        "reached_and_holding": share(reached & held[-1]),
        "stalled": share(held[-1] & (np.abs(last) < 0.1)),
        "drift_mm": {**over_seeds(drift), "largest": rounded(drift.max())},
        "second_before_drop": _before_drop(trace),
        "broke_down": _broke_down(trace),
        "mean_contacts": rounded((trace.in_contact.sum(axis=-1) * held).sum() / held.sum()),
        "touched_by_more_than_fingertips": rounded(other.sum() / held.sum()),
        "only_fingertips": rounded(1.0 - other.sum() / held.sum()),
    }


def _before_drop(trace: Trace) -> dict[str, float] | None:
    """How trials stood a second before they dropped the object, medians; None if none did."""
    dropped = np.flatnonzero(trace.dropped)
    if not len(dropped):
        return None
    period = float(trace.time[1] - trace.time[0])
    row = np.maximum(trace.held.sum(axis=0) - 1 - round(1.0 / period), 0)[dropped]
    pose = trace.object_quaternion[:, dropped]
    turned = multiply(pose[row, np.arange(len(row))], inverse(pose[0]))
    tilt = np.arccos(np.clip(1 - 2 * (turned[:, 1] ** 2 + turned[:, 2] ** 2), -1, 1))
    away = trace.object_position[row, dropped] - trace.object_position[0, dropped]
    return {
        "fingers_touching": rounded(np.median(trace.in_contact[row, dropped].sum(axis=-1))),
        "tilt_rad": rounded(np.median(tilt)),
        "height_m": rounded(np.median(away[:, 2])),
        "sideways_m": rounded(np.median(np.linalg.norm(away[:, :2], axis=-1))),
    }


def _broke_down(trace: Trace) -> int:
    """Trials that ended because the simulation broke down, not because the object fell."""
    first = np.minimum(trace.held.sum(axis=0), len(trace.held) - 1)
    return int(trace.diverged[first, np.arange(len(first))].sum())


def grid(
    rows: Sequence[dict[str, Any]], key: str, texts: dict[str, str], scenes: Sequence[Any]
) -> tuple[list[str], list[list[str]]]:
    """Header and lines of a table: one line for each ``row[key]``, one column for each scene.

    Cells have the median rotation and the share still holding with its Wilson interval.
    """
    cells = {
        (row[key], row["object"], row["palm"]): f"{row['rotation_rad']['median']:.1f} rad, "
        + percent_interval(row["holding"])
        for row in rows
    }
    lines = [
        [text, *(cells.get((name, *scene), "") for scene in scenes)]
        for name, text in texts.items()
        if any(row[key] == name for row in rows)
    ]
    return ["", *(f"{name}, palm {palm}" for name, palm in scenes)], lines


def measure_in_scenes(
    name: str,
    given: Any,
    column: str,
    texts: dict[str, str],
    chosen: Sequence[str],
    scenes: Sequence[tuple[str, str]],
    title: str,
    measure: Callable[[str, SceneConfig], Trace],
) -> None:
    """One row for each one chosen and each scene; written after every row.

    Args:
        name: of the script.
        given: its settings, with trials and seconds.
        column: what a row calls the one that was measured.
        texts: name of one: what people read.
        chosen: those that are measured.
        scenes: (object, palm).
        title: of the table, before its "median rotation in ...".
        measure: (one, scene) -> its trials.
    """
    check_chosen(column, chosen, texts)
    rows = earlier(name, given)

    def save(*, say: bool) -> list[list[str]]:
        header, lines = grid(rows, column, texts, scenes)
        table = {
            "title": f"{title}: median rotation in {given.seconds:g} s, share still holding "
            f"(95 % interval), {given.trials} trials each",
            "header": header,
            "rows": lines,
        }
        write(name, given, [], [table], trials=rows, say=say)
        return lines

    done = {(row[column], row["object"], row["palm"]) for row in rows}
    for one, (turned, palm) in product(chosen, scenes):
        if (one, turned, palm) in done:
            continue
        trace = measure(one, SceneConfig(object=(turned,), gravity=palm))
        rows.append({column: one, "object": turned, "palm": palm, **outcome(trace)})
        (line,) = (line for line in save(say=False) if line[0] == texts[one])
        cell = line[1 + scenes.index((turned, palm))]
        progress(f"{one}, {turned}, palm {palm}: {cell}")
    save(say=True)
