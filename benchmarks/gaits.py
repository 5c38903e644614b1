"""The gait of the thesis and the coordinated gait side by side: 60 s, easy objects and harder ones.

The file is written after every row, so that an interrupted run leaves what it has; `--resume`
goes on from there.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from common import (
    PALMS,
    Figure,
    Settings,
    outcome,
    percent,
    percent_interval,
    progress,
    settings,
    trials,
    write,
)

import dexctl
from dexctl import controllers
from dexctl.sim import Scene

EASY = ("cube", "cylinder", "sphere", "icosahedron", "dodecahedron")
HARDER = ("cuboid_tall", "cuboid_long", "l_shape", "u_shape")
GAITS = {"gait": "thesis", "coordinated": "coordinated"}
FULL_TURN_GOAL = 0.8  # of trials, on the first three
FLOOR = 3.1  # median on the cylinder [rad]
HEADER = (
    "Object",
    "Palm",
    "Gait",
    "Rotation: median (10-90 %) [rad]",
    "Time held: median [s]",
    "Holding at the end",
    "Full turn (95 % interval)",
)


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    trials: int = 64
    """Per object, palm direction and gait."""
    seconds: float = 60.0
    """Simulated, each trial."""
    objects: tuple[str, ...] = (*EASY, *HARDER)
    """Objects to turn."""
    resume: bool = False
    """Keep the rows of an earlier run with the same settings."""


def earlier(given: Options) -> list[dict[str, Any]]:
    """Rows of an interrupted run."""
    path = given.out / "gaits.json"
    if not (given.resume and path.is_file()):
        return []
    found = json.loads(path.read_text())
    same = all(
        found["settings"][name] == getattr(given, name) for name in ("seed", "trials", "seconds")
    )
    return found["trials"] if same else []


def measure(gait: str, scene: Scene, palm: str, given: Options) -> dict[str, Any]:
    """One row: an object, a palm direction, a gait."""
    controller = controllers.make(gait, scene.hand)
    trace = trials(controller, scene, given.seconds, given.trials, seed=given.seed)
    return {"object": scene.object, "palm": palm, "gait": GAITS[gait], **outcome(trace)}


def line(row: Mapping[str, Any]) -> list[str]:
    """A row for README."""
    rotation = row["rotation_rad"]
    return [
        row["object"].replace("_", " "),
        row["palm"],
        row["gait"],
        f"{rotation['median']:.1f} ({rotation['p10']:.1f}-{rotation['p90']:.1f})",
        f"{row['time_held_s']['median']:.0f}",
        f"{100 * row['holding']['share']:.0f} %",
        percent_interval(row["reached"]),
    ]


def figures_of(rows: list[dict[str, Any]], seconds: float) -> list[Figure]:
    """What was asked: full turns of three objects, and a floor on the cylinder."""
    out = []
    for row in rows:
        if row["gait"] != "coordinated" or row["object"] not in EASY[:3]:
            continue
        where = f"the {row['object']}, palm {row['palm']}, {seconds:g} s"
        out.append(
            Figure(
                f"coordinated gait: a full turn of {where}",
                percent(row["reached"]),
                f"{100 * FULL_TURN_GOAL:.0f} % of trials",
                row["reached"]["share"] >= FULL_TURN_GOAL,
            )
        )
        if row["object"] == "cylinder":
            median = row["rotation_rad"]["median"]
            out.append(
                Figure(
                    f"coordinated gait: rotation of {where}",
                    f"median {median:.1f} rad",
                    f"floor: {FLOOR} rad",
                    median >= FLOOR,
                )
            )
    return out


def main() -> None:
    given = settings(Options, __doc__)
    hand = dexctl.hands.load("dex5")
    rows = earlier(given)
    done = {(row["object"], row["palm"], row["gait"]) for row in rows}
    for name in given.objects:
        for palm in PALMS:
            scene = Scene.build(hand, name, palm)
            for gait, title in GAITS.items():
                if (name, palm, title) in done:
                    continue
                progress(f"{name}, palm {palm}, {title}")
                rows.append(measure(gait, scene, palm, given))
                table = {
                    "title": f"Thesis gait and coordinated gait, {given.seconds:g} s, "
                    f"{given.trials} trials each",
                    "header": list(HEADER),
                    "rows": [line(row) for row in rows],
                }
                write(
                    "gaits", given, figures_of(rows, given.seconds), [table], trials=rows, say=False
                )
                progress("  " + " | ".join(line(rows[-1])))


if __name__ == "__main__":
    main()
