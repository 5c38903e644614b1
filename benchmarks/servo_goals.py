"""A cube brought to its orientations on the emulated servo hand.

Each trial is the command `dexctl hardware run --emulate --object-pose touch --goal ...`, in real
time: bus, runner, servos with 0.6 rad/s, 0.5 N m, 50 ms from a set-point to its effect, touch from
1 N on, joint origins that are off, and no camera; with ``--pose late`` there is one. The goals are
the orientations in which a cube looks as it does in the grasp; whether it is there is judged by
where the emulator has it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from measuring.poses import BY_LATE
from measuring.results import FIXED, Figure, write
from measuring.servo import measure_by_palm, seen_or_felt
from measuring.settings import Settings, settings
from measuring.shares import percent_interval, share
from measuring.trials import PALMS
from scipy.spatial.transform import Rotation

NEAR = 0.2
"""Of the goal, where it counts as reached [rad]."""


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    seed: int = 40_000
    trials: int = 23
    """Goals, one run each: as many of the 23 orientations that are not that of the grasp."""
    seconds: float = 30.0
    """Of each [s]."""
    who: tuple[str, ...] = (
        "sequence:dex5-cube-z-any@0.4,dex5-cube-x-any",
        "dex5-cube-goals-touch",
    )
    """Who brings the cube there."""
    palms: tuple[str, ...] = PALMS
    """Which way the palm looks."""
    joint_offset: float = 0.03
    """Standard deviation of what encoders read at zero [rad]."""
    pose: Literal["touch", "late"] = "touch"
    """How the cube's pose is known; late: by a tracker 100 ms late, 3 mm and 0.05 rad off."""
    jobs: int = 2
    """Trials at a time."""


def goals() -> list[tuple[float, ...]]:
    """The other 23 turns of a cube that leave it looking the same, wxyz."""
    turns = Rotation.create_group("O").as_quat(canonical=True, scalar_first=True)
    return [tuple(turn.tolist()) for turn in turns if abs(turn[0]) < 1.0 - 1e-9]


def trial(who: str, palm: str, number: int, given: Options) -> dict[str, Any]:
    """One run to one goal."""
    goal, seed = goals()[number], given.seed + number
    words = ("--goal", *(f"{one:.6f}" for one in goal))
    found = seen_or_felt(who, "cube", palm, seed, given, *words, pose=given.pose)
    figures = found["figures"]
    return {
        "who": who,
        "palm": palm,
        "pose": given.pose,
        "seed": seed,
        "goal": list(goal),
        "reached_at_s": figures.get("goal_reached_at_s"),
        "left_rad": figures["left_to_goal_rad"],
        "lost_at_s": figures.get("object_lost_at_s"),
        "outcome": found["outcome"],
        "cause": found["cause"],
    }


def kind(row: dict[str, Any]) -> tuple[str, str, str]:
    """Who, with which palm, by which pose; those of earlier results are by touch."""
    return row["who"], row["palm"], row.get("pose", "touch")


def save(rows: list[dict[str, Any]], given: Options, *, say: bool) -> None:
    """Write the result with the trials so far."""
    figures, lines = [], []
    for who, palm, pose in dict.fromkeys(map(kind, rows)):
        mine = [row for row in rows if kind(row) == (who, palm, pose)]
        by = "no camera" if pose == "touch" else BY_LATE
        reached = share(np.array([row["reached_at_s"] is not None for row in mine]))
        stayed = share(np.array([row["left_rad"] < NEAR for row in mine]))
        kept = share(np.array([row["lost_at_s"] is None for row in mine]))
        # one that is not reached counts as the time there was
        time = float(np.median([row["reached_at_s"] or given.seconds for row in mine]))
        lines.append(
            [who, palm, pose, str(len(mine)), percent_interval(reached), f"{time:.1f}",
             percent_interval(stayed), percent_interval(kept)]
        )  # fmt: skip
        figures.append(
            Figure(
                f"emulated servo hand, {by}, {who}: orientations of a cube come to within "
                f"{NEAR} rad, palm {palm}, {given.seconds:g} s",
                f"{percent_interval(reached)}, median {time:.1f} s",
                "80 % of them",
                reached["share"] >= 0.8,
            )
        )
    table = {
        "title": "The emulated servo hand brings a cube to its other orientations, tracked by "
        f"touch or late ({BY_LATE}): 0.6 rad/s, 0.5 N m, 50 ms, touch from 1 N, joint origins off "
        f"by {given.joint_offset:g} rad (standard deviation), a run of {given.seconds:g} s each",
        "header": [
            "", "palm", "pose", "goals", f"within {NEAR} rad", "after [s], with the approach",
            f"within {NEAR} rad at the end", "held",
        ],
        "rows": lines,
    }  # fmt: skip
    write("servo_goals", given, figures, [table], trials=rows, say=say)


def main() -> None:
    given = settings(Options, __doc__)
    measure_by_palm("servo_goals", given, (*FIXED, "joint_offset"), trial, save)


if __name__ == "__main__":
    main()
