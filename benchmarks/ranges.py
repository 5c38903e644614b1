"""How much of each thing a policy stands: one setting after the other, palm up and palm down."""

from __future__ import annotations

import multiprocessing
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from measuring.results import FIXED, earlier, write
from measuring.settings import Settings, check_chosen, progress, settings
from measuring.shares import over_seeds, percent_interval, share

from dexctl.files import aside
from dexctl.report.style import INK, drawing, finger_colour, new_figure
from dexctl.settings import changed
from dexctl.sim.sensing import TRACKER
from learning.evaluation import Protocol, evaluate, open_subject

# setting: what stands under the axis, its factor, and the levels
VARIED: dict[str, tuple[str, float, tuple[float, ...]]] = {
    "friction_range": ("friction", 1.0, (0.4, 0.6, 0.8, 1.0, 1.4)),
    "tip_friction_range": ("friction of fingertips [%]", 1e2, (0.4, 0.6, 0.8, 1.0, 1.4)),
    "link_friction_range": ("friction of links [%]", 1e2, (0.2, 0.6, 1.0, 1.4)),
    "mass_range": ("mass [g]", 1e3, (0.05, 0.1, 0.2, 0.3, 0.4)),
    "size_range": ("width [%]", 1e2, (0.9, 0.95, 1.0, 1.05, 1.1)),
    "centre_of_mass": ("centre of mass off by up to [mm]", 1e3, (0.0, 0.005, 0.01, 0.02)),
    "stiffness_range": ("stiffness [%]", 1e2, (0.5, 0.7, 1.0, 1.3, 1.5)),
    "damping_range": ("damping [%]", 1e2, (0.5, 0.7, 1.0, 1.3, 1.5)),
    "armature_range": ("inertia of motors [g m$^2$]", 1e3, (0.0, 0.002, 0.005, 0.01, 0.02)),
    "gear_friction_range": ("gear friction [N m]", 1.0, (0.0, 0.02, 0.04, 0.08)),
    "speed_limit": ("speed limit [rad/s]", 1.0, (0.3, 0.6, 1.0, 2.0)),
    "torque_limit": ("torque limit [N m]", 1.0, (0.2, 0.3, 0.4, 0.5)),
    "action_latency": ("action latency [ms]", 1e3, (0.0, 0.05, 0.1, 0.15)),
    "sensor_latency": ("sensor latency [ms]", 1e3, (0.0, 0.05, 0.1, 0.15)),
    "joint_offset": ("encoders off by [rad]", 1.0, (0.0, 0.03, 0.06, 0.1)),
    "joint_noise": ("noise of joints [rad]", 1.0, (0.0, 0.02, 0.05, 0.1)),
    "position_noise": ("noise of contacts [mm]", 1e3, (0.0, 0.002, 0.004, 0.008)),
    "normal_noise": ("tilt of normals [rad]", 1.0, (0.0, 0.1, 0.2, 0.4)),
    "force_noise": ("noise of forces [N]", 1.0, (0.0, 0.5, 1.0, 2.0)),
    "touch_threshold": ("touch from [N]", 1.0, (0.05, 0.25, 0.5, 1.0)),
    "touch_dropout_range": ("touch not felt [%]", 1e2, (0.0, 0.1, 0.2, 0.4)),
    "push_force": ("pushes [N]", 1.0, (0.0, 0.5, 1.0, 2.0)),
    "gravity_turning_range": ("gravity turns at [rad/s]", 1.0, (0.0, 0.1, 0.2, 0.4)),
    "tracker_latency": ("a tracker is late by [ms]", 1e3, (0.0, 0.1, 0.2, 0.3)),
    "tracker_position_noise": ("a tracker is off by [mm]", 1e3, (0.0, 0.003, 0.006, 0.012)),
    "tracker_rotation_noise": ("a tracker is off by [rad]", 1.0, (0.0, 0.05, 0.1, 0.2)),
}
COLUMNS = 4
LINES = {"up": "-", "down": (0, (4, 2))}
MARKERS = "os^vDP"  # of one subject each: where curves lie on each other, all are seen


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    seed: int = 30_000
    """First seed; trial i has the seed seed + i."""
    trials: int = 32
    """Episodes for each level, object and palm direction."""
    seconds: float = 30.0
    """Of each."""
    who: tuple[str, ...] = ("dex5-easy-any", "dex5-robust", "coordinated", "dex5-seen")
    """Policies, by name or file, and controllers; the tracker's settings are varied for those that
    are told where the object is."""
    object: str = "cube"
    """Which."""
    varied: tuple[str, ...] = tuple(VARIED)
    """Which settings."""
    jobs: int = 1
    """How many rows are measured at the same time, each in a process."""
    picture: Path | None = Path(__file__).resolve().parents[1] / "docs" / "images" / "ranges.png"
    """Where the curves are drawn; None: nowhere."""


