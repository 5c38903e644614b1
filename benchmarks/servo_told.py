"""Objects turned as told on the emulated servo hand, about any direction, tracked by touch alone.

Each trial is the command `dexctl hardware run --emulate --object-pose touch --spin ...`, in real
time: bus, runner, servos with 0.6 rad/s, 0.5 N m, 50 ms from a set-point to its effect, touch from
1 N on, joint origins that are off, and no camera. How far it is turned about the axis told is
judged by where the emulator has it, up to a drop or the end.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from measuring.results import FIXED, Figure, write
from measuring.servo import measure_by_palm, seen_or_felt
from measuring.settings import Settings, settings
from measuring.shares import over_seeds, percent_interval, share
from measuring.trials import PALMS

AXES = (
    (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1),
    (1, 1, 1), (-1, -1, 1), (1, -1, -1), (-1, 1, -1),
)  # fmt: skip
"""The six along the hand's axes, and four aslant."""
FOLLOWED = 0.9
"""Share of the speed told that an object is to turn with."""


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    seed: int = 41_000
    trials: int = len(AXES)
    """Runs of each, about as many of ten axes."""
    seconds: float = 40.0
    """Of each [s]."""
    who: tuple[str, ...] = ("pursuing:dex5-cube-goals-touch",)
    """Who turns it."""
    object: str = "cube"
    """Which."""
    speed: float = 0.3
    """That is told [rad/s]."""
    palms: tuple[str, ...] = PALMS
    """Which way the palm looks."""
    joint_offset: float = 0.03
    """Standard deviation of what encoders read at zero [rad]."""
    jobs: int = 2
    """Trials at a time."""


def trial(who: str, palm: str, number: int, given: Options) -> dict[str, Any]:
    """One run about one axis."""
    axis, seed = np.array(AXES[number]), given.seed + number
    spin = given.speed * axis / np.linalg.norm(axis)
    words = ("--spin", *(f"{one:.6f}" for one in spin))
    found = seen_or_felt(who, given.object, palm, seed, given, *words)
    figures = found["figures"]
    return {
        "who": who,
        "palm": palm,
        "seed": seed,
        "spin": spin.tolist(),
        "rotation_rad": figures["rotation_as_told_rad"],
        "mean_speed_rad_s": figures.get("turning_speed_rad_s", 0.0),
        "lost_at_s": figures.get("object_lost_at_s"),
        "outcome": found["outcome"],
        "cause": found["cause"],
    }


def save(rows: list[dict[str, Any]], given: Options, *, say: bool) -> None:
    """Write the result with the trials so far."""
    figures, lines = [], []
    for who, palm in dict.fromkeys((row["who"], row["palm"]) for row in rows):
        mine = [row for row in rows if (row["who"], row["palm"]) == (who, palm)]
        rotation = over_seeds(np.array([row["rotation_rad"] for row in mine]))
        speed = over_seeds(np.array([row["mean_speed_rad_s"] for row in mine]))
        kept = share(np.array([row["lost_at_s"] is None for row in mine]))
        lines.append(
            [
                who, palm, str(len(mine)),
                *(
                    f"{one['median']:.{digits}f} ({one['p10']:.{digits}f} to "
                    f"{one['p90']:.{digits}f})"
                    for one, digits in ((rotation, 1), (speed, 2))
                ),
                percent_interval(kept),
            ]
        )  # fmt: skip
        least = FOLLOWED * given.speed
        figures.append(
            Figure(
                f"emulated servo hand, no camera, {who}: a {given.object} turned about any axis "
                f"told at {given.speed:g} rad/s, palm {palm}, {given.seconds:g} s",
                f"{speed['median']:.2f} rad/s, {percent_interval(kept)} held",
                f"{least:.2f} rad/s, 90 % held",
                bool(speed["median"] >= least and kept["share"] >= 0.9),
            )
        )
    table = {
        "title": f"The emulated servo hand turns a {given.object} about ten axes told at "
        f"{given.speed:g} rad/s, tracked by touch: 0.6 rad/s, 0.5 N m, 50 ms, touch from 1 N, "
        f"joint origins off by {given.joint_offset:g} rad (standard deviation), a run of "
        f"{given.seconds:g} s for each; median (10 to 90 %)",
        "header": ["", "palm", "axes", "rotation about it [rad]", "speed [rad/s]", "held"],
        "rows": lines,
    }
    write("servo_told", given, figures, [table], trials=rows, say=say)


def main() -> None:
    given = settings(Options, __doc__)
    measure_by_palm("servo_told", given, (*FIXED, "object", "speed", "joint_offset"), trial, save)


if __name__ == "__main__":
    main()
