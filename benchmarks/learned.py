"""The policies that come with the package, and the controllers, in 100 episodes of 60 s."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from measuring.results import Figure, earlier, write
from measuring.settings import Settings, progress, settings
from measuring.shares import over_seeds, share
from measuring.trials import FULL_TURN

import dexctl
from dexctl import controllers
from dexctl.controller import Controller
from learning.evaluation import Protocol, evaluate

HAND = "dex5"
OBJECTS = ("cylinder", "cube", "sphere", "icosahedron", "dodecahedron")
COMPARED = ("igm", "gait", "coordinated")
TITLES = {
    "igm": "in-grasp manipulation",
    "gait": "gait of the thesis",
    "coordinated": "coordinated gait",
    "dex5-cylinder": "learned, on the cylinder",
    "dex5-easy": "learned, on all five",
    "dex5-easy-any": "learned, on all five any way up",
}
ALONE = {"dex5-cylinder": ("cylinder",)}  # the object of what was trained on one; others: all
IN_FIGURES = ("cylinder", "cube")


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    trials: int = 100
    """Episodes for each object."""
    seconds: float = 60.0
    """Of each."""
    objects: tuple[str, ...] = OBJECTS
    """Which."""


def measure(controller: Controller, turned: str, given: Options) -> dict[str, Any]:
    """One controller, one object."""
    protocol = Protocol(episodes=given.trials, seconds=given.seconds, seed=given.seed)
    found = evaluate(controller, protocol, object=turned)
    return {
        "object": turned,
        "rotation_rad": over_seeds(found.rotation),
        "revolutions_median": round(float(np.median(found.rotation)) / FULL_TURN, 3),
        "time_held_s": over_seeds(found.time_held),
        "dropped": share(found.dropped),
        "full_turn": share(found.rotation >= FULL_TURN),
        "return_mean": round(float(found.returns.mean()), 2),
    }


def figures(rows: list[dict[str, Any]]) -> list[Figure]:
    """Lines of README's table."""
    by = {(row["who"], row["object"]): row for row in rows}
    found = []
    for name in (name for name in TITLES if name not in COMPARED):
        for turned in ALONE.get(name, IN_FIGURES):
            row = by.get((name, turned))
            guide = by.get(("coordinated", turned))
            if row is None or guide is None:
                continue
            turn, floor = row["rotation_rad"]["median"], guide["rotation_rad"]["median"]
            found += [
                Figure(
                    f"{TITLES[name]}: rotation of the {turned} in {row['time_s']:g} s",
                    f"median {turn:.1f} rad, {row['dropped']['count']} of {row['dropped']['of']} "
                    "dropped by then",
                    f"more than its guide's {floor:.1f} rad",
                    turn > floor,
                ),
                Figure(
                    f"{TITLES[name]}: episodes with a full turn of the {turned}",
                    f"{row['full_turn']['count']} of {row['full_turn']['of']}",
                    "the median episode",
                    row["full_turn"]["share"] > 0.5,
                ),
            ]
    return found


def save(rows: list[dict[str, Any]], given: Options, *, say: bool) -> None:
    """Write the result with the rows so far."""
    lines = [
        [
            row["object"],
            TITLES[row["who"]],
            f"{row['rotation_rad']['median']:.1f} "
            f"({row['rotation_rad']['p10']:.1f}-{row['rotation_rad']['p90']:.1f})",
            f"{row['revolutions_median']:.1f}",
            f"{row['time_held_s']['median']:.0f}",
            f"{100 * row['full_turn']['share']:.0f} %",
            f"{100 * row['dropped']['share']:.0f} %",
        ]
        for row in rows
    ]
    table = {
        "title": f"Learned gaits and controllers, palm up, {given.trials} episodes of "
        f"{given.seconds:g} s: rotation before any drop, median (10th to 90th percentile)",
        "header": ["Object", "", "rotation [rad]", "turns", "held [s]", "full turn", "dropped"],
        "rows": lines,
    }
    write("learned", given, figures(rows), [table], trials=rows, say=say)


def main() -> None:
    given = settings(Options, __doc__)
    hand = dexctl.hands.load(HAND)
    rows = earlier("learned", given)
    done = {(row["who"], row["object"]) for row in rows}
    for turned in given.objects:
        for name in TITLES:
            if (name, turned) in done or turned not in ALONE.get(name, OBJECTS):
                continue
            who = controllers.resolve(name, hand)
            row = {"who": name, "time_s": given.seconds, **measure(who, turned, given)}
            rows.append(row)
            save(rows, given, say=False)
            progress(f"{turned}, {name}: {row['rotation_rad']['median']:.1f} rad")
    save(rows, given, say=True)


if __name__ == "__main__":
    main()
