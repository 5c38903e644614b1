"""Does a policy turn at the speed that it is told? One told the most that is worth, one to keep it.

The same training twice, cylinder and cube about z with another speed every ten seconds: what is
faster than the command is worth no more, or ever less (`keep_speed`). Then each is alone, with one
speed an episode. A training that is there is not done again, or goes on.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from measuring.results import Figure, earlier, write
from measuring.settings import Settings, progress, settings
from measuring.shares import over_seeds, percent_interval, share

from dexctl.settings import changed
from learning.config import TrainConfig, recipe
from learning.evaluation import evaluate, open_subject
from learning.training.run_folder import RunFolder

OBJECTS = ("cylinder", "cube")
TITLES = {"kept": "a speed to keep", "capped": "the most that is worth"}
PARTS = ("q", "q_target", "contact_position", "contact_normal", "contact_force")


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    steps: int = 1_000_000
    """Environment steps of each training; the guide stops after 4 of 10."""
    num_envs: int = 128
    """Environments of each."""
    speeds: tuple[float, ...] = (0.2, 0.4, 0.6, 0.8, 1.0)
    """Commanded in evaluation [rad/s]."""
    trials: int = 32
    """Episodes of each policy with each object and speed."""
    seconds: float = 30.0
    """Of each."""
    trained_only: bool = False
    """Evaluate what has been trained, and train nothing."""
    runs: Path = Path("out/commanded_speed")
    """Folder of the trainings, WHAT-SEED; one that is there is taken as it is."""


def config(kept: bool, given: Options) -> TrainConfig:
    """Everything that a training is."""
    return changed(
        recipe("fast", "vge"),
        {
            "object": OBJECTS,
            "controllers": ("coordinated",),
            "commands": ("z",),
            "command_speed_range": (0.2, 1.0),
            "keep_speed": kept,
            "parts": (*PARTS, "goal_angular_velocity"),
            "critic_parts": (
                "object_position", "object_quaternion", "object_velocity", "fingertip_force",
            ),
            "hard_stop": max(int(0.4 * given.steps), 1),
            "steps": given.steps,
            "seed": given.seed,
            "num_envs": given.num_envs,
            "threads": 1,
        },
    )  # fmt: skip


def trained(what: str, given: Options) -> Path | None:
    """The run's folder, trained or gone on with; None where it is not there and is not to be."""
    from learning.training.trainer import resume, train

    folder = given.runs / f"{what}-{given.seed}"
    there = RunFolder.is_run(folder)
    if not given.trained_only:
        _ = resume(folder) if there else train(config(what == "kept", given), folder)
    return folder if there or not given.trained_only else None


def measure(what: str, folder: Path, given: Options) -> list[dict[str, Any]]:
    """The rows of a policy."""
    subject, rows = open_subject(str(folder)), []
    for name in OBJECTS:
        for speed in given.speeds:
            protocol = subject.protocol(
                object=name, command_speed_range=(speed, speed), command_seconds=given.seconds + 1,
                episodes=given.trials, seconds=given.seconds, seed=given.seed + 1000, threads=1,
            )  # fmt: skip
            found = evaluate(subject, protocol)
            turned = found.rotation / np.maximum(found.time_held, 1e-9)
            rows.append(
                {
                    "told": what,
                    "object": name,
                    "commanded_rad_s": speed,
                    "training_seed": given.seed,
                    "steps": int(RunFolder(folder).progress()[-1]["step"]),
                    "speed_rad_s": over_seeds(turned),
                    "error_rad_s": over_seeds(np.abs(turned - speed)),
                    "dropped": share(found.dropped),
                }
            )
            progress("; ".join(line(rows[-1])))
    return rows


def line(row: dict[str, Any]) -> list[str]:
    """A line of the table."""
    speed = row["speed_rad_s"]
    low, high = speed["bootstrap95"]
    return [
        TITLES[row["told"]],
        row["object"],
        f"{row['commanded_rad_s']:g}",
        f"{speed['median']:.2f} ({low:.2f}-{high:.2f})",
        percent_interval(row["dropped"]),
    ]


def figures(rows: list[dict[str, Any]]) -> list[Figure]:
    """How far off the commanded speed each policy is."""
    found = []
    for what, title in TITLES.items():
        own = [row for row in rows if row["told"] == what]
        if own:
            off = [row["error_rad_s"]["median"] for row in own]
            lost, of = (sum(row["dropped"][k] for row in own) for k in ("count", "of"))
            found.append(
                Figure(
                    f"policy that is told a speed, {title}: off by, median over speeds and objects",
                    f"{np.median(off):.2f} rad/s, {lost} of {of} dropped",
                )
            )
    return found


def main() -> None:
    given = settings(Options, __doc__)
    rows: list[dict[str, Any]] = earlier("commanded_speed", given)
    done = {row["told"] for row in rows}
    for what in TITLES:
        folder = None if what in done else trained(what, given)
        if folder is not None:
            rows += measure(what, folder, given)
    table = {
        "title": f"Speeds that are commanded about z: {given.trials} episodes of {given.seconds:g} "
        "s each, speed up to the end or the drop, median (95 % interval); one seed each",
        "header": ["Told", "Object", "Commanded [rad/s]", "Turned [rad/s]", "Dropped"],
        "rows": [line(row) for row in rows],
    }
    write("commanded_speed", given, figures(rows), [table], trials=rows)


if __name__ == "__main__":
    main()
