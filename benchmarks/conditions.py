"""Policies and the coordinated gait under named conditions, any way up, and for ten minutes."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from measuring.poses import BY_LATE, LATE
from measuring.results import Figure, earlier, write
from measuring.settings import Settings, check_chosen, progress, settings
from measuring.shares import over_seeds, percent_interval, share
from measuring.trials import FULL_TURN

from dexctl.controllers import paced
from dexctl.files import aside
from dexctl.report.style import INK, drawing, finger_colour, new_figure
from dexctl.settings import changed
from dexctl.sim import SceneConfig
from dexctl.sim.conditions import under
from learning import policies
from learning.evaluation import Protocol, evaluate, open_subject


@dataclass(frozen=True)
class Condition:
    """Under what somebody is tested.

    Attributes:
        text: for people.
        names: of `dexctl.sim.conditions.CONDITIONS`, one after the other.
        palm: which way it looks, where gravity is not drawn.
        changes: settings of the scene beside that.
        seconds: of an episode, None for the usual time.
        every: whether it is measured with all objects, not the first two only.
        hold, speed, turns: what is asked for, share of episodes held, mean speed [rad/s] and
            turns of the median episode; 0: nothing. Where a share is, `FLOOR` is the least of it.
        floor_turns: the least of ``turns``.
        asked: objects that this is asked of; what it comes to with others stands beside it, by the
            same measure, but that ``turns`` are asked of `SHAPES` where ``shapes`` says so.
        shapes: turns asked of those, and the least of them; None: none.
        of_nominal: least share of the speed any way up without anything drawn; 0: none is asked.
        drift, fingertips: the most, in the median [mm], and the least share of the time in which
            only fingertips touch, of the object that does worst; where ``turns`` are asked.
    """

    text: str
    names: tuple[str, ...] = ()
    palm: str = "up"
    changes: Mapping[str, Any] = field(default_factory=dict)
    seconds: float | None = None
    every: bool = False
    hold: float = 0.0
    speed: float = 0.0
    turns: float = 0.0
    floor_turns: float = 0.0
    drift: float = np.inf
    fingertips: float = 0.0
    asked: tuple[str, ...] = ("cube", "cylinder")
    shapes: tuple[float, float] | None = None
    of_nominal: float = 0.0


EASY = ("cube", "cylinder", "sphere", "icosahedron", "dodecahedron")
SHAPES = ("cuboid_tall", "cuboid_long", "l_shape", "u_shape")
FLOOR = 0.9
"""Share of the episodes that have to be held at least."""


_ENDURANCE: dict[str, Any] = {
    "seconds": 600.0, "hold": 0.95, "turns": 80.0, "floor_turns": 46.0, "drift": 10.0,
    "fingertips": 0.995,
}  # fmt: skip
"""What is asked of ten minutes."""
_NOMINAL: dict[str, Any] = {
    "every": True, "hold": 0.98, "speed": 0.8, "asked": EASY, "shapes": (8.0, 5.0)
}  # fmt: skip
"""What is asked of a minute without anything drawn."""
CYLINDER = 60.0, 75.0
"""Least rotation of a cylinder in a minute, palm up, and the one that is wanted [rad]."""

CONDITIONS: dict[str, Condition] = {
    "up": Condition("nominal, palm up"),
    "late": Condition("50 ms late, palm up", changes={"action_latency": 0.05}, **_NOMINAL),
    "down": Condition("nominal, palm down", palm="down"),
    "any-gravity": Condition("nominal, any way up", ("any-gravity",), **_NOMINAL),
    "by-touch": Condition(
        "nominal, any way up, tracked by touch",
        ("any-gravity",),
        changes={"object_pose": "touch"},
        **_NOMINAL,
    ),
    "limits-up": Condition("limits, palm up", ("limits",)),
    "limits": Condition("limits, any way up", ("limits", "any-gravity")),
    "limits-by-touch": Condition(
        "limits, any way up, tracked by touch",
        ("limits", "any-gravity"),
        changes={"object_pose": "touch"},
        every=True,
        hold=0.98,
    ),
    "limits-by-tracker": Condition(
        f"limits, any way up, {BY_LATE}",
        ("limits", "any-gravity"),
        changes=LATE,
        every=True,
        hold=0.98,
    ),
    "everything": Condition(
        "everything, any way up", ("everything", "any-gravity"), hold=0.98, of_nominal=0.8
    ),
    "everything-bounded": Condition(
        "everything, offsets up to 0.05 rad, any way up",
        ("everything", "bounded", "any-gravity"),
        hold=0.98,
        of_nominal=0.8,
    ),
    "all": Condition(
        "everything and limits, any way up",
        ("everything", "limits", "any-gravity"),
        every=True,
        hold=0.98,
        speed=0.5,
    ),
    "all-by-tracker": Condition(
        f"everything and limits, any way up, {BY_LATE}",
        ("everything", "limits", "any-gravity"),
        changes=LATE,
        every=True,
        hold=0.98,
        speed=0.5,
    ),
    "all-bounded": Condition(
        "everything, offsets up to 0.05 rad, and limits, any way up",
        ("everything", "bounded", "limits", "any-gravity"),
        hold=0.98,
        speed=0.5,
    ),
    "endurance": Condition(
        "everything and limits, any way up, ten minutes",
        ("everything", "limits", "any-gravity"),
        **_ENDURANCE,
    ),
    "endurance-noise": Condition(
        "noise of touch and encoders, any way up, ten minutes, by an exact tracker who needs one",
        ("noise", "any-gravity"),
        **_ENDURANCE,
    ),
}


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    seed: int = 20_000
    """First seed; trial i has the seed seed + i. Nothing was chosen by these."""
    trials: int = 100
    """Episodes for each object; with --resume a row of at least so many stays."""
    seconds: float = 60.0
    """Of each, but for endurance."""
    endurance: int = 40
    """Episodes of ten minutes."""
    who: tuple[str, ...] = ("dex5-easy", "coordinated")
    """Policies, by name or file, and controllers."""
    objects: tuple[str, ...] = EASY
    """Which; the first two under all conditions, the others where any gravity or all is drawn."""
    conditions: tuple[str, ...] = tuple(CONDITIONS)
    """Which."""
    cards: bool = False
    """Whether the policies' cards are to say what was measured."""
    picture: Path | None = Path(__file__).resolve().parents[1] / "docs" / "images" / "survival.png"
    """Where the survival curves of ten minutes are drawn, where there are any; None: nowhere."""


