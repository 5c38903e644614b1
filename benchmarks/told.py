"""Objects turned as told: about any direction, at any speed, told another every few seconds.

By policies for goals that go after a goal ahead of them (`pursuing:NAME`); whoever else is told an
angular velocity can be named instead. Of one object each speed, palm up, down and any way up, and
how its pose is known; the others at the speed in the middle.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from math import pi
from typing import Any, Literal, NamedTuple

from measuring.poses import BY_LATE, Pose, known
from measuring.results import FIXED, Figure, earlier, write
from measuring.settings import Settings, check_chosen, progress, settings
from measuring.shares import over_seeds, percent_interval, share

from dexctl.settings import changed
from dexctl.sim.objects import object_names
from learning.envs import TaskConfig, TurningConfig
from learning.evaluation import Subject, evaluate, open_subject

PALMS = {"up": "palm up", "down": "palm down", "any": "any way up"}
SAID = {
    "tracked": "",
    "late": f", {BY_LATE}",
    "touch": ", by touch",
}
HELD = 0.95
"""Share of episodes that are to hold, ..."""
FOLLOWED = 0.9
"""... and of the angle that was told that the object is to make in the mean of them."""


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    seed: int = 1000
    """First seed; trial i has the seed seed + i."""
    who: tuple[str, ...] = ("pursuing:dex5-cube-goals", "pursuing:dex5-cube-goals-touch")
    """Controllers, policies, policy files or run folders."""
    objects: tuple[str, ...] = tuple(name for name in object_names() if name != "mesh")
    """Turned at the speed in the middle; the first one at each."""
    speeds: tuple[float, ...] = (0.2, 0.5, 1.0)
    """That are told [rad/s]."""
    palms: tuple[Literal["up", "down", "any"], ...] = ("up", "down", "any")
    """Which way it looks, any: uniform on the sphere, for each episode."""
    poses: tuple[Pose, ...] = ("tracked", "late", "touch")
    """How the object's pose is known; late: by a tracker 100 ms late, 3 mm and 0.05 rad off. So,
    and by touch, the first object alone, at the speed in the middle."""
    trials: int = 96
    """Episodes of each."""
    seconds: float = 60.0
    """Of each."""
    command_seconds: float = 5.0
    """How long each command holds."""


class Asked(NamedTuple):
    """What is asked for."""

    object: str
    speed: float
    palm: str
    pose: Pose


def wanted(given: Options) -> list[Asked]:
    """All that is asked of one."""
    first, *others = given.objects
    middle = sorted(given.speeds)[len(given.speeds) // 2]
    found = [
        Asked(first, speed, palm, pose)
        for pose in given.poses
        for palm in given.palms
        for speed in given.speeds
        if pose == "tracked" or speed == middle
    ]
    found += [Asked(name, middle, palm, "tracked") for name in others for palm in given.palms]
    return found


def measure(subject: Subject, asked: Asked, given: Options) -> dict[str, Any]:
    """One who is told, with one object, speed and palm."""
    turning = TurningConfig(
        commands=("any",),
        command_seconds=given.command_seconds,
        command_speed_range=(asked.speed, asked.speed),
    )
    any_way = asked.palm == "any"
    protocol = changed(
        replace(subject.protocol(), task=TaskConfig(turning=turning)),
        {
            "object": asked.object,
            "gravity": "up" if any_way else asked.palm,
            "gravity_tilt": pi if any_way else 0.0,
            **known(asked.pose),
            "episodes": given.trials,
            "seconds": given.seconds,
            "seed": given.seed,
        },
    )
    found = evaluate(subject, protocol)
    return {
        "rotation_rad": over_seeds(found.rotation),
        "followed": round(float(found.speed.mean() / asked.speed), 4),
        "held": share(~found.dropped),
        "drift_mm": over_seeds(1000.0 * found.drift),
        "fingertips_only": round(float(found.fingertips_only.mean()), 4),
    }


def save(rows: list[dict[str, Any]], given: Options, *, say: bool) -> None:
    """Write the result with the rows so far."""
    table = {
        "title": f"Turned about any direction, another one told every {given.command_seconds:g} s, "
        f"{given.trials} episodes of {given.seconds:g} s",
        "header": [
            "", "object", "pose", "told [rad/s]", "palm", "held", "of what was told",
            "furthest from its place, median [mm]", "only fingertips",
        ],
        "rows": [
            [
                row["who"],
                row["object"],
                row["pose"],
                f"{row['speed']:g}",
                row["palm"],
                percent_interval(row["held"]),
                f"{100 * row['followed']:.0f} %",
                f"{row['drift_mm']['median']:.0f}",
                f"{100 * row['fingertips_only']:.1f} %",
            ]
            for row in rows
        ],
    }  # fmt: skip
    figures = []
    for who in dict.fromkeys(row["who"] for row in rows):
        for pose, palm in product(SAID, PALMS):
            own = [
                row for row in rows if (row["who"], row["pose"], row["palm"]) == (who, pose, palm)
            ]
            if not own:
                continue
            good = [
                row for row in own
                if row["held"]["share"] >= HELD and row["followed"] >= FOLLOWED
            ]  # fmt: skip
            figures.append(
                Figure(
                    f"{who}: objects and speeds, {PALMS[palm]}{SAID[pose]}, held in "
                    f"{100 * HELD:.0f} % and turned by {100 * FOLLOWED:.0f} % of what was told",
                    f"{len(good)} of {len(own)}",
                    f"{len(own)} of {len(own)}",
                    len(good) == len(own),
                )
            )
    write("told", given, figures, [table], trials=rows, say=say)


def main() -> None:
    given = settings(Options, __doc__)
    check_chosen("palm", given.palms, tuple(PALMS))
    rows = earlier("told", given, FIXED)
    done = {(row["who"], *(row[name] for name in Asked._fields)) for row in rows}
    for name in given.who:
        subject = open_subject(name)
        for asked in wanted(given):
            if (name, *asked) not in done:
                rows.append({"who": name, **asked._asdict(), **measure(subject, asked, given)})
                save(rows, given, say=False)
                progress(", ".join(map(str, (name, *asked))))
    save(rows, given, say=True)


if __name__ == "__main__":
    main()
