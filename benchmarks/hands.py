"""Hands that nothing here was made for: from a file to a grasp that holds.

Of each hand no more is taken than its description file and its fingertips; where it holds an
object, how large and in which posture is searched for (`Scene.suggest_grasp`). Each grasp that is
suggested is written into a toml, as `dexctl hands add` does, and held by the set-points alone,
palm up and palm down. Before that `dexctl hands add FILE` itself runs as a process, as somebody who
has no more than the file types it, and `dexctl hands check` tries what it wrote. Hands whose files
are not here are said so.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter, process_time
from typing import Any

import numpy as np
from measuring.adding import (
    COMMANDS,
    added,
    figures_of_adding,
    in_order,
    line_of_adding,
    table_of_adding,
)
from measuring.results import Figure, earlier, read, write
from measuring.settings import Settings, progress, settings
from measuring.shares import over_seeds, percent_interval, share
from measuring.trials import PALMS, trials

from dexctl import HandModel, controllers, hands
from dexctl.exceptions import DexctlError
from dexctl.hand_config import HeldObject, PostureConfig
from dexctl.sim import Scene, SceneConfig, SuggestedGrasp

OBJECTS = ("cube", "sphere", "cylinder")
FIXED = ("seed", "trials", "seconds", "suggestions", "searches")


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    trials: int = 8
    """Of each grasp that is suggested, palm up and palm down."""
    seconds: float = 10.0
    """Simulated, each trial."""
    hands: tuple[str, ...] = ("dex5", "wonik_allegro", "leap_hand", "shadow_hand")
    """Names of hands, or files of hands."""
    objects: tuple[str, ...] = OBJECTS
    """Objects to hold."""
    suggestions: int = 3
    """Grasps that are taken of each search."""
    searches: int = 4
    """Searches for each hand and object, with seeds from the first on."""
    adds: int = 2
    """How often `dexctl hands add` runs for each file, with seeds from the first on."""
    told: str = ""
    """Further options that it is given; as nobody gives them who has a file only, by default."""


def bare(name: str) -> HandModel:
    """The hand by its file and fingertips, without what is known of where it holds things."""
    config = hands.load(name).config
    return replace(config, postures=PostureConfig(), object=HeldObject()).build()


def suggested(hand: HandModel, name: str, seed: int, given: Options) -> dict[str, Any]:
    """One search: its grasps, how long it took, and why it failed where it did."""
    wall, cpu = perf_counter(), process_time()
    try:
        found = Scene.suggest_grasp(hand, name, count=given.suggestions, seed=seed)
        error = None
    except DexctlError as problem:
        found, error = (), str(problem)
    return {
        "found": found[: given.suggestions],
        "error": error,
        "wall_s": perf_counter() - wall,
        "cpu_s": process_time() - cpu,
    }


def held(
    hand: HandModel, grasp: SuggestedGrasp, palm: str, given: Options
) -> tuple[np.ndarray, float]:
    """Which trials still hold the object ``(trials,)``, and seconds until it was first at rest."""
    start = perf_counter()
    with TemporaryDirectory() as folder:
        path = Path(folder) / "my_hand.toml"
        grasp.applied(hand.config, hand.joint_names).write(path)
        config = SceneConfig(hand=str(path), object=(grasp.object,), gravity=palm)
        own = hands.load(path)
        try:
            config.scenes(own)[0].settled  # noqa: B018 (whether it settles at all)
        except DexctlError:
            return np.zeros(given.trials, bool), perf_counter() - start
        settled = perf_counter() - start
        trace = trials(
            controllers.make("hold", own), config, given.seconds, given.trials, seed=given.seed
        )
    return trace.held[-1], settled


def measure(name: str, turned: str, given: Options) -> dict[str, Any]:
    """One row: a hand and an object."""
    hand = bare(name)
    searches = [suggested(hand, turned, given.seed + i, given) for i in range(given.searches)]
    row: dict[str, Any] = {
        "hand": name,
        "object": turned,
        "search_cpu_s": over_seeds(np.array([one["cpu_s"] for one in searches])),
        "search_wall_s": over_seeds(np.array([one["wall_s"] for one in searches])),
        "searches_that_find": share(np.array([bool(one["found"]) for one in searches])),
        "errors": [one["error"] for one in searches if one["error"]],
    }
    grasps = [grasp for one in searches for grasp in one["found"]]
    first = [one["found"][0] for one in searches if one["found"]]
    row["widths_m"] = [round(grasp.size, 4) for grasp in grasps]
    for palm in PALMS:
        hits = [held(hand, grasp, palm, given)[0] for grasp in grasps]
        row[f"palm_{palm}"] = share(np.concatenate(hits)) if hits else None
        best = [
            hit for hit, grasp in zip(hits, grasps, strict=True) if any(g is grasp for g in first)
        ]
        row[f"best_palm_{palm}"] = share(np.concatenate(best)) if best else None
    return row


def table_of(rows: list[dict[str, Any]], given: Options) -> dict[str, Any]:
    """What people read."""
    return {
        "title": f"Suggested grasps held for {given.seconds:g} s by their set-points: share of "
        f"{given.trials} trials each (95 % interval), of all {given.suggestions} of a search, and "
        "of its first",
        "header": [
            "Hand", "Object", "Search: median [s]", "All, palm up", "All, palm down",
            "First, palm up", "First, palm down",
        ],
        "rows": [line(row) for row in rows],
    }  # fmt: skip


def line(row: dict[str, Any]) -> list[str]:
    """A row for people."""
    if "missing" in row:
        return [row["hand"], row["missing"], *[""] * 5]
    shares = [row[f"{kind}palm_{palm}"] for kind, palm in product(("", "best_"), PALMS)]
    return [
        row["hand"],
        row["object"],
        f"{row['search_cpu_s']['median']:.1f}",
        *("none" if one is None else percent_interval(one) for one in shares),
    ]


def figures_of(rows: list[dict[str, Any]], given: Options) -> list[Figure]:
    """One line for each hand, over its objects."""
    out = []
    for name in dict.fromkeys(row["hand"] for row in rows if "missing" not in row):
        mine = [row for row in rows if row["hand"] == name]
        parts = []
        for palm in PALMS:
            found = [row[f"palm_{palm}"] for row in mine if row[f"palm_{palm}"]]
            count, of = (sum(one[key] for one in found) for key in ("count", "of"))
            parts.append(f"palm {palm} {count} of {of}")
        seconds = float(np.median([row["search_cpu_s"]["median"] for row in mine]))
        out.append(
            Figure(
                f"{Path(name).stem}: suggested grasps that hold for {given.seconds:g} s; seconds "
                "of one core for a search",
                f"{', '.join(parts)}; {seconds:.1f} s",
            )
        )
    return out


def main() -> None:
    given = settings(Options, __doc__)
    rows = earlier("hands", given, FIXED)
    path = given.out / "hands.json"
    runs = read(path).get("runs", []) if given.resume and path.is_file() else []
    done = {(row["hand"], row.get("object")) for row in rows}

    def save(*, say: bool) -> None:
        figures = [*figures_of_adding(runs), *figures_of(rows, given)]
        tables = [table_of_adding(runs), table_of(rows, given)]
        write(
            "hands", given, figures, tables if runs else tables[1:], say=say, commands=COMMANDS,
            trials=rows, runs=runs,
        )  # fmt: skip

    files: dict[str, Path] = {}
    for name in given.hands:
        try:
            files[name] = hands.load(name).path
        except DexctlError as error:
            progress(f"{name}: not here: {error}")
            for known in (rows, runs):  # what was measured where it was here stays
                if all(row["hand"] != name for row in known):
                    known.append({"hand": name, "missing": f"not here: {error}"})
    for seed, name in product(range(given.seed, given.seed + given.adds), files):
        ran = {(run["hand"], run.get("seed"), run.get("told")) for run in runs}
        if (name, seed, given.told) in ran:
            continue
        one = added(name, files[name], seed, given.told)
        progress(" | ".join(line_of_adding(one)))
        others = [run for run in runs if run["hand"] != name or "missing" not in run]
        runs[:] = in_order([*others, one])
        save(say=False)
    for name in files:
        for turned in given.objects:
            if (name, turned) in done:
                continue
            rows.append(measure(name, turned, given))
            progress(" | ".join(line(rows[-1])))
            save(say=False)
    save(say=True)


if __name__ == "__main__":
    main()