def episodes(chosen: str, given: Options) -> int:
    """Of a row."""
    return given.endurance if CONDITIONS[chosen].seconds else given.trials


def measure(who: str, chosen: str, turned: str, given: Options) -> dict[str, Any]:
    """One row."""
    condition, subject = CONDITIONS[chosen], open_subject(who)
    own = subject.protocol()  # of a policy: its hand, what it weighed there, and its axis
    scene = SceneConfig(
        hand=own.scene.hand,
        object=(turned,),
        object_mass=own.scene.object_mass,
        gravity=condition.palm,
    )
    scene = changed(under(scene, *condition.names), condition.changes)
    protocol = Protocol(
        scene=replace(scene, threads=1),
        episodes=episodes(chosen, given),
        seconds=condition.seconds or given.seconds,
        seed=given.seed,
    )
    found = evaluate(subject, changed(protocol, {"axis": own.task.axis}))
    curves = {}
    for name, near in (("survival", False), ("survival_near", True)):
        times, held = found.survival(near=near)
        curves[name] = {"time_s": times.round(2).tolist(), "share_held": held.round(4).tolist()}
    return {
        "who": who,
        "condition": chosen,
        "object": turned,
        "trained_with": list(subject.objects),
        "time_s": protocol.seconds,
        "rotation_rad": over_seeds(found.rotation),
        "revolutions_median": round(float(np.median(found.rotation)) / FULL_TURN, 3),
        "speed_rad_s": round(float(found.speed.mean()), 4),
        "holding": share(~found.dropped),
        "within_25_mm": share(~found.strayed),
        "time_held_s": over_seeds(found.time_held),
        "fingertips_only": round(float(found.fingertips_only.mean()), 4),
        "drift_mm": over_seeds(1000.0 * found.drift),
        "mean_drift_mm": over_seeds(1000.0 * found.mean_drift),
        "sink_mm": over_seeds(1000.0 * found.sink),
        **curves,
    }


def key_of(row: dict[str, Any]) -> tuple[str, str, str]:
    """What tells a row from the others."""
    return row["who"], row["condition"], row["object"]


@cache
def _objects(who: str) -> tuple[str, ...]:
    """Of a shipped policy, by its card: its hand's file need not be there."""
    plain = paced(who)[0]
    if plain not in policies.names():
        return ()
    card = json.loads((policies.FOLDER / f"{plain}.json").read_text())
    return tuple(card["trained"]["env"]["scene"]["object"])


def trained_with(row: dict[str, Any]) -> bool:
    """Whether a policy was trained with the row's object; so counts who was not trained."""
    # earlier rows do not say it
    objects = row["trained_with"] if "trained_with" in row else _objects(row["who"])
    return not objects or row["object"] in objects


