"""Trees of grasps: how soon they turn an object all the way round, and what that costs.

Times are seconds of the processor, with one thread, so that other work on the machine counts
little. Each part can be measured by itself and adds its rows to the result; with --parts and no
name nothing is measured, and the picture is drawn of the rows that are there.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import Any

import numpy as np
from measuring.results import Figure, read, write
from measuring.settings import Settings, check_chosen, progress, settings
from measuring.shares import share
from measuring.trials import FULL_TURN, PALMS
from scipy.stats import mannwhitneyu

from dexctl.exceptions import InvalidInput
from dexctl.files import aside
from dexctl.planning import (
    ControllerMacros,
    Expansion,
    FollowedEdges,
    GraspSampling,
    Kinematic,
    PlannedGait,
    Progress,
    RandomActions,
    Stability,
    Tree,
    grow,
    holding,
    sample_grasps,
)
from dexctl.report.style import drawing, finger_colour, new_figure
from dexctl.sim import Scene, SceneConfig, Simulation, run
from dexctl.statistics import bootstrap, wilson

PARTS = (
    "kinematic", "large", "controllers", "random", "literal", "ablations", "sampling", "following",
    "verified",
)  # fmt: skip
EASY = ("cylinder", "cube")
HARD = ("l_shape", "u_shape")


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    parts: tuple[str, ...] = PARTS
    """Which parts are measured."""
    seeds: int = 10
    """Of kinematic trees."""
    slow_seeds: int = 5
    """Of trees in simulation."""
    objects: tuple[str, ...] = (*EASY, *HARD)
    """Of kinematic trees."""
    hard: tuple[str, ...] = HARD
    """Of trees in simulation."""
    limit: float = 120.0
    """Longest time of a tree [s]."""
    large: int = 100_000
    """Nodes of the large kinematic tree."""
    short: float = 20.0
    """Time of each of the literal loop, the ablations and the sampling [s]."""
    literal_actions: tuple[int, ...] = (1, 4, 16)
    """K_max of the literal loop: candidates that it holds to the end, one and all."""
    steps: int = 1_000_000
    """Physics steps of each tree where controllers and random actions are compared."""
    trials: int = 64
    """Of each gait that follows a tree."""
    palms: tuple[str, ...] = PALMS
    """Of trees that are followed."""
    follow_seconds: float = 75.0
    """Simulated time of those trials [s]."""
    checked: int = 512
    """Nodes of the large tree that are held in simulation."""
    picture: Path | None = (
        Path(__file__).resolve().parents[1] / "docs" / "images" / "plan-ablation.png"
    )
    """Where the ablations are drawn; None: nowhere."""


class Stop(Exception):
    """The time is up."""


def grown(
    scene: Scene,
    expansion: Expansion,
    seed: int,
    limit: float,
    stability: Stability | None = None,
    until: float = np.inf,
    nodes: int | None = None,
    steps: float = np.inf,
) -> dict[str, Any]:
    """A tree until it turned so far, has so many nodes, or took so long or so many steps."""
    start, history = process_time(), []

    def watch(now: Progress) -> None:
        here = process_time() - start, now.expansions, now.nodes, now.physics_steps, now.rotation
        history.append(here)
        if here[0] > limit or now.physics_steps >= steps:
            raise Stop

    end: dict[str, Any] = {"until_rotation": until} if np.isfinite(until) else {"seconds": 1e6}
    tree = None
    with suppress(Stop):
        tree = grow(
            scene, expansion, seed=seed, threads=1, stability=stability, nodes=nodes,
            progress=watch, **end,
        )  # fmt: skip
    kept = np.unique(np.linspace(0, len(history) - 1, 40).astype(int))
    names = "cpu_s", "expansions", "nodes", "physics_steps", "rotation_rad"
    return {
        "tree": tree,
        "seed": seed,
        **dict(zip(names, history[-1], strict=True)),
        "history": [[round(float(value), 3) for value in history[i]] for i in kept],
    }


def row(part: str, scene: Scene, found: dict[str, Any], **more: Any) -> dict[str, Any]:
    """A row of the result."""
    palm = "up" if scene.gravity[2] < 0 else "down"
    kept = {name: value for name, value in found.items() if name != "tree"}
    progress(
        f"{part} {scene.object} {palm} {more} seed {found.get('seed')}: "
        f"{found.get('rotation_rad', 0):.2f} rad, {found['cpu_s']:.1f} s"
    )
    return {"part": part, "object": scene.object, "palm": palm, **more, **kept}


def kinematic(given: Options) -> list[dict[str, Any]]:
    """Kinematic trees to a full turn."""
    rows = []
    for name, palm in product(given.objects, ("up", "down")):
        scene = Scene.build("dex5", name, palm)
        for seed in range(given.seed, given.seed + given.seeds):
            found = grown(scene, Kinematic(), seed, given.limit, until=FULL_TURN)
            rows.append(row("kinematic", scene, found))
    return rows


def large(given: Options) -> list[dict[str, Any]]:
    """One large kinematic tree on L, and how many of its nodes hold."""
    scene = Scene.build("dex5", "l_shape", "up")
    found = grown(scene, Kinematic(), given.seed, 1e6, nodes=given.large)
    tree = found["tree"]
    rng = np.random.default_rng(given.seed)
    rows = rng.choice(len(tree), min(given.checked, len(tree)), replace=False)
    held = share(holding(scene, tree, rows, threads=1))
    return [row("large", scene, found, holding=held)]


def controllers(given: Options) -> list[dict[str, Any]]:
    """Trees with controllers as actions, to a full turn."""
    rows = []
    for name, palm in product(given.hard, ("up", "down")):
        scene = Scene.build("dex5", name, palm)
        for seed in range(given.seed, given.seed + given.slow_seeds):
            found = grown(scene, ControllerMacros(), seed, given.limit, until=FULL_TURN)
            rows.append(row("controllers", scene, found))
    return rows


def random(given: Options) -> list[dict[str, Any]]:
    """Controllers and random actions on L for equal physics steps, equal numbers of candidates."""
    scene, rows = Scene.build("dex5", "l_shape", "up"), []
    k = ControllerMacros().candidates
    for seed in range(given.seed, given.seed + given.slow_seeds):
        for expansion in (ControllerMacros(), RandomActions(actions=k)):
            found = grown(scene, expansion, seed, 1e6, steps=given.steps)
            rows.append(row("random", scene, found, expansion=type(expansion).__name__))
    return rows


def literal(given: Options) -> list[dict[str, Any]]:
    """Nodes a second of the thesis's loop, of the same one in batches and lazily, and of ours."""
    scene, rows = Scene.build("dex5", "cylinder", "up"), []
    thesis, stable = Stability.thesis(), Stability()
    for actions in given.literal_actions:
        ours = RandomActions(actions=actions)
        every = replace(RandomActions.thesis(), actions=actions)
        for name, expansion, stability in (
            ("literal", replace(every, batch=1), thesis),  # it expands one node at a time
            ("batched", every, thesis),
            ("lazy", ours, thesis),
            ("ours", ours, stable),
        ):
            found = grown(scene, expansion, given.seed, given.short, stability)
            found["nodes_per_s"] = found["nodes"] / found["cpu_s"]
            rows.append(row("literal", scene, found, loop=name, actions=actions))
    return rows


