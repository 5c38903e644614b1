"""A hand without touch sensors: full touch, switches, joint torques; nothing tracks the object.

Each by the coordinated gait and by in-grasp manipulation, with an ideal hand and with one whose
gears rub, whose encoders are off and whose sensors are late. Hands of the menagerie turn what suits
them by the gait alone; those whose files are missing are said so. The file is written after every
row.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from measuring.results import Figure, earlier, write
from measuring.settings import Settings, progress, settings
from measuring.shares import percent, percent_interval
from measuring.trials import PALMS, outcome, trials

import dexctl
from dexctl import controllers
from dexctl.exceptions import HandModelError
from dexctl.sim import SceneConfig, Sensing
from dexctl.sim.sensing import TOUCHES

ROBOTS: dict[str, tuple[str, ...]] = {
    "dex5": ("coordinated", "igm"),
    "wonik_allegro": ("coordinated",),
    "leap_hand": ("coordinated",),
}
"""Hands, and the controllers that turn their objects."""
OF_OTHERS = ("sphere",)
OBJECTS = ("cube", "cylinder", "sphere", "icosahedron", "dodecahedron")
CONTROLLERS = {"coordinated": "coordinated gait", "igm": "in-grasp manipulation"}
GEAR_FRICTION, OFFSET, LATENCY = 0.02, 0.02, 0.05  # [N m], [rad], [s]
HANDS = {
    "ideal": "an ideal hand",
    "real": f"gear friction {GEAR_FRICTION} N m, encoders {OFFSET} rad off, {LATENCY} s late",
}


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    trials: int = 16
    """Per row."""
    seconds: float = 20.0
    """Simulated, each trial."""
    objects: tuple[str, ...] = OBJECTS
    """Objects that dex5 turns."""
    robots: tuple[str, ...] = tuple(ROBOTS)
    """Which hands."""


def scene(robot: str, name: str, palm: str, touch: Any, hand: str) -> SceneConfig:
    """What is simulated for a row."""
    real = hand == "real"
    return SceneConfig(
        hand=robot,
        object=(name,),
        gravity=palm,
        gear_friction=GEAR_FRICTION if real else None,
        sensing=Sensing(
            touch=touch,
            object_pose="unknown",
            joint_offset=OFFSET if real else 0.0,
            sensor_latency=LATENCY if real else 0.0,
        ),
    )


def table_of(rows: list[dict[str, Any]], given: Options) -> dict[str, Any]:
    """One line for each controller, hand and scene; one column for each kind of touch."""
    lines: dict[tuple[str, ...], dict[str, str]] = {}
    for row in rows:
        key = (
            row["robot"],
            CONTROLLERS[row["controller"]],
            row["hand"],
            f"{row['object']}, {row['palm']}",
        )
        lines.setdefault(key, {})[row["touch"]] = (
            f"{row['rotation_rad']['median']:.1f} rad, {percent_interval(row['holding'])}"
        )
    return {
        "title": f"Touch: median rotation in {given.seconds:g} s, share still holding (95 % "
        f"interval), {given.trials} trials each, object not tracked; real: {HANDS['real']}",
        "header": ["", "controller", "hand", "object, palm", *TOUCHES],
        "rows": [[*key, *(cells.get(t, "") for t in TOUCHES)] for key, cells in lines.items()],
    }


def figures_of(rows: list[dict[str, Any]]) -> list[Figure]:
    """All scenes together, for each robot, controller, hand and kind of touch."""
    out = []
    for key in product(ROBOTS, CONTROLLERS, HANDS, TOUCHES):
        robot, controller, hand, touch = key
        names = ("robot", "controller", "hand", "touch")
        found = [row for row in rows if tuple(row[name] for name in names) == key]
        if not found:
            continue
        held, of = (sum(r["holding"][k] for r in found) for k in ("count", "of"))
        turned = float(np.median([r["rotation_rad"]["median"] for r in found]))
        out.append(
            Figure(
                f"{robot}, {CONTROLLERS[controller]}, touch {touch}, {HANDS[hand]}",
                f"{percent({'count': held, 'of': of, 'share': held / of})} hold, "
                f"median of {len(found)} scenes {turned:.1f} rad",
            )
        )
    return out


def main() -> None:
    given = settings(Options, __doc__)
    rows = earlier("touch", given)
    names = ("robot", "controller", "hand", "object", "palm", "touch")
    done = {tuple(row[name] for name in names) for row in rows}
    for robot in given.robots:
        try:
            hand = dexctl.hands.load(robot)
        except HandModelError as error:
            progress(f"{robot}: not here: {error}")
            continue
        objects = given.objects if robot == "dex5" else OF_OTHERS
        for rest in product(ROBOTS[robot], HANDS, objects, PALMS, TOUCHES):
            key = (robot, *rest)
            if key in done:
                continue
            kind, how, name, palm, touch = rest
            controller = controllers.make(kind, hand)
            config = scene(robot, name, palm, touch, how)
            trace = trials(controller, config, given.seconds, given.trials, seed=given.seed)
            rows.append({**dict(zip(names, key, strict=True)), **outcome(trace)})
            row = rows[-1]
            progress(
                f"{', '.join(key)}: {row['rotation_rad']['median']} rad, {percent(row['holding'])}"
            )
            write("touch", given, figures_of(rows), [table_of(rows, given)], trials=rows, say=False)
    write("touch", given, figures_of(rows), [table_of(rows, given)], trials=rows)


if __name__ == "__main__":
    main()