def figures(rows: list[dict[str, Any]]) -> list[Figure]:
    """What was asked for, of the objects that it is asked of, and of the others.

    Objects that a policy was not trained with stand by themselves.
    """
    found = []
    for who, (name, condition) in product(
        dict.fromkeys(row["who"] for row in rows), CONDITIONS.items()
    ):
        mine = [row for row in rows if (row["who"], row["condition"]) == (who, name)]
        usual = {
            row["object"]: row["speed_rad_s"]
            for row in rows
            if (row["who"], row["condition"]) == (who, "any-gravity")
        }
        if name == "up":
            found += [_far(row) for row in mine if row["object"] == "cylinder"]
        if not condition.hold:
            continue
        for known, asked in product((True, False), (True, False)):
            some = [
                row
                for row in mine
                if (trained_with(row), row["object"] in condition.asked) == (known, asked)
            ]
            if some:
                found += _figures(some, condition, usual)
    return found


def _figures(
    mine: list[dict[str, Any]], condition: Condition, usual: Mapping[str, float]
) -> list[Figure]:
    """Floor and goal of one condition with some objects; ``usual``: nominal speed of each."""
    held, trials = (sum(row["holding"][key] for row in mine) for key in ("count", "of"))
    speed = float(np.mean([row["speed_rad_s"] for row in mine]))
    turns = min(row["revolutions_median"] for row in mine)
    tips = min(row["fingertips_only"] for row in mine)
    floor, goal = f"floor: {100 * FLOOR:.0f} % hold", f"{100 * condition.hold:.0f} % hold"
    measured = f"{held} of {trials}, {speed:.2f} rad/s"
    wanted, floor_turns = condition.turns, condition.floor_turns
    shapes = condition.shapes is not None and all(row["object"] in SHAPES for row in mine)
    if shapes and condition.shapes is not None:
        wanted, floor_turns = condition.shapes
    met = held / trials >= condition.hold and speed >= condition.speed
    if condition.speed:
        goal += f", {condition.speed} rad/s"
    if condition.of_nominal and all(row["object"] in usual for row in mine):
        share = speed / float(np.mean([usual[row["object"]] for row in mine]))
        goal += f", {100 * condition.of_nominal:.0f} % of the nominal speed"
        measured += f", {100 * share:.0f} % of the nominal"
        met = met and share >= condition.of_nominal
    if wanted:  # of the object that is turned least, and drifts most
        floor += f", {floor_turns:g} turns"
        goal += f", {wanted:g} turns"
        measured += f", {turns:.3g} turns"
        met = met and turns >= wanted
    if condition.turns:
        drift = max(row["drift_mm"]["median"] for row in mine)
        goal += f", drift under {condition.drift:g} mm, only fingertips in "
        goal += f"{100 * condition.fingertips:g} %"
        measured += f", {drift:.0f} mm"
        if all("mean_drift_mm" in row for row in mine):
            mean = max(row["mean_drift_mm"]["median"] for row in mine)
            measured += f" ({mean:.0f} on average)"
        measured += f", {100 * tips:.1f} %"
        met = met and drift < condition.drift and tips >= condition.fingertips
    objects = ", ".join(row["object"] for row in mine)
    new = "" if trained_with(mine[0]) else "not trained with: "
    what = f"{mine[0]['who']}, {condition.text} ({new}{objects}): held"
    enough = held / trials >= FLOOR and turns >= floor_turns
    return [Figure(what, measured, floor, enough), Figure(what, measured, goal, met)]


def _far(row: dict[str, Any]) -> Figure:
    """How far a cylinder is turned, palm up."""
    least, wanted = CYLINDER
    turned = row["rotation_rad"]["median"]
    return Figure(
        f"{row['who']}, nominal, palm up, cylinder: rotation in {row['time_s']:g} s",
        f"median {turned:.1f} rad, {percent_interval(row['holding'])} held",
        f"{wanted:g} rad by the general policy (floor: {least:g})",
        bool(turned >= wanted),
    )


def save(rows: list[dict[str, Any]], given: Options, *, say: bool) -> None:
    """Write the result with the rows so far."""
    lines = [
        [
            row["who"],
            CONDITIONS[row["condition"]].text,
            row["object"],
            f"{row['holding']['of']}",
            percent_interval(row["holding"]),
            f"{100 * row['within_25_mm']['share']:.0f} %",
            f"{row['rotation_rad']['median']:.1f}",
            f"{row['speed_rad_s']:.2f}",
            f"{100 * row['fingertips_only']:.1f} %",
            *(f"{row[far]['median']:.0f}" if far in row else "" for far in ("drift_mm", "sink_mm")),
        ]
        for row in sorted(rows, key=lambda row: list(CONDITIONS).index(row["condition"]))
    ]
    header = ["", "Conditions", "Object", "Episodes", "Held", "Within 25 mm"]
    header += ["Rotation: median [rad]", "Speed [rad/s]", "Only fingertips"]
    header += ["Drifts by: median [mm]", "Sinks by: median [mm]"]  # at most, any way; along gravity
    table = {
        "title": "Under named conditions, about the axis that a policy was trained for, "
        f"{given.seconds:g} s each, or as long as is said",
        "header": header,
        "rows": lines,
    }
    write("conditions", given, figures(rows), [table], trials=rows, say=say)


