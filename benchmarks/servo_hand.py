"""Policies and controllers on the emulated servo hand: the thesis's table for its real one.

Each trial is the command `dexctl hardware run --emulate`, in real time: bus, runner, servos with
0.6 rad/s, 0.5 N m, 50 ms from a set-point to its effect, touch from 1 N on, joint origins that are
off. Who has to know where the object is, is told by touch, or with ``--pose tracked`` by a tracker
that is late and has noise. Rotation counts up to a drop (centre 50 mm from where the controller
began) or the end.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import Any, Literal

import numpy as np
from measuring.poses import LATE, by_tracker
from measuring.results import Figure, earlier, write
from measuring.servo import emulated_run, side_by_side
from measuring.settings import Settings, progress, settings
from measuring.shares import over_seeds, percent_interval, share
from measuring.trials import FULL_TURN

from learning.evaluation import open_subject

THESIS = {
    "cylinder": (5.0, 0.42),
    "cube": (4.5, 0.44),
    "cuboid_tall": (1.5, 0.44),
    "l_shape": (1.5, 0.24),
}
"""Median revolutions before a drop and speed [rad/s] of the thesis's policies on its real hand."""


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    who: tuple[str, ...] = ("coordinated",)
    """Policies, policy files, run folders or controllers."""
    objects: tuple[str, ...] = tuple(THESIS)
    """Which."""
    trials: int = 10
    """Of each with each object."""
    seconds: float = 120.0
    """Of each; in the thesis until the drop, or 10 minutes."""
    joint_offset: float = 0.03
    """Standard deviation of what encoders read at zero: 0.1 rad at the very most [rad]."""
    most_offset: float = 0.0
    """Above 0: they read up to this each way, evenly, in place of that [rad]."""
    jobs: int = 3
    """Trials at a time; each takes a quarter of a core."""
    pose: Literal["touch", "tracked"] = "touch"
    """By what those know the object's pose who need it."""
    tracker_latency: float = LATE["tracker_latency"]
    """How late a tracker is [s]."""
    tracker_position_noise: float = LATE["tracker_position_noise"]
    """Standard deviation of each coordinate that it tells [m]."""
    tracker_rotation_noise: float = LATE["tracker_rotation_noise"]
    """And of each of three angles [rad]."""


TRACKER = tuple(LATE)  # as `by_tracker` takes them


@cache
def needs_pose(who: str) -> bool:
    """Whether somebody acts only where the object's pose is known."""
    return open_subject(who).controller.tracks


def pose_of(who: str, given: Options) -> str:
    """From where somebody knows it."""
    return given.pose if needs_pose(who) else "unknown"


def tracker(pose: str, given: Options) -> dict[str, float]:
    """What the tracker is like, by setting, where there is one."""
    return {name: getattr(given, name) for name in TRACKER} if pose == "tracked" else {}


def trial(who: str, turned: str, seed: int, given: Options) -> dict[str, Any]:
    """One run."""
    pose = pose_of(who, given)
    told = tracker(pose, given)
    words = [
        word for name, value in told.items() for word in (f"--{name.replace('_', '-')}", f"{value}")
    ]
    off = ["--joint-offset", f"{given.joint_offset:g}"]
    if given.most_offset:
        most = f"{given.most_offset:g}"
        off = ["--joint-offset", "0", "--joint-offset-range", f"-{most},{most}"]
    found = emulated_run(
        who, "--object", turned, "--seconds", f"{given.seconds:g}", "--seed", str(seed),
        "--object-pose", pose, *off, *words,
    )  # fmt: skip
    figures = found["figures"]
    lost = figures.get("object_lost_at_s")
    return {
        "who": who,
        "object": turned,
        "seed": seed,
        "object_pose": pose,
        "seconds": given.seconds,
        **offset(given),
        **told,
        "rotation_rad": figures["rotation_rad"],
        "lost_at_s": lost,
        # 0: it was lost, or the run ended, before the controller began
        "mean_speed_rad_s": figures.get("turning_speed_rad_s", 0.0),
        "outcome": found["outcome"],
        "cause": found["cause"],
    }


def offset(given: Options) -> dict[str, float]:
    """How far origins are off, where they are off evenly."""
    return {"most_offset": given.most_offset} if given.most_offset else {}


