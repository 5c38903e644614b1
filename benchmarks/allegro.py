"""A hand of four fingers: the Allegro holds and turns a sphere, a cylinder and a cube.

The same controllers with no code of their own. Needs the hand's files: a folder that holds
`wonik_allegro/` in DEXCTL_MENAGERIE, or the `mujoco-menagerie` package; does nothing without.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from common import (
    FULL_TURN,
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

from dexctl import controllers, hands
from dexctl.exceptions import DexctlError, HandModelError
from dexctl.igm import InGraspManipulationConfig
from dexctl.sim import SceneConfig

OBJECTS: dict[str, dict[str, Any]] = {
    "sphere": {"object_size": 0.07, "object_mass": 0.05},
    "cylinder": {"object_size": 0.065, "object_mass": 0.05},
    "cube": {"object_size": 0.055, "object_mass": 0.05},
}
_SLOW = InGraspManipulationConfig(twist=(0.0, 0.0, 0.0, 0.0, 0.0, 0.25), stability_gain=0.01)
# title: controller and what differs from its defaults
CONTROLLERS: dict[str, tuple[str, dict[str, Any]]] = {
    "in-grasp manipulation": ("igm", {"config": _SLOW}),
    (GAIT := "coordinated gait"): ("coordinated", {}),
}
TARGET = FULL_TURN  # rotation that is counted [rad]


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    trials: int = 16
    """Per object, palm direction and controller."""
    seconds: float = 60.0
    """Simulated, each trial."""
    folder: Path | None = None
    """Folder that holds `wonik_allegro/`."""


def figures_of(rows: list[dict[str, Any]], seconds: float) -> list[Figure]:
    """One line for each object and controller, over both palm directions."""
    out = []
    for name, controller in product(OBJECTS, CONTROLLERS):
        mine = [
            row for row in rows if row["object"] == name and row.get("controller") == controller
        ]
        if not mine:
            continue
        parts = [
            f"palm {row['palm']} {row['rotation_rad']['median']:.1f} rad, "
            f"{percent(row['reached_and_holding'])}"
            for row in mine
        ]
        out.append(
            Figure(
                f"Allegro, {controller}, {name} of {1000 * mine[0]['width_m']:.0f} mm, "
                f"{seconds:g} s: median rotation, trials that turn it once and still "
                "hold it",
                "; ".join(parts),
                "most trials" if controller == GAIT else "",
                all(row["reached_and_holding"]["share"] > 0.5 for row in mine)
                if controller == GAIT
                else None,
            )
        )
    return out


def main() -> None:
    given = settings(Options, __doc__)
    try:
        hand = hands.load("wonik_allegro", folder=given.folder)
    except HandModelError as error:
        print(f"skipped: {error}")
        return
    rows, lines = [], []
    for name, options in OBJECTS.items():
        for palm in PALMS:
            try:
                config = SceneConfig(hand="wonik_allegro", object=(name,), gravity=palm, **options)
                (scene,) = config.scenes(hand)
                scene.settled  # noqa: B018 (the grasp is found here)
            except DexctlError as error:
                progress(f"{name}, palm {palm}: {error}")
                rows.append({"object": name, "palm": palm, "error": str(error)})
                continue
            for title, (kind, changes) in CONTROLLERS.items():
                controller = controllers.make(kind, hand, **changes)
                trace = trials(controller, config, given.seconds, given.trials, seed=given.seed)
                row = {
                    "object": name,
                    "width_m": scene.object_width,
                    "mass_kg": scene.object_mass,
                    "palm": palm,
                    "controller": title,
                    **outcome(trace, TARGET),
                }
                rows.append(row)
                rotation = row["rotation_rad"]
                lines.append(
                    [
                        name,
                        palm,
                        title,
                        f"{rotation['median']:.2f} ({rotation['p10']:.2f}-{rotation['p90']:.2f})",
                        f"{row['time_held_s']['median']:.0f}",
                        percent_interval(row["reached"]),
                        percent_interval(row["holding"]),
                        f"{100 * row['touched_by_more_than_fingertips']:.0f} %",
                    ]
                )
                progress(" | ".join(lines[-1]))
    table = {
        "title": f"Allegro hand, {given.seconds:g} s, {given.trials} trials each",
        "header": [
            "Object",
            "Palm",
            "Controller",
            "Rotation: median (10-90 %) [rad]",
            "Time held: median [s]",
            "Turned once before any drop (95 % interval)",
            "Holding at the end (95 % interval)",
            "Time touching palm or links",
        ],
        "rows": lines,
    }
    write("allegro", given, figures_of(rows, given.seconds), [table], trials=rows)


if __name__ == "__main__":
    main()
