"""Hands turn objects: in-grasp manipulation, and the coordinated gait.

The same controllers with no code of their own for any hand; what a hand holds, and where, stands in
its toml: in the one that ships, for the menagerie's hands, and in what `dexctl hands add FILE`
writes when it runs as a process, for every hand. Needs the hands' files: a folder in
DEXCTL_MENAGERIE, or the `mujoco-menagerie` package, and those that are named by their files; hands
that are missing are said so. `--resume` goes on with the rows that there are.
"""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from measuring.adding import process
from measuring.results import Figure, earlier, write
from measuring.settings import Settings, progress, settings
from measuring.shares import percent, percent_interval
from measuring.trials import FULL_TURN, PALMS, outcome, trials

from dexctl import HandModel, controllers, hands
from dexctl.exceptions import DexctlError
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
UNSEEN = 1000  # after the first seed: of trials that `hands add` has not chosen by
SHIPPED = "shipped"  # where the toml is from; or as `added` says it
TARGET = FULL_TURN  # rotation that is counted [rad]
# palm, share of the trials that are to be turned once and held, and of how many hands
ASKED = (("up", 0.95, 2), ("down", 0.8, 1))
KINDS = {"a sphere or cylinder": ("sphere", "cylinder"), "a cube": ("cube",)}  # asked for each


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    trials: int = 16
    """Per object, palm direction and controller."""
    seconds: float = 60.0
    """Simulated, each trial."""
    hands: tuple[str, ...] = tuple(HELD)
    """Names of hands, or files of hands."""
    adds: int = 2
    """How often `dexctl hands add` runs for each file, with seeds from the one after the first on:
    with that one its search was worked out."""
    told: str = ""
    """Further options that it is given; as nobody gives them who has a file only, by default."""
    folder: Path | None = None
    """Folder that holds the hands' folders."""


def added(seed: int) -> str:
    """Where a toml is from that `dexctl hands add` wrote."""
    return f"hands add, seed {seed}"


def figures_of(rows: list[dict[str, Any]], seconds: float) -> list[Figure]:
    """What is asked of all hands, and a line for each toml, object and controller."""
    shipped = [row for row in rows if toml_of(row) == SHIPPED]
    out = [*over_hands(shipped, seconds), *over_proposed(rows, seconds)]
    kinds = dict.fromkeys((row["hand"], toml_of(row), row.get("object")) for row in rows)
    for (hand, toml, name), controller in product(kinds, CONTROLLERS):
        mine = [
            row
            for row in rows
            if (row["hand"], toml_of(row), row.get("object")) == (hand, toml, name)
            and row.get("controller") == controller
        ]
        if not mine:
            continue
        parts = [
            f"palm {row['palm']} {row['rotation_rad']['median']:.1f} rad, "
            f"{percent(row['reached_and_holding'])}, {percent(row['holding'])} hold"
            for row in mine
        ]
        about = "" if toml == SHIPPED else f" ({toml})"
        out.append(
            Figure(
                f"{Path(hand).stem}{about}, {controller}, {name} of "
                f"{1000 * mine[0]['width_m']:.0f} mm, "
                f"{seconds:g} s: median rotation, trials that turn it once and still hold it, "
                "trials that hold it",
                "; ".join(parts),
            )
        )
    return out


def toml_of(row: dict[str, Any]) -> str:
    """Where the toml of a row is from; rows of before there was a choice are of those that ship."""
    return row.get("toml", SHIPPED)


def over_proposed(rows: list[dict[str, Any]], seconds: float) -> list[Figure]:
    """Of how many of the three hands the gait turns what `dexctl hands add` proposes, surely."""
    mine = [
        row
        for row in rows
        if toml_of(row) != SHIPPED and row["hand"] in HELD and row.get("controller") in (GAIT, None)
    ]
    of = len({row["hand"] for row in mine})
    out = []
    for palm, least, wanted in ASKED:
        good, said = 0, []
        for hand in dict.fromkeys(row["hand"] for row in mine):
            # a run that found no grasp has no palm, and counts for both
            ours = [r for r in mine if r["hand"] == hand and r.get("palm", palm) == palm]
            turned = [r.get("reached_and_holding") for r in ours]
            good += bool(ours) and all(one and one["share"] >= least for one in turned)
            each = ", ".join(percent(one) if one else "no grasp" for one in turned)
            said.append(f"{Path(hand).stem} {each}")
        out.append(
            Figure(
                "menagerie's hands with what `dexctl hands add` proposes that the coordinated "
                f"gait turns once in {seconds:g} s and still holds in {100 * least:.0f} % of the "
                f"trials, palm {palm}, in every run of it",
                f"{good} of {of} ({'; '.join(said)})",
                f"{wanted}",
                good >= wanted,
            )
        )
    return out if mine else []


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
    for palm, least, wanted in ASKED:
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