def ablations(given: Options) -> list[dict[str, Any]]:
    """Rotation against expansions for K_max and alpha (the thesis's two ablations)."""
    scene, rows = Scene.build("dex5", "cylinder", "up"), []
    usual = RandomActions()
    varied = [{"actions": actions} for actions in (1, 4, 16)]
    varied += [{"scale": scale} for scale in (0.05, 0.1, 0.2, 0.3)]
    for changes, seed in product(varied, range(given.seed, given.seed + given.slow_seeds)):
        expansion = replace(usual, batch=16, **changes)
        found = grown(scene, expansion, seed, given.short)
        about = {"actions": expansion.actions, "scale": expansion.scale}
        rows.append(row("ablations", scene, found, **about))
    return rows


def ablation_table(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """What K_max and alpha are worth, over the seeds, beside the usual ones."""
    usual, lines = RandomActions(), []

    def turned(actions: int, scale: float) -> list[float]:
        return [r["rotation_rad"] for r in rows if (r["actions"], r["scale"]) == (actions, scale)]

    for actions, scale in sorted({(r["actions"], r["scale"]) for r in rows}):
        some = [r for r in rows if (r["actions"], r["scale"]) == (actions, scale)]
        mine, theirs = turned(actions, scale), turned(usual.actions, usual.scale)
        middle = bootstrap(mine, "median")
        alike = (actions, scale) == (usual.actions, usual.scale) or not theirs
        chance = 1.0 if alike else float(mannwhitneyu(mine, theirs).pvalue)
        lines.append(
            [
                f"{actions}",
                f"{scale:g}",
                f"{middle.value:.1f} ({middle.low:.1f}-{middle.high:.1f})",
                f"{min(mine):.1f}-{max(mine):.1f}",
                "" if alike else f"{chance:.2g}",
                f"{np.median([r['nodes'] for r in some]):.0f}",
                f"{np.median([r['expansions'] for r in some]):.0f}",
            ]
        )
    seeds = len({r["seed"] for r in rows})
    seconds = min(r["cpu_s"] for r in rows)  # rows may be of an earlier run, with other settings
    return {
        "title": f"Random actions on the cylinder, palm up, {seconds:.0f} s of one processor, "
        f"{seeds} seeds: what candidates and their size are worth (thesis: K_max, alpha)",
        "header": [
            "K_max",
            "alpha [rad]",
            "rotation [rad]: median (95 % interval)",
            "range",
            f"p against {usual.actions} and {usual.scale:g} (Mann and Whitney)",
            "nodes",
            "expansions",
        ],
        "rows": lines,
    }


def so_far(row: dict[str, Any], column: int, grid: np.ndarray) -> np.ndarray:
    """The rotation that a tree had reached at each value of a column of its history."""
    history = np.array(row["history"])
    place = np.searchsorted(history[:, column], grid, side="right") - 1
    found = np.where(place >= 0, history[np.maximum(place, 0), 4], 0.0)
    return np.where(grid <= history[-1, column], found, np.nan)


def draw(path: Path, rows: list[dict[str, Any]]) -> None:
    """Rotation by expansions and by time, for each K_max and each alpha: medians and ranges.

    A line ends where the first of its seeds does.
    """
    usual = RandomActions()
    with drawing():
        figure = new_figure(8.0, 5.4)
        axes = figure.subplots(2, 2, sharey=True)
        for panels, (name, title, fixed) in zip(
            axes, (("actions", "K_max", "scale"), ("scale", "alpha [rad]", "actions")), strict=True
        ):
            some = [row for row in rows if row[fixed] == getattr(usual, fixed)]
            for i, value in enumerate(sorted({row[name] for row in some})):
                own = [row for row in some if row[name] == value]
                for panel, column in zip(panels, (1, 0), strict=True):
                    ends = [row["history"][-1][column] for row in own]
                    grid = np.geomspace(min(r["history"][0][column] for r in own), min(ends), 300)
                    turned = np.array([so_far(row, column, grid) for row in own])
                    panel.plot(
                        grid, np.median(turned, axis=0), color=finger_colour(i), label=f"{value:g}"
                    )
                    panel.fill_between(
                        grid, turned.min(axis=0), turned.max(axis=0), color=finger_colour(i),
                        alpha=0.12, lw=0,
                    )  # fmt: skip
            panels[0].set(
                xscale="log", xlabel="expansions", ylabel="rotation [rad]", ylim=(0, None)
            )
            panels[1].set(xscale="log", xlabel="processor time [s]")
            panels[0].legend(title=title, loc="upper left", title_fontsize=8.5)
        with aside(path) as part:
            figure.savefig(part)


def sampling(given: Options) -> list[dict[str, Any]]:
    """Sampled grasps a second, from fingertips round the object and from random joints."""
    rows = []
    for name in ("cube", "l_shape"):
        scene = Scene.build("dex5", name, "up")
        for place in ("fingertips", "joints"):
            start, many = process_time(), round(100 * given.short)
            try:
                found = sample_grasps(
                    scene, 10**6, GraspSampling(place=place), seed=given.seed, threads=1,
                    most_tried=many,
                )  # fmt: skip
                kept, tried = len(found.nodes), found.tried
            except InvalidInput:
                kept, tried = 0, many
            cpu = process_time() - start
            counted = {"seed": given.seed, "cpu_s": cpu, "tried": tried, "kept": kept}
            rows.append(row("sampling", scene, {**counted, "per_s": kept / cpu}, place=place))
    return rows


def followed(part: str, scene: Scene, tree: Tree, seed: int, given: Options) -> dict[str, Any]:
    """Trials of a gait that follows a tree; their seeds are none that anything was chosen by."""
    palm = "up" if scene.gravity[2] < 0 else "down"
    config = SceneConfig(object=(scene.object,), gravity=palm, threads=1)
    gait, start = PlannedGait(scene.hand, tree), process_time()
    first = 1000 + given.seed
    with Simulation(config, given.trials, first, hand=scene.hand) as sim:
        sim.reset(first)
        gait.reset(first)
        trace = run(gait, sim, given.follow_seconds)
    turned = trace.final_rotation
    found = {
        "seed": seed, "nodes": len(tree), "cpu_s": process_time() - start,
        "rotation_rad": float(np.median(turned)),
        "rotations_rad": np.round(np.sort(turned), 2).tolist(),
        "full_turn": share(turned >= FULL_TURN), "dropped": share(trace.dropped),
        "tree_rotation_rad": float(tree.rotation.max()), "seconds": given.follow_seconds,
    }  # fmt: skip
    return row(part, scene, found)


def following(given: Options) -> list[dict[str, Any]]:
    """A gait that follows kinematic trees, closed loop."""
    rows = []
    for name, palm in product(given.hard, given.palms):
        scene = Scene.build("dex5", name, palm)
        tree = grown(scene, Kinematic(), given.seed, given.limit, until=FULL_TURN)["tree"]
        rows.append(followed("following", scene, tree, given.seed, given))
    return rows


def verified(given: Options) -> list[dict[str, Any]]:
    """The same after the trees' edges have been carried out by controllers."""
    rows = []
    for name, palm in product(given.hard, given.palms):
        scene = Scene.build("dex5", name, palm)
        with TemporaryDirectory() as folder:
            path = Path(folder) / "tree.npz"
            tree = grown(scene, Kinematic(), given.seed, given.limit, until=FULL_TURN)["tree"]
            tree.save(path)
            again = grow(
                scene, FollowedEdges(tree=path), until_rotation=FULL_TURN, seconds=given.limit,
                seed=given.seed, threads=1,
            )  # fmt: skip
        rows.append(followed("verified", scene, again, given.seed, given))
    return rows


MEASURE: dict[str, Callable[[Options], list[dict[str, Any]]]] = {
    "kinematic": kinematic,
    "large": large,
    "controllers": controllers,
    "random": random,
    "literal": literal,
    "ablations": ablations,
    "sampling": sampling,
    "following": following,
    "verified": verified,
}


def figures(rows: list[dict[str, Any]], given: Options) -> list[Figure]:
    """Lines of the table."""
    found: list[Figure] = []
    of = {part: [r for r in rows if r["part"] == part] for part in PARTS}
    for part, goals in (
        ("kinematic", {"up": 5.0, "down": 5.0}),
        ("controllers", {"up": 60.0, "down": 120.0}),
    ):
        for name, palm in dict.fromkeys((r["object"], r["palm"]) for r in of[part]):
            some = [r for r in of[part] if (r["object"], r["palm"]) == (name, palm)]
            full = [r for r in some if r["rotation_rad"] >= FULL_TURN]
            intime = sum(r["cpu_s"] <= goals[palm] for r in full)
            median = np.median([r["cpu_s"] if r in full else np.inf for r in some])
            turned = np.median([r["rotation_rad"] for r in some])
            measured = f"{len(full)} of {len(some)} seeds, {intime} within {goals[palm]:g} s; "
            measured += (
                f"median {median:.1f} s" if np.isfinite(median) else f"median {turned:.1f} rad"
            )
            if part == "controllers":  # seconds are the machine's, physics steps are not
                steps = np.median([r["physics_steps"] for r in some])
                measured += f", {steps / 1e6:.2f} million physics steps"
            found.append(
                Figure(
                    f"{part} tree turns the {name} by 2 pi, palm {palm}",
                    measured,
                    f"all seeds within {goals[palm]:g} s",
                    intime == len(some),
                )
            )
    for r in of["large"]:
        held = r["holding"]
        good = r["cpu_s"] <= 40 and held["share"] >= 0.97
        found.append(
            Figure(
                f"kinematic tree of {r['nodes']} nodes on L: time, and nodes that hold for 2 s",
                f"{r['cpu_s']:.0f} s; {held['count']} of {held['of']}",
                "40 s, 97 %",
                bool(good) if r["nodes"] >= 100_000 else None,
            )
        )
    if of["random"]:
        by = {
            kind: np.array([r["rotation_rad"] for r in of["random"] if r["expansion"] == kind])
            for kind in ("ControllerMacros", "RandomActions")
        }
        ratio = np.median(by["ControllerMacros"]) / np.median(by["RandomActions"])
        found.append(
            Figure(
                "controllers against random actions on L, equal physics steps: rotation",
                f"{np.median(by['ControllerMacros']):.2f} against "
                f"{np.median(by['RandomActions']):.2f} rad, {ratio:.2f} times, "
                f"{len(by['RandomActions'])} seeds",
                "1.5 times",
                bool(ratio >= 1.5),
            )
        )
    for actions in sorted({r["actions"] for r in of["literal"]}):
        rate = {r["loop"]: r["nodes_per_s"] for r in of["literal"] if r["actions"] == actions}
        times = rate["ours"] / max(rate["literal"], 1e-9)
        found.append(
            Figure(
                f"random actions, nodes a second: ours against the literal loop, K_max {actions}",
                f"{rate['ours']:.1f} against {rate['literal']:.2f}, {times:.1f} times; the "
                f"thesis's loop {RandomActions().batch} nodes at a time {rate['batched']:.1f}, "
                f"lazily {rate['lazy']:.1f}",
                "10 times (floor: 5)",
                bool(times >= 10),
            )
        )
    for r in (*of["following"], *of["verified"]):
        turn, dropped = r["full_turn"], r["dropped"]
        kind = "a verified" if r["part"] == "verified" else "a kinematic"
        target = (r["object"], r["palm"]) == ("l_shape", "up")
        found.append(
            Figure(
                f"gait that follows {kind} tree, {r['object']}, palm {r['palm']}: 2 pi in "
                f"{r['seconds']:g} s before a drop",
                f"{turn['count']} of {turn['of']}, median {r['rotation_rad']:.1f} rad; dropped "
                f"{dropped['count']}",
                "half of them" if target else "",
                bool(turn["share"] >= 0.5) if target else None,
            )
        )
    for name in dict.fromkeys(r["object"] for r in of["sampling"]):
        a, b = (
            next(r for r in of["sampling"] if r["object"] == name and r["place"] == place)
            for place in ("fingertips", "joints")
        )
        low, high = (wilson(r["kept"], r["tried"]).value for r in (b, a))
        found.append(
            Figure(
                f"sampled grasps of the {name}: share of what is tried, and a second",
                f"{100 * high:.0f} %, {a['per_s']:.0f}/s; from random joints {100 * low:.1f} %, "
                f"{b['per_s']:.1f}/s",
            )
        )
    return found


def main() -> None:
    given = settings(Options, __doc__)
    check_chosen("part", given.parts, PARTS)
    path = given.out / "planning.json"
    rows: list[dict[str, Any]] = []
    if path.is_file():  # the parts that are not measured anew stay
        rows = [r for r in read(path)["trials"] if r["part"] not in given.parts]
    for part in PARTS:
        if part not in given.parts:
            continue
        rows += MEASURE[part](given)
        some = [r for r in rows if r["part"] == "ablations"]
        tables = [ablation_table(some)] if some else []
        last = part == given.parts[-1]
        write("planning", given, figures(rows, given), tables, say=last, trials=rows)
    some = [r for r in rows if r["part"] == "ablations"]
    if given.picture is not None and some:
        draw(given.picture, some)


if __name__ == "__main__":
    main()
