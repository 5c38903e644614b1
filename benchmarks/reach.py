"""In-grasp manipulation at the end of its reach: 60 s, five objects, and motions there and back.

Turns held to the end of the reach, with the slowing down and without it; then 20 mm along each axis
and 0.3 rad about each, there and back again, tracked. The file is written after every row.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from common import (
    PALMS,
    Figure,
    Settings,
    earlier,
    outcome,
    over_seeds,
    percent,
    percent_interval,
    progress,
    settings,
    trials,
    write,
)

import dexctl
from dexctl.igm import Share
from dexctl.rotations import inverse, multiply, rotation_vector
from dexctl.sim import SceneConfig, Simulation

OBJECTS = ("cube", "cylinder", "sphere", "icosahedron", "dodecahedron")
KINDS = {"reach": "stops at the end of its reach", "regardless": "goes on regardless"}
GOAL = 0.99
SPEEDS = {"linear": 0.01, "angular": 0.15}  # [m/s], [rad/s]
WAYS = {"linear": 0.02, "angular": 0.3}  # [m], [rad]


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    trials: int = 100
    """Per row."""
    seconds: float = 60.0
    """Simulated, each trial."""
    objects: tuple[str, ...] = OBJECTS
    """Objects to turn."""


def held(kind: str, name: str, palm: str, given: Options) -> dict[str, Any]:
    """A row: turned until the end of the reach, and held there."""
    hand = dexctl.hands.load("dex5")
    if kind == "reach":
        controller = dexctl.InGraspManipulation(hand)
    else:
        controller = dexctl.InGraspManipulation(hand, reach_distance=0.0)
    config = SceneConfig(object=(name,), gravity=palm)
    trace = trials(controller, config, given.seconds, given.trials, seed=given.seed)
    return {"kind": kind, "object": name, "palm": palm, **outcome(trace)}


def tracked(name: str, palm: str, axis: int, given: Options) -> dict[str, Any]:
    """A row: along (0 to 2) or about (3 to 5) an axis, there and back."""
    hand = dexctl.hands.load("dex5")
    kind = "linear" if axis < 3 else "angular"
    controller = dexctl.InGraspManipulation(hand)
    count = min(given.trials, 16)
    steps = round(WAYS[kind] / SPEEDS[kind] / controller.control_period)
    with Simulation(SceneConfig(object=(name,), gravity=palm), count, given.seed) as sim:
        sim.reset(given.seed)
        controller.reset(given.seed)
        state, start = sim.read(), sim.state
        ends = []
        for sign in (1.0, -1.0):
            twist = np.zeros((count, 6))
            twist[:, axis] = sign * SPEEDS[kind]
            for _ in range(steps):
                sim.write(state.q_target + controller.command(state, Share(twist=twist)))
                sim.step()
                state = sim.read()
            ends.append(_moved(start, sim.state)[:, axis])
    way = WAYS[kind]
    return {
        "kind": "tracked",
        "object": name,
        "palm": palm,
        "axis": "xyz"[axis % 3],
        "motion": kind,
        "asked": way,
        "error_there": over_seeds(np.abs(ends[0] - way)),
        "error_back": over_seeds(np.abs(ends[1])),
    }


def _moved(start: dexctl.GraspState, end: dexctl.GraspState) -> np.ndarray:
    """(translation [m], rotation vector [rad]) from one state to the other, ``(N, 6)``."""
    turn = multiply(np.asarray(end.object_quaternion), inverse(np.asarray(start.object_quaternion)))
    shift = np.asarray(end.object_position) - np.asarray(start.object_position)
    return np.concatenate([shift, rotation_vector(turn)], axis=1)


def tables_of(rows: list[dict[str, Any]], given: Options) -> list[dict[str, Any]]:
    """Turns and holds, one line a scene; then errors of the motions."""
    lines: dict[str, dict[str, str]] = {}
    motions: dict[str, list[str]] = {}
    for row in rows:
        where = f"{row['object']}, {row['palm']}"
        if row["kind"] == "tracked":
            unit, scale = ("mm", 1e3) if row["motion"] == "linear" else ("rad", 1.0)
            there, back = (scale * row[f"error_{k}"]["median"] for k in ("there", "back"))
            motions.setdefault(where, []).append(f"{there:.2f}, {back:.2f} {unit}")
            continue
        cell = f"{row['rotation_rad']['median']:.2f} rad, {percent_interval(row['holding'])}"
        lines.setdefault(where, {})[row["kind"]] = cell
    header = ["Object, palm", *KINDS.values()]
    return [
        {
            "title": f"In-grasp manipulation, {given.seconds:g} s, {given.trials} trials each: "
            "median rotation at the end or the drop, share that holds (95 % interval)",
            "header": header,
            "rows": [[where, *(c.get(kind, "") for kind in KINDS)] for where, c in lines.items()],
        },
        {
            "title": "Motions there and back, 20 mm and 0.3 rad: median error there, and back",
            "header": ["Object, palm", *(f"{k} {a}" for k in ("along", "about") for a in "xyz")],
            "rows": [[where, *cells] for where, cells in motions.items()],
        },
    ]


def figures_of(rows: list[dict[str, Any]]) -> list[Figure]:
    """How many hold, and how exactly motions are tracked."""
    found = []
    for kind, words in KINDS.items():
        own = [row for row in rows if row["kind"] == kind]
        if own:
            count, of = (sum(row["holding"][key] for row in own) for key in ("count", "of"))
            share = count / of
            goal = f"{100 * GOAL:.0f} % of trials" if kind == "reach" else ""
            found.append(
                Figure(
                    f"in-grasp manipulation that {words}: holds for 60 s, {len(own)} scenes",
                    percent({"count": count, "of": of, "share": share}),
                    goal,
                    share >= GOAL if goal else None,
                )
            )
    found += cost_of_stopping(rows)
    for kind, unit, scale in (("linear", "mm", 1e3), ("angular", "rad", 1.0)):
        own = [row for row in rows if row["kind"] == "tracked" and row["motion"] == kind]
        if own:
            errors = {
                end: [scale * row[f"error_{end}"]["median"] for row in own]
                for end in ("there", "back")
            }
            there, back = (float(np.median(those)) for those in errors.values())
            worst = max(map(max, errors.values()))
            asked = f"{scale * WAYS[kind]:g} {unit}"
            text = f"error {there:.2f} {unit} there, {back:.2f} {unit} back (medians of "
            text += f"{len(own)} motions), {worst:.2f} {unit} in the worst"
            found.append(Figure(f"in-grasp manipulation: {asked}, there and back", text))
    return found


def cost_of_stopping(rows: list[dict[str, Any]]) -> list[Figure]:
    """What stopping costs: the rotation beside that of going on up to the drop."""
    each: dict[tuple[str, str], dict[str, float]] = {}
    for row in rows:
        if row["kind"] in KINDS:
            scene = each.setdefault((row["object"], row["palm"]), {})
            scene[row["kind"]] = row["rotation_rad"]["median"]
    both = [scene for scene in each.values() if len(scene) == len(KINDS)]
    if not both:
        return []
    as_far = sum(scene["reach"] >= scene["regardless"] for scene in both)
    ours, theirs = (float(np.median([scene[kind] for scene in both])) for kind in KINDS)
    return [
        Figure(
            f"in-grasp manipulation that {KINDS['reach']}: turns as far as where it "
            "goes on regardless, before the drop",
            f"{as_far} of {len(both)} scenes; median {ours:.1f} and {theirs:.1f} rad",
            "all of them",
            as_far == len(both),
        )
    ]


def main() -> None:
    given = settings(Options, __doc__)
    rows = earlier("reach", given)

    def done(**key: str) -> bool:
        return any(all(row.get(name) == value for name, value in key.items()) for row in rows)

    def keep(row: dict[str, Any], text: str) -> None:
        rows.append(row)
        progress(text)
        write("reach", given, figures_of(rows), tables_of(rows, given), trials=rows, say=False)

    for name, palm in product(given.objects, PALMS):
        for axis in range(6):
            motion = "linear" if axis < 3 else "angular"
            key = {"object": name, "palm": palm, "axis": "xyz"[axis % 3], "motion": motion}
            if not done(**key):
                row = tracked(name, palm, axis, given)
                errors = row["error_there"]["median"], row["error_back"]["median"]
                keep(row, f"{', '.join(key.values())}: errors {errors}")
    for kind, name, palm in product(KINDS, given.objects, PALMS):
        if not done(kind=kind, object=name, palm=palm):
            row = held(kind, name, palm, given)
            turned = row["rotation_rad"]["median"]
            keep(row, f"{kind}, {name}, {palm}: {turned} rad, {percent(row['holding'])}")
    write("reach", given, figures_of(rows), tables_of(rows, given), trials=rows)


if __name__ == "__main__":
    main()
