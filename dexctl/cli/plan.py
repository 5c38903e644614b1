"""``dexctl plan``: grow a tree of grasps; ``plan show``: film and draw one."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from rich.console import RenderableType
from rich.progress import BarColumn, TaskID, TaskProgressColumn, TextColumn, TimeElapsedColumn
from rich.text import Text

from dexctl.cli.checks import check_count, make_folder
from dexctl.cli.interrupts import terminated_like_interrupted
from dexctl.cli.output import Bar, notes, print_json, progress, results, table, to_json
from dexctl.cli.parsing import Switch
from dexctl.cli.plan_states import Sample, States
from dexctl.cli.trials import check_viz
from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.locking import locked
from dexctl.planning import (
    Bounds,
    ControllerMacros,
    Expansion,
    FollowedEdges,
    GoalOrientations,
    Kinematic,
    Metric,
    Progress,
    RandomActions,
    Stability,
    Tree,
    grow,
    grow_in_processes,
    grow_on_cluster,
    holding,
)
from dexctl.planning.arguments import check_ends
from dexctl.planning.grow import stuck
from dexctl.planning.parts import part_files, part_seed
from dexctl.planning.scene_settings import check_used
from dexctl.settings import NESTED, Quaternion, Vector
from dexctl.sim import Scene, SceneConfig
from dexctl.sim.grasp_states import TREE
from dexctl.state import Floats
from dexctl.statistics import wilson
from dexctl.validation import check_seed, shown_numbers, unit_axis

FIGURES = "plan.json"
_SECONDS = 600.0  # a tree that is to turn so far has this long where nothing says how long [s]
_GOAL_SECONDS = 60.0  # and one towards goals [s]
_WHY = 3  # reasons of refusals that are shown, the most frequent ones
_CHECKED = 256  # nodes of a tree grown without physics that are held in simulation


@dataclass(kw_only=True)
class Plan:
    """Grow a tree of grasps that turn an object.

    Where nothing says when to stop, it stops after a full turn, ten minutes at the latest, or
    towards goal orientations when all are reached, a minute at the latest; where what was wanted is
    not reached, it fails.
    The tree in the folder is whole at any moment: after Ctrl-C or SIGTERM, --resume goes on with
    it. `dexctl plan show` films and draws it.
    """

    expand: str = "controllers"
    """How nodes are expanded: kinematic (contacts without physics: M-RRT), controllers (as actions,
    in simulation), random (changes of the set-points, in simulation: G-RRT) or followed (edges of
    a kinematic tree, carried out in simulation: verified)."""
    axis: Vector = "z"
    """Of the hand, about which the object is to be turned: x, y, z, -x, -y, -z, or x,y,z."""
    until_rotation: float | None = None
    """Stop when a node has turned this far [rad]; none: a full turn, where nothing else is said."""
    nodes: int | None = None
    """Stop at so many nodes."""
    seconds: float | None = None
    """Stop after this time [s]; none: 600 s where a rotation is wanted and no number of nodes, 60 s
    for goal orientations alone."""
    seed: int | None = None
    """Of the random numbers; none: 0, or that of the tree that is gone on with."""
    out: Path = Path("out/plan")
    """Folder for tree.npz and plan.json."""
    jobs: int | None = None
    """Processes that grow a tree each, which become one; none: one for each core, only one for
    kinematic trees, and as many as there were for those that are resumed."""
    ray: str | None = None
    """Address of a Ray cluster whose cores grow a tree each instead; --jobs says of how many."""
    resume: Switch = False
    """Go on with the tree in the folder."""
    json: Switch = False
    """Print one JSON object instead of the table."""
    kinematic: Kinematic = field(default_factory=Kinematic)
    controllers: ControllerMacros = field(default_factory=ControllerMacros)
    random: RandomActions = field(default_factory=RandomActions)
    followed: FollowedEdges = field(default_factory=FollowedEdges)
    goals: GoalOrientations = field(default_factory=GoalOrientations)
    metric: Metric = field(default_factory=Metric)
    bounds: Bounds = field(default_factory=Bounds)
    stability: Stability = field(default_factory=Stability)
    scene: Annotated[SceneConfig, NESTED] = field(default_factory=SceneConfig)

    def run(self) -> int:
        expansion, axis = self._expansion(), unit_axis(self.axis)
        if len(self.scene.object) != 1:
            raise InvalidInput(
                f"--object is {' '.join(self.scene.object)}; this command takes one object"
            )
        check_used(self.scene)
        until, seconds = self._ends()
        (scene,) = self.scene.scenes()
        folder = make_folder(self.out)
        with locked(folder), terminated_like_interrupted():
            tree = self._grown(scene, expansion, axis, folder / TREE, until, seconds)
            found = describe(tree)
            if not tree.header.physics_steps and len(tree) > 1:
                found["holds"] = self._held(scene, tree)
            away = self.goals.away(tree.nodes.object_quaternion)
            if len(away):
                found["goal_away_rad"] = away.tolist()
            self._write(found)
        if self.json:
            print_json(found)
        else:
            _print(tree, found)
        missed = self._missed(tree, until, seconds, away)
        for line in missed:
            notes().print(line, soft_wrap=True)
        return int(bool(missed))

    def _ends(self) -> tuple[float | None, float | None]:
        """After which rotation [rad] and time [s] it stops, also where nobody said."""
        until, seconds = self.until_rotation, self.seconds
        if self.nodes is None and seconds is None:
            goals_alone = len(self.goals) and until is None
            seconds = _GOAL_SECONDS if goals_alone else _SECONDS
            if not goals_alone and until is None:
                until = 2 * math.pi
        return until, seconds

    def _grown(
        self,
        scene: Scene,
        expansion: Expansion,
        axis: tuple[float, float, float],
        path: Path,
        until: float | None,
        seconds: float | None,
    ) -> Tree:
        """The tree, as it is in the file ``path``."""
        before, jobs = self._tree(path), self._jobs()
        ends: dict[str, Any] = {
            "nodes": self.nodes, "seconds": seconds, "until_rotation": until, "axis": axis,
            "seed": self._seed(path, before), "metric": self.metric, "bounds": self.bounds,
            "stability": self.stability, "goals": self.goals, "path": path,
        }  # fmt: skip
        check_ends(self.nodes, seconds, until, self.bounds, self.goals)
        expansion.check(scene, np.array(axis))
        try:
            with _Bar(self.nodes, seconds, until) as show:
                if self.ray is not None:
                    return grow_on_cluster(
                        self.scene, expansion, self.ray, jobs, progress=show, resume=self.resume,
                        **ends,
                    )  # fmt: skip
                if jobs == 1 and not (self.resume and part_files(path)):
                    return grow(
                        scene, expansion, threads=self.scene.threads, tree=before,
                        scene_config=self.scene, progress=show, **ends,
                    )  # fmt: skip
                return grow_in_processes(
                    self.scene, expansion, jobs or 1, progress=show, resume=self.resume, **ends
                )
        except KeyboardInterrupt:
            there = path.exists() or part_files(path)
            raise KeyboardInterrupt(
                f"interrupted; the tree is in {path}, and the same command with --resume goes on"
                if there
                else "interrupted before there was a tree"
            ) from None

    def _missed(
        self, tree: Tree, until: float | None, seconds: float | None, away: Floats
    ) -> list[str]:
        """What was wanted of the tree and is not there, a line each."""
        if len(tree) == 1 and self.nodes != 1:
            return [stuck(tree)]
        found = [
            f"goal {shown_numbers(goal)} is not reached: the nearest of {len(tree)} nodes is "
            f"{far:.2f} rad from it"
            for goal, far in zip(self.goals.orientations, away, strict=True)
            if far > self.goals.angle
        ]
        if len(away) and not found:
            return []
        turned = float(tree.rotation.max())
        if until is not None and turned < until:
            within = "" if seconds is None else f" in {seconds:g} s"
            found.append(
                f"--until-rotation {until:.2f} is not reached{within}: the greatest rotation of "
                f"{len(tree)} nodes is {turned:.2f} rad; expected other settings, or --resume and "
                "more --seconds"
            )
        elif until is None and not found and self.nodes is not None and len(tree) < self.nodes:
            found.append(f"--nodes {self.nodes} is not reached: there are {len(tree)}")
        return found

    def _expansion(self) -> Expansion:
        known: dict[str, Expansion] = {
            "kinematic": self.kinematic,
            "controllers": self.controllers,
            "random": self.random,
            "followed": self.followed,
        }
        if self.expand not in known:
            raise UnknownName("--expand", self.expand, known)
        return known[self.expand]

    def _jobs(self) -> int | None:
        """Trees that are grown at a time; None: as many as a cluster has cores."""
        if self.resume:
            parts = part_files(self.out.expanduser() / TREE)
            if self.ray is not None and not parts:
                raise InvalidInput(
                    f"--ray is {self.ray}; the tree in {self.out} is of one process, which goes on "
                    "without it"
                )
            before = len(parts) or 1
            if self.jobs not in (None, before):
                raise InvalidInput(
                    f"--jobs is {self.jobs}; the tree in {self.out} is of {before} processes"
                )
            return before
        if self.jobs is not None:
            return check_count("--jobs", self.jobs)
        if self.ray is not None:
            return None
        one = self.expand == "kinematic" or self.scene.threads is not None
        if one:
            return 1
        from dexctl.report.machine import usable_cores

        return usable_cores()

    def _seed(self, path: Path, before: Tree | None) -> int:
        """Of the random numbers of a new tree, or of the one that is gone on with."""
        parts = enumerate(part_files(path) if self.resume else ())
        known = {i: Tree.load(part).header.seed for i, part in parts if part.exists()}
        if before is not None:
            known = {0: before.header.seed}
        elif known and 0 not in known and path.exists():
            known[0] = Tree.load(path).header.seed
        if self.seed is None:
            return known.get(0, 0)
        seed = check_seed(self.seed, 0)
        if any(part_seed(seed, i) != own for i, own in known.items()):
            raise InvalidInput(
                f"--seed is {seed}; the tree in {self.out} was grown with "
                f"{known.get(0, 'another one')}, expected the same to go on with it"
            )
        return seed

    def _held(self, scene: Scene, tree: Tree) -> dict[str, Any]:
        """How many of a tree grown without physics hold in simulation, of a sample."""
        rng = np.random.default_rng(tree.header.seed)
        rows = rng.choice(len(tree), min(_CHECKED, len(tree)), replace=False)
        held = holding(scene, tree, rows, threads=self.scene.threads)
        found = wilson(int(held.sum()), len(held))
        return {"of": len(held), "share": found.value, "wilson95": [found.low, found.high]}

    def _tree(self, path: Path) -> Tree | None:
        if not self.resume:
            if path.exists():
                raise InvalidInput(
                    f"{path} is there already; expected --resume, which goes on with it, or "
                    "another --out"
                )
            parts = part_files(path)
            if parts:
                raise InvalidInput(
                    f"{path.parent} has the trees of {len(parts)} processes of a run that was "
                    "killed; expected --resume, which goes on with them, or another --out"
                )
            return None
        if not (path.exists() or part_files(path)):
            raise InvalidInput(
                f"{path.parent} has no tree to go on with; expected --out of one that was begun, "
                "or the command without --resume"
            )
        # a merged tree is made of those of its processes, which go on
        return None if part_files(path) else Tree.load(path)

    def _write(self, found: dict[str, Any]) -> None:
        from dexctl.files import write_text
        from dexctl.report.machine import machine

        path = self.out.expanduser() / FIGURES
        write_text(path, to_json({**found, "machine": machine()}) + "\n")
        notes().print(f"written: {path.with_name(TREE)} and {path}")


@dataclass(kw_only=True)
class Show:
    """Film the best path of a tree, and draw the tree, its growth and the path's contacts.

    Writes path.mp4 and tree.png into the folder.
    """

    tree: tyro.conf.Positional[Path]
    """The file, or the folder that it is in."""
    out: Path | None = None
    """Folder for the film and the picture; none: where the tree is."""
    goal: Quaternion | None = None
    """Orientation, wxyz, to which the path gets nearest; none: the greatest rotation."""
    json: Switch = False
    """Print one JSON object."""

    def run(self) -> int:
        check_viz("dexctl plan show")
        source = self.tree.expanduser()
        tree = Tree.load(source)
        scene = tree.build_scene()
        folder = make_folder(self.out or (source if source.is_dir() else source.parent))
        found = describe(tree)
        (path,) = tree.paths(1, goal_quaternion=self.goal)
        found["path"] = path.tolist()
        from dexctl.report.tree import draw, film

        (folder / "tree.png").write_bytes(draw(tree, path))
        written = [folder / "tree.png"]
        with progress(notes()) as bar:
            task = bar.add_task("drawing the best path", total=len(path))
            film(scene, tree, path, folder / "path.mp4",
                 lambda done: bar.update(task, completed=done))  # fmt: skip
        written.append(folder / "path.mp4")
        notes().print(f"written: {' and '.join(map(str, written))}")
        if self.json:
            print_json(found)
        else:
            _print(tree, found)
        return 0


COMMANDS = {"": Plan, "show": Show, "states": States, "sample": Sample}


def describe(tree: Tree) -> dict[str, Any]:
    """For JSON: what a tree is of and what came of growing it."""
    header = tree.header
    tried = max(len(tree) - 1 + sum(header.refused.values()), 1)
    return {
        "command": "plan",
        **header.to_plain(),
        "nodes": len(tree),
        "rotation_rad": float(tree.rotation.max()),
        "accepted": (len(tree) - 1) / tried,
        "nodes_per_second": len(tree) / header.seconds if header.seconds else None,
    }


def _print(tree: Tree, found: dict[str, Any]) -> None:
    header, shown = tree.header, table()
    path = tree.path_to(int(tree.rotation.argmax()))
    refused = ", ".join(f"{why} {count}" for why, count in sorted(header.refused.items()))
    rate = found["nodes_per_second"]
    for what, value in (
        ("greatest rotation", f"{found['rotation_rad']:.2f} rad, by {len(path) - 1} actions"),
        ("nodes", f"{len(tree)} of {header.expansions} expansions"),
        ("accepted", f"{100 * found['accepted']:.0f} % of candidates"),
        ("refused", refused or "none"),
        ("time", f"{header.seconds:.1f} s, {rate or math.nan:.0f} nodes/s"),
        ("physics steps", f"{header.physics_steps}"),
    ):
        shown.add_row(what, value)
    if "goal_away_rad" in found:
        left = ", ".join(f"{far:.2f}" for far in found["goal_away_rad"])
        shown.add_row("nearest to goals", f"{left} rad")
    if "holds" in found:
        part, (low, high) = found["holds"], found["holds"]["wilson95"]
        shown.add_row(
            "hold in simulation",
            f"{100 * part['share']:.0f} % ({100 * low:.0f} to {100 * high:.0f}) of {part['of']}",
        )
    title = f"{header.hand} turns a {header.object}, {header.expansion}\n"
    results().print(title, style="bold")
    results().print(shown)


def time_left(now: Progress, nodes: int | None, seconds: float | None) -> str:
    """How long it will take: nodes come at a pace; how soon the rotation does, nobody knows.

    Args:
        now: how far it is.
        nodes, seconds: that it is to have, and to take; None: no end by them.
    """
    ends, grown = [], now.nodes - now.first
    if nodes is not None and grown > 0:
        ends.append(f"about {max(nodes - now.nodes, 0) * now.seconds / grown:.0f} s more")
    if seconds is not None:
        ends.append(f"at most {max(seconds - now.seconds, 0.0):.0f} s more")
    return ", ".join(ends)


class _Bar:
    """What is shown while a tree grows: what has come of it, time left, and what is refused."""

    def __init__(self, nodes: int | None, seconds: float | None, until: float | None) -> None:
        self._ends = nodes, seconds, until
        self._bar = _Noted(
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=20),
            TaskProgressColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.fields[left]}", markup=False),
            console=notes(),
        )
        self._task: TaskID | None = None

    def __enter__(self) -> _Bar:
        self._bar.start()
        return self

    def __exit__(self, *error: Any) -> None:
        self._bar.__exit__(*error)

    def __call__(self, now: Progress) -> None:
        nodes, seconds, until = self._ends
        done = [
            value / end
            for value, end in zip(
                (now.nodes, now.seconds, max(now.rotation, 0.0)), self._ends, strict=True
            )
            if end
        ]
        rate = (now.nodes - now.first) / max(now.seconds, 1e-9)
        if self._task is None:
            self._task = self._bar.add_task("", total=1.0, left="")
        self._bar.note = refusals(now)
        left = time_left(now, nodes, seconds)
        wanted = "" if until is None else f" of {until:.2f}"
        of = "" if nodes is None else f" of {nodes}"
        self._bar.update(
            self._task,
            completed=max(done, default=0.0),
            description=f"{now.nodes}{of} nodes, {rate:.0f}/s, {now.rotation:.2f}{wanted} rad",
            left=left,
        )


class _Noted(Bar):
    """A progress bar with a line below it."""

    note = ""

    def get_renderables(self) -> Iterator[RenderableType]:
        yield self.make_tasks_table(self.tasks)
        if self.note:
            yield Text(self.note)


def refusals(now: Progress) -> str:
    """Which share of the candidates is accepted, and why most of the others are not."""
    accepted = max(now.nodes - 1, 0)  # not even the root is there at first
    tried = accepted + sum(now.refused.values())
    most = sorted(((n, why) for why, n in now.refused.items() if n), reverse=True)[:_WHY]
    if not tried:
        return ""
    said = f"{100 * accepted / tried:.0f} % of the candidates accepted"
    shares = ", ".join(f"{why} {100 * n / tried:.0f} %" for n, why in most)
    return said + (shares and f"; refused for {shares}")
