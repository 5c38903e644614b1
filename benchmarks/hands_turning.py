"""Hands of the menagerie turn objects: in-grasp manipulation, and the coordinated gait.

The same controllers with no code of their own for any hand; what a hand holds, and where, stands in
its toml. Needs the hands' files: a folder in DEXCTL_MENAGERIE, or the `mujoco-menagerie` package;
hands that are missing are said so. `--resume` goes on with the rows that there are.
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
    earlier,
    outcome,
    percent,
    percent_interval,
    progress,
    settings,
    trials,
    write,
)

from dexctl import HandModel, controllers, hands
from dexctl.exceptions import DexctlError, HandModelError
from dexctl.sim import SceneConfig

# objects of the width and mass, and at the place, that each hand's toml says
HELD: dict[str, tuple[str, ...]] = {
    "wonik_allegro": ("sphere", "cylinder", "cube"),
    "leap_hand": ("sphere", "cube"),
    "shadow_hand": ("sphere", "cube"),
}
# title: controller and what differs from its defaults
CONTROLLERS: dict[str, tuple[str, dict[str, Any]]] = {
    "in-grasp manipulation": ("igm", {}),
    (GAIT := "coordinated gait"): ("coordinated", {}),
}
OBJECTS = ("sphere", "cube")  # of a hand that is not among these
TARGET = FULL_TURN  # rotation that is counted [rad]
KINDS = {"a sphere or cylinder": ("sphere", "cylinder"), "a cube": ("cube",)}  # asked for each


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    trials: int = 16
    """Per object, palm direction and controller."""
    seconds: float = 60.0
    """Simulated, each trial."""
    hands: tuple[str, ...] = tuple(HELD)
    """Which hands."""
    folder: Path | None = None
    """Folder that holds the hands' folders."""


def figures_of(rows: list[dict[str, Any]], seconds: float) -> list[Figure]:
    """What is asked of all hands, and a line for each hand, object and controller."""
    out = over_hands(rows, seconds)
    kinds = dict.fromkeys((row["hand"], row.get("object")) for row in rows)
    for (hand, name), controller in product(kinds, CONTROLLERS):
        mine = [
            row
            for row in rows
            if (row["hand"], row.get("object"), row.get("controller")) == (hand, name, controller)
        ]
        if not mine:
            continue
        parts = [
            f"palm {row['palm']} {row['rotation_rad']['median']:.1f} rad, "
            f"{percent(row['reached_and_holding'])}, {percent(row['holding'])} hold"
            for row in mine
        ]
        out.append(
            Figure(
                f"{hand}, {controller}, {name} of {1000 * mine[0]['width_m']:.0f} mm, "
                f"{seconds:g} s: median rotation, trials that turn it once and still hold it, "
                "trials that hold it",
                "; ".join(parts),
            )
        )
    return out


def over_hands(rows: list[dict[str, Any]], seconds: float) -> list[Figure]:
    """Of how many hands the gait turns round objects, and cubes, surely; each with its best one."""
    measured = [row for row in rows if "rotation_rad" in row]
    out = []
    for kind, names in KINDS.items():
        out += over_kind([row for row in measured if row["object"] in names], kind, seconds)
    return out