def draw(path: Path, long: list[dict[str, Any]]) -> None:
    """A panel for each condition and object: the share of episodes that still hold it."""
    kinds = list(dict.fromkeys((row["condition"], row["object"]) for row in long))
    subjects = list(dict.fromkeys(row["who"] for row in long))
    styles: dict[str, tuple[str, Any]] = {
        "survival": ("50 mm", "-"),
        "survival_near": ("25 mm", (0, (4, 2))),
    }
    lines = -(-len(kinds) // 2)
    with drawing():
        figure = new_figure(7.6, 1.2 + 3.1 * lines)
        panels = figure.subplots(lines, 2, sharey=True, squeeze=False)
        shown: dict[str, Any] = {}
        for panel, kind in zip(panels.flat, kinds, strict=False):
            mine = [row for row in long if (row["condition"], row["object"]) == kind]
            for row in mine:
                i = subjects.index(row["who"])
                for curve, (within, style) in styles.items():
                    if curve not in row:  # measured before that was kept
                        continue
                    minutes = [t / 60 for t in (*row[curve]["time_s"], row["time_s"])]
                    held = [100 * share for share in row[curve]["share_held"]]
                    (line,) = panel.step(
                        minutes,
                        [*held, held[-1]],
                        where="post",
                        color=finger_colour(i),
                        ls=style,
                        lw=1.8,
                    )
                    shown.setdefault(f"{row['who']}, within {within}", line)
            counts = sorted({row["holding"]["of"] for row in mine})
            under = " and ".join(CONDITIONS[kind[0]].names[:-1])  # the last: any way up
            panel.set_title(f"{kind[1]}, {under}\n{' or '.join(map(str, counts))} episodes")
            panel.set(xlabel="time [min]", ylim=(-3, 103), xlim=(0, mine[0]["time_s"] / 60))
        for panel in panels.flat[len(kinds) :]:
            panel.set_visible(False)
        for panel in panels[:, 0]:
            panel.set_ylabel("episodes that hold it [%]")
        figure.legend(
            shown.values(), shown.keys(), loc="outside upper left", ncols=2, labelcolor=INK
        )
        with aside(path) as part:
            figure.savefig(part)


def write_cards(rows: list[dict[str, Any]], given: Options) -> None:
    """What was measured, at whichever pace, in the cards of all policies with rows."""
    keys = ("object", "time_s", "holding", "revolutions_median", "speed_rad_s", "fingertips_only")
    for plain in dict.fromkeys(paced(row["who"])[0] for row in rows):
        path = policies.FOLDER / f"{plain}.npz" if plain in policies.names() else Path(plain)
        if path.suffix != ".npz" or not path.is_file():
            continue
        tested = []
        for row in rows:
            name, pace = paced(row["who"])
            if name == plain:
                how = {"pace": pace} if pace != 1.0 else {}
                text = CONDITIONS[row["condition"]].text
                tested.append({"conditions": text} | how | {key: row[key] for key in keys})
        policies.annotate(path, tested={"first_seed": given.seed, "results": tested})


def main() -> None:
    given = settings(Options, __doc__)
    check_chosen("conditions", given.conditions, CONDITIONS)
    # a row of more episodes begins with those of the row of fewer, whose place it takes
    rows = {key_of(row): row for row in earlier("conditions", given, ("seed", "seconds"))}
    for chosen, turned, who in product(given.conditions, given.objects, given.who):
        asked = CONDITIONS[chosen].every or turned in given.objects[:2]
        before = rows.get((who, chosen, turned))
        if not asked or (before and before["holding"]["of"] >= episodes(chosen, given)):
            continue
        row = rows[who, chosen, turned] = measure(who, chosen, turned, given)
        save(list(rows.values()), given, say=False)
        progress(
            f"{who}, {chosen}, {turned}: {percent_interval(row['holding'])}, "
            f"{row['rotation_rad']['median']:.1f} rad"
        )
    found = list(rows.values())
    save(found, given, say=True)
    if given.cards:
        write_cards(found, given)
    long = [row for row in found if CONDITIONS[row["condition"]].seconds]
    if given.picture is not None and long:
        draw(given.picture, long)


if __name__ == "__main__":
    main()
