"""In-grasp manipulation at the end of its reach: 60 s, five objects, and motions there and back.

Turns held to the end of the reach, with the slowing down and without it, and with links that may
come to lie on the object; whether what was turned to its end comes back where the turn is
asked for the other way; then 20 mm along each axis and 0.3 rad about each, there and back again,
tracked. The file is written after every row.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from measuring.results import Figure, earlier, write
from measuring.settings import Settings, progress, settings
from measuring.shares import over_seeds, percent, percent_interval, share
from measuring.trials import PALMS, outcome, trials

import dexctl
from dexctl.igm import InGraspManipulationChanges, Share
from dexctl.rotations import inverse, multiply, rotation_vector
from dexctl.sim import SceneConfig, Simulation, run

OBJECTS = ("cube", "cylinder", "sphere", "icosahedron", "dodecahedron")
# of an end: what people read, and what differs from the controller's defaults
KINDS: dict[str, tuple[str, InGraspManipulationChanges]] = {
    (OURS := "reach"): ("stops at the end of its reach", {}),
    "links": (
        "stops there, links may lie on the object",
        {"link_limit": 0.6, "reach_margin": 0.02, "slip_limit": 0.35},
    ),
    (NONE := "regardless"): ("goes on regardless", {"reach_distance": 0.0}),
}
BACK = (20.0, 20.0)  # how long one way, and the other [s]
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


def other_way(kind: str) -> str:
    """What rows of `returned` are called."""
    return f"{kind}, back"


def held(kind: str, name: str, palm: str, given: Options) -> dict[str, Any]:
    """A row: turned until the end of the reach, and held there."""
    controller = dexctl.InGraspManipulation(dexctl.hands.load("dex5"), **KINDS[kind][1])
    config = SceneConfig(object=(name,), gravity=palm)
    trace = trials(controller, config, given.seconds, given.trials, seed=given.seed)
    return {"kind": kind, "object": name, "palm": palm, **outcome(trace)}


def returned(kind: str, name: str, palm: str, given: Options) -> dict[str, Any]:
    """A row: turned to the end, then the other way; those held that are past their start again."""
    hand = dexctl.hands.load("dex5")
    traces = []
    with Simulation(SceneConfig(object=(name,), gravity=palm), given.trials, given.seed) as sim:
        sim.reset(given.seed)
        for sign, seconds in zip((1.0, -1.0), BACK, strict=True):
            controller = dexctl.InGraspManipulation(hand, axis=(0, 0, sign), **KINDS[kind][1])
            traces.append(run(controller, sim, seconds))
    there, again = traces[0].rotation[-1], -traces[1].rotation[-1]
    held = traces[0].held[-1] & traces[1].held[-1]
    return {
        "kind": other_way(kind),
        "object": name,
        "palm": palm,
        "there_rad": over_seeds(there),
        "back_rad": over_seeds(again),
        "returned": share(held & (again >= there)),
    }


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
    backs: dict[str, dict[str, str]] = {}
    for row in rows:
        where = f"{row['object']}, {row['palm']}"
        if "returned" in row:
            backs.setdefault(where, {})[row["kind"]] = percent_interval(row["returned"])
            continue
        if row["kind"] == "tracked":
            unit, scale = ("mm", 1e3) if row["motion"] == "linear" else ("rad", 1.0)
            there, back = (scale * row[f"error_{k}"]["median"] for k in ("there", "back"))
            motions.setdefault(where, []).append(f"{there:.2f}, {back:.2f} {unit}")
            continue
        cell = f"{row['rotation_rad']['median']:.2f} rad, {percent_interval(row['holding'])}"
        lines.setdefault(where, {})[row["kind"]] = cell
    header = ["Object, palm", *(words for words, _ in KINDS.values())]
    return [
        {
            "title": f"In-grasp manipulation, {given.seconds:g} s, {given.trials} trials each: "
            "median rotation at the end or the drop, share that holds (95 % interval)",
            "header": header,
            "rows": [[where, *(c.get(kind, "") for kind in KINDS)] for where, c in lines.items()],
        },
        {
            "title": f"Turned for {BACK[0]:g} s, and {BACK[1]:g} s the other way, {given.trials} "
            "trials each: held and past its start again (95 % interval)",
            "header": header,
            "rows": [
                [where, *(c.get(other_way(k), "") for k in KINDS)] for where, c in backs.items()
            ],
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
    for kind, (words, _) in KINDS.items():
        own = [row["holding"] for row in rows if row["kind"] == kind]
        if own:
            all_held = together(own)
            goal = f"{100 * GOAL:.0f} % of trials" if kind == OURS else ""
            found.append(
                Figure(
                    f"in-grasp manipulation that {words}: holds for 60 s, {len(own)} scenes",
                    percent(all_held),
                    goal,
                    all_held["share"] >= GOAL if goal else None,
                )
            )
    for kind, (words, _) in KINDS.items():
        own = [row["returned"] for row in rows if row["kind"] == other_way(kind)]
        if own:
            found.append(
                Figure(
                    f"in-grasp manipulation that {words}: comes back past its start when the turn "
                    f"is asked for the other way, {len(own)} scenes",
                    percent(together(own)),
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


def together(shares: list[dict[str, Any]]) -> dict[str, Any]:
    """The share of all scenes."""
    count, of = (sum(each[key] for each in shares) for key in ("count", "of"))
    return {"count": count, "of": of, "share": count / of}


def cost_of_stopping(rows: list[dict[str, Any]]) -> list[Figure]:
    """What stopping costs: the rotation beside that of going on up to the drop."""
    each: dict[tuple[str, str], dict[str, float]] = {}
    for row in rows:
        if row["kind"] in (OURS, NONE):
            scene = each.setdefault((row["object"], row["palm"]), {})
            scene[row["kind"]] = row["rotation_rad"]["median"]
    both = [scene for scene in each.values() if len(scene) == 2]
    if not both:
        return []
    as_far = sum(scene[OURS] >= scene[NONE] for scene in both)
    ours, theirs = (float(np.median([scene[kind] for scene in both])) for kind in (OURS, NONE))
    return [
        Figure(
            f"in-grasp manipulation that {KINDS[OURS][0]}: turns as far as where it "
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
    for kind, name, palm in product(KINDS, given.objects, PALMS):
        if not done(kind=other_way(kind), object=name, palm=palm):
            row = returned(kind, name, palm, given)
            keep(row, f"{other_way(kind)}, {name}, {palm}: {percent(row['returned'])}")
    write("reach", given, figures_of(rows), tables_of(rows, given), trials=rows)


if __name__ == "__main__":
    main()