def measure(
    hand: HandModel, source: str, about: dict[str, Any], given: Options, seed: int
) -> list[dict[str, Any]]:
    """The rows of a hand with an object: one for each controller.

    Args:
        hand: the hand.
        source: its name, or its toml.
        about: what the rows begin with: hand, toml, object and palm.
        given: settings.
        seed: of the first trial.
    """
    config = SceneConfig(hand=source, object=(about["object"],), gravity=about["palm"])
    try:
        (scene,) = config.scenes(hand)
        scene.settled  # noqa: B018 (the grasp is found here)
    except DexctlError as error:
        return [{**about, "error": str(error)}]
    rows = []
    for title, (kind, changes) in CONTROLLERS.items():
        controller = controllers.make(kind, hand, **changes)
        trace = trials(controller, config, given.seconds, given.trials, seed=seed)
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


def measure_added(name: str, file: Path, seed: int, given: Options) -> list[dict[str, Any]]:
    """The rows of what `dexctl hands add` writes for a file, both ways up."""
    about = {"hand": name, "toml": added(seed)}
    with TemporaryDirectory() as folder:
        toml = Path(folder) / "my_hand.toml"
        words = ["hands", "add", str(file), "--out", str(toml), "--seed", str(seed)]
        done = process([*words, *shlex.split(given.told)])
        about |= {"add_wall_s": done["wall_s"], "add_cpu_s": done["cpu_s"]}
        if done["error"] is not None:
            return [{**about, "error": done["error"]}]
        hand = hands.load(toml)
        held = hand.config.object
        about |= {"centre_m": held.centre, "travel_rad": held.travel, "object": held.shape}
        return [
            row
            for palm in PALMS
            for row in measure(hand, str(toml), {**about, "palm": palm}, given, given.seed + UNSEEN)
        ]


def line(row: dict[str, Any]) -> list[str]:
    """A row for people."""
    about = [Path(row["hand"]).stem, toml_of(row), row.get("object", ""), row.get("palm", "")]
    if "rotation_rad" not in row:
        return [*about, row.get("missing") or row["error"], *[""] * 6]
    rotation = row["rotation_rad"]
    return [
        *about,
        f"{1000 * row['width_m']:.0f} mm, {1000 * row['mass_kg']:.0f} g",
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
    done = {(row["hand"], toml_of(row), row.get("object"), row.get("palm")) for row in rows}
    ran = {(row["hand"], toml_of(row)) for row in rows}

    def save(*, say: bool) -> None:
        table = {
            "title": f"Hands turn objects, {given.seconds:g} s, {given.trials} trials each; by the "
            "tomls that ship, and by what `dexctl hands add` writes",
            "header": [
                "Hand", "Toml", "Object", "Palm", "Width and mass", "Controller",
                "Rotation: median (10-90 %) [rad]",
                "Time held: median [s]", "Turned once before any drop (95 % interval)",
                "Holding at the end (95 % interval)", "Time touching palm or links",
            ],
            "rows": [line(row) for row in rows],
        }  # fmt: skip
        figures = figures_of(rows, given.seconds)
        write("hands_turning", given, figures, [table], say=say, trials=rows)

    def add(found: list[dict[str, Any]]) -> None:
        rows.extend(found)
        for row in found:
            progress(" | ".join(line(row)))
        save(say=False)

    files: dict[str, Path] = {}
    for name in given.hands:
        try:
            hand = hands.load(name, folder=given.folder)
        except DexctlError as error:
            progress(f"{name}: not here: {error}")
            if all(row["hand"] != name for row in rows):
                rows.append({"hand": name, "missing": f"not here: {error}"})
            continue
        files[name] = hand.path
        for turned, palm in product(HELD.get(name, ()), PALMS):
            if (name, SHIPPED, turned, palm) not in done:
                about = {"hand": name, "toml": SHIPPED, "object": turned, "palm": palm}
                add(measure(hand, name, about, given, given.seed))
    seeds = range(given.seed + 1, given.seed + 1 + given.adds)
    for seed, (name, file) in product(seeds, files.items()):
        if (name, added(seed)) not in ran:
            add(measure_added(name, file, seed, given))
    save(say=True)


if __name__ == "__main__":
    main()