def kind(row: dict[str, Any]) -> tuple[Any, ...]:
    """What trials have in common: who turns what, by which pose and tracker, for how long.

    And how far origins are off.
    """
    return (
        row["who"], row["object"], row.get("object_pose", "unknown"), row["seconds"],
        *(row.get(name) for name in (*TRACKER, "most_offset")),
    )  # fmt: skip


def told_of(row: dict[str, Any]) -> str:
    """By what the pose is known, and how far origins are off where not as usual, for people."""
    pose, even = row.get("object_pose"), ""
    if "most_offset" in row:
        even = f", origins off by up to {row['most_offset']:g} rad, evenly"
    if pose == "tracked":
        return f", {by_tracker(*(row[name] for name in TRACKER))}{even}"
    return ", told by touch" * (pose == "touch") + even


def save(rows: list[dict[str, Any]], given: Options, *, say: bool) -> None:
    """Write the result with the trials so far."""
    figures, lines = [], []
    known = list(THESIS)
    kinds = sorted(
        {kind(row) for row in rows},
        key=lambda one: (
            one[0], str(one[2:]), known.index(one[1]) if one[1] in known else len(known), one[1]
        ),
    )  # fmt: skip
    for chosen in kinds:
        mine = [row for row in rows if kind(row) == chosen]
        who, turned, _, seconds, *_ = chosen
        turns = np.array([row["rotation_rad"] for row in mine]) / FULL_TURN
        speed = np.array([row["mean_speed_rad_s"] for row in mine])
        kept = share(np.array([row["lost_at_s"] is None for row in mine]))
        revolutions, fast = THESIS.get(turned, (0.0, 0.0))
        median, low, high = (over_seeds(turns)[key] for key in ("median", "p10", "p90"))
        lines.append(
            [
                who + told_of(mine[0]),
                turned,
                f"{seconds:g}",
                f"{median:.1f} ({low:.1f} to {high:.1f})",
                f"{np.median(speed):.2f} rad/s",
                f"{revolutions:g} at {fast:g} rad/s" if revolutions else "",
                percent_interval(kept),
            ]
        )
        asked = [(1, "")] if mine[0].get("object_pose") != "tracked" else [(1, ""), (10, "ten ")]
        for times, word in asked:
            goal = f"{revolutions:g} at {fast:g} rad/s (thesis, real hand)"
            if word:
                goal = f"{word}times the thesis's revolutions, {times * revolutions:g}, as fast"
            figures.append(
                Figure(
                    f"emulated servo hand, {who}{told_of(mine[0])}, {turned}: median revolutions "
                    f"in {seconds:g} s or before a drop",
                    f"{median:.1f} at {np.median(speed):.2f} rad/s",
                    goal,
                    bool(median >= times * revolutions and np.median(speed) >= fast),
                )
            )
    first = ", ".join(dict.fromkeys(row["who"] for row in rows if "object_pose" not in row))
    slow = f"; speeds of {first}, measured first, count the approach, about 3 % of the time"
    table = {
        "title": f"The emulated servo hand: 0.6 rad/s, 0.5 N m, 50 ms, touch from 1 N, joint "
        f"origins off by {given.joint_offset:g} rad (standard deviation) or as is said, "
        f"{given.trials} trials each; revolutions before a drop, median (10 to 90 %)"
        f"{slow * bool(first)}",
        "header": ["", "Object", "seconds", "Revolutions", "Speed", "Thesis, real hand", "Held"],
        "rows": lines,
    }
    write("servo_hand", given, figures, [table], trials=rows, say=say)


def main() -> None:
    given = settings(Options, __doc__)
    rows = earlier("servo_hand", given, ("seed", "joint_offset"))
    done = {(*kind(row), row["seed"]) for row in rows}
    seeds = range(given.seed, given.seed + given.trials)

    def key(who: str, turned: str, seed: int) -> tuple[Any, ...]:
        pose = pose_of(who, given)
        row = {"who": who, "object": turned, "object_pose": pose, "seconds": given.seconds}
        return (*kind({**row, **offset(given), **tracker(pose, given)}), seed)

    wanted = [
        (*one, given) for one in product(given.who, given.objects, seeds) if key(*one) not in done
    ]
    for _, row in side_by_side(given.jobs, trial, wanted):
        rows.append(row)
        save(rows, given, say=False)
        progress(json.dumps(row))
    save(rows, given, say=True)


if __name__ == "__main__":
    main()