def measure(who: str, setting: str, level: float, palm: str, given: Options) -> dict[str, Any]:
    """One row: everything nominal, but for one setting."""
    value = (level, level) if setting.endswith("_range") else level
    base = Protocol(episodes=given.trials, seconds=given.seconds, seed=given.seed)
    asked = {"object": given.object, "gravity": palm, "threads": 1, setting: value}
    found = evaluate(open_subject(who), changed(base, asked))
    return {
        "who": who,
        "setting": setting,
        "level": level,
        "palm": palm,
        "object": given.object,
        "rotation_rad": over_seeds(found.rotation),
        "holding": share(~found.dropped),
    }


def key_of(row: dict[str, Any]) -> tuple[str, str, str, float]:
    """What tells a row from the others."""
    return row["setting"], row["who"], row["palm"], row["level"]


def is_told(who: str) -> bool:
    """Whether somebody is told where the object is."""
    trained = open_subject(who).trained
    return trained is not None and "object_position" in trained.env.parts


def draw(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """A panel for each setting: the share of episodes that hold, by its level."""
    names = [name for name in VARIED if any(row["setting"] == name for row in rows)]
    columns = min(COLUMNS, len(names))
    count = -(-len(names) // columns)
    subjects = list(dict.fromkeys(row["who"] for row in rows))
    with drawing():
        figure = new_figure(0.8 + 2.4 * columns, 0.6 + 1.8 * count)
        axes = figure.subplots(count, columns, sharey=True, squeeze=False)
        for panel in axes.flat[len(names) :]:
            panel.set_visible(False)
        for panel, name in zip(axes.flat, names, strict=False):
            label, factor, _ = VARIED[name]
            for (i, who), (palm, style) in product(enumerate(subjects), LINES.items()):
                if mine := [
                    (factor * row["level"], 100 * row["holding"]["share"])
                    for row in rows
                    if key_of(row)[:3] == (name, who, palm)
                ]:
                    panel.plot(
                        *np.array(sorted(mine)).reshape(-1, 2).T,
                        color=finger_colour(i),
                        ls=style,
                        marker=MARKERS[i % len(MARKERS)],
                        ms=4.5 - 0.5 * i,
                        label=f"{who}, palm {palm}",
                    )
            panel.set(xlabel=label, ylim=(-5, 105), yticks=(0, 25, 50, 75, 100))
        for row in axes:
            row[0].set_ylabel("episodes held [%]")
        handles, labels = axes[0, 0].get_legend_handles_labels()
        # a column for each subject, as many as there is room for
        ncols = min(len(subjects), columns)
        figure.legend(
            handles,
            labels,
            loc="outside upper left",
            ncols=ncols,
            labelcolor=INK,
            handlelength=3.2,  # dashes are seen beside the marker
        )
        with aside(path) as part:
            figure.savefig(part)


def save(rows: list[dict[str, Any]], given: Options, *, say: bool) -> None:
    """Write the result with the rows so far."""
    keys = [(who, palm) for who in dict.fromkeys(row["who"] for row in rows) for palm in LINES]
    by = {key_of(row): row for row in rows}
    lines = [
        [
            label.replace("$^2$", "^2"),
            f"{factor * level:g}",
            *(
                f"{percent_interval(row['holding'])}, {row['rotation_rad']['median']:.1f} rad"
                if (row := by.get((name, *key, level))) is not None
                else ""
                for key in keys
            ),
        ]
        for name, (label, factor, levels) in VARIED.items()
        for level in levels
        if any((name, *key, level) in by for key in keys)
    ]
    table = {
        "title": f"One setting at a time, the {given.object}, {given.trials} episodes of "
        f"{given.seconds:g} s each: share still holding (95 % interval), median rotation",
        "header": ["", "", *(f"{who}, palm {palm}" for who, palm in keys)],
        "rows": lines,
    }
    write("ranges", given, [], [table], trials=rows, say=say)


def main() -> None:
    given = settings(Options, __doc__)
    check_chosen("setting", given.varied, VARIED)
    rows = {key_of(row): row for row in earlier("ranges", given, (*FIXED, "object"))}
    told = {who for who in given.who if is_told(who)}
    order = [
        (name, who, palm, level)
        for name in given.varied
        for who in given.who
        if who in told or name not in TRACKER
        for palm in LINES
        for level in VARIED[name][2]
    ]

    def in_order() -> list[dict[str, Any]]:
        known = dict.fromkeys((*order, *rows))  # whichever was done first
        return [rows[key] for key in known if key in rows]

    spawn = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(given.jobs, spawn)
    try:
        waiting = {
            pool.submit(measure, who, name, level, palm, given): (name, who, palm, level)
            for name, who, palm, level in order
            if (name, who, palm, level) not in rows
        }
        for done in as_completed(waiting):
            name, who, palm, level = key = waiting[done]
            rows[key] = done.result()
            save(in_order(), given, say=False)
            progress(f"{who}, {name} {level:g}, palm {palm}: {rows[key]['holding']['share']}")
    finally:
        pool.shutdown(cancel_futures=True)
    save(in_order(), given, say=True)
    if given.picture is not None:
        draw(given.picture, in_order())


if __name__ == "__main__":
    main()