def over_kind(rows: list[dict[str, Any]], kind: str, seconds: float) -> list[Figure]:
    """The same of objects of one kind."""
    names = list(dict.fromkeys(row["hand"] for row in rows))
    if not names:
        return []

    def best(palm: str, share: str) -> dict[str, dict[str, Any]]:
        found: dict[str, dict[str, Any]] = {}
        for row in rows:
            if (row["controller"], row["palm"]) != (GAIT, palm):
                continue
            before = found.get(row["hand"])
            if before is None or row[share]["share"] > before[share]["share"]:
                found[row["hand"]] = row
        return found

    out = []
    for palm, least, wanted in (("up", 0.95, 2), ("down", 0.8, 1)):
        share = "reached_and_holding"
        sure = best(palm, share)
        good = sum(row[share]["share"] >= least for row in sure.values())
        shown = ", ".join(
            f"{name} {row['object']} {percent(row[share])}" for name, row in sure.items()
        )
        out.append(
            Figure(
                f"hands with {kind} of their size that the coordinated gait turns once in "
                f"{seconds:g} s and still holds in {100 * least:.0f} % of the trials, palm {palm}",
                f"{good} of {len(names)} ({shown})",
                f"{wanted}",
                good >= wanted,
            )
        )
    in_grasp = {
        (row["hand"], row["object"]): row["rotation_rad"]["median"]
        for row in rows
        if row["palm"] == "up" and row["controller"] != GAIT
    }
    further = dict.fromkeys(
        row["hand"]
        for row in rows
        if (row["controller"], row["palm"]) == (GAIT, "up")
        and row["holding"]["share"] >= 0.9
        and row["rotation_rad"]["median"] > in_grasp.get((row["hand"], row["object"]), 0.0)
    )
    out.append(
        Figure(
            f"hands with {kind} that the gait holds for {seconds:g} s in 90 % of the trials, "
            "palm up, and turns further than in-grasp manipulation",
            f"{len(further)} of {len(names)}" + (f" ({', '.join(further)})" if further else ""),
            f"{len(names)}",
            len(further) == len(names),
        )
    )
    return out


def measure(hand: HandModel, name: str, palm: str, given: Options) -> list[dict[str, Any]]:
    """The rows of a hand with an object: one for each controller."""
    about = {"hand": hand.name, "object": name, "palm": palm}
    config = SceneConfig(hand=hand.name, object=(name,), gravity=palm)
    try:
        (scene,) = config.scenes(hand)
        scene.settled  # noqa: B018 (the grasp is found here)
    except DexctlError as error:
        return [{**about, "error": str(error)}]
    rows = []
    for title, (kind, changes) in CONTROLLERS.items():
        controller = controllers.make(kind, hand, **changes)
        trace = trials(controller, config, given.seconds, given.trials, seed=given.seed)
        rows.append(
            {
                **about,
                "width_m": scene.object_width,
                "mass_kg": scene.object_mass,
                "controller": title,
                **outcome(trace, TARGET),
            }
        )
    return rows


def line(row: dict[str, Any]) -> list[str]:
    """A row for people."""
    about = [row["hand"], row.get("object", ""), row.get("palm", "")]
    if "rotation_rad" not in row:
        return [*about, row.get("missing") or row["error"], *[""] * 5]
    rotation = row["rotation_rad"]
    return [
        *about,
        row["controller"],
        f"{rotation['median']:.2f} ({rotation['p10']:.2f}-{rotation['p90']:.2f})",
        f"{row['time_held_s']['median']:.0f}",
        percent_interval(row["reached"]),
        percent_interval(row["holding"]),
        f"{100 * row['touched_by_more_than_fingertips']:.0f} %",
    ]


def main() -> None:
    given = settings(Options, __doc__)
    rows = earlier("hands_turning", given, ("seed", "trials", "seconds"))
    done = {(row["hand"], row.get("object"), row.get("palm")) for row in rows}

    def save(*, say: bool) -> None:
        table = {
            "title": f"Hands of the menagerie, {given.seconds:g} s, {given.trials} trials each; "
            "objects of 50 g; each controller with the settings that suit the hand",
            "header": [
                "Hand", "Object", "Palm", "Controller", "Rotation: median (10-90 %) [rad]",
                "Time held: median [s]", "Turned once before any drop (95 % interval)",
                "Holding at the end (95 % interval)", "Time touching palm or links",
            ],
            "rows": [line(row) for row in rows],
        }  # fmt: skip
        figures = figures_of(rows, given.seconds)
        write("hands_turning", given, figures, [table], say=say, trials=rows)

    for name in given.hands:
        try:
            hand = hands.load(name, folder=given.folder)
        except HandModelError as error:
            progress(f"{name}: not here: {error}")
            if (name, None, None) not in done:
                rows.append({"hand": name, "missing": f"not here: {error}"})
            continue
        for turned, palm in product(HELD.get(name, OBJECTS), PALMS):
            if (name, turned, palm) in done:
                continue
            found = measure(hand, turned, palm, given)
            rows += found
            for row in found:
                progress(" | ".join(line(row)))
            save(say=False)
    save(say=True)


if __name__ == "__main__":
    main()
