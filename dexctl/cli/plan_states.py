"""``dexctl plan states`` and ``sample``: files of grasps that episodes start from."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from dexctl.cli.checks import check_count
from dexctl.cli.interrupts import terminated_like_interrupted
from dexctl.cli.output import notes, print_json, progress, results
from dexctl.cli.parsing import Switch
from dexctl.exceptions import InvalidInput
from dexctl.files import make_parent
from dexctl.planning import GraspSampling, Stability, Tree, path_states, sample_grasps
from dexctl.planning.scene_settings import check_used
from dexctl.planning.starts import Goals, Weights
from dexctl.settings import NESTED, Vector
from dexctl.sim import SceneConfig
from dexctl.sim.grasp_states import GraspStates
from dexctl.validation import unit_axis


@dataclass(kw_only=True)
class States:
    """Take the grasps of a tree's paths, for episodes to start from.

    They go into a file for --initial-states (rotate, evaluate, check-grasp) and
    --env.initial-states (train). Those that do not hold for 2 s are left out.
    """

    tree: tyro.conf.Positional[Path]
    """The file, or the folder that it is in."""
    out: Path = Path("out/starts.npz")
    """The file to be written."""
    count: int = 20_000
    """How many; a tree may have fewer."""
    goals: Goals = "greatest"
    """Where the paths lead: greatest rotations first, or even, any rotation."""
    weights: Weights = "rotation"
    """How likely each is drawn: rotation makes every rotation alike, equal every state."""
    seed: int = 0
    """Of the even goals."""
    threads: int | None = None
    """How many threads step the physics; none: every core."""
    json: Switch = False
    """Print one JSON object."""

    def run(self) -> int:
        check_count("--count", self.count)
        path = make_parent(self.out, "--out")
        tree = Tree.load(self.tree)
        states = path_states(
            tree, self.count, goals=self.goals, weights=self.weights,
            scene=tree.build_scene(), threads=self.threads, seed=self.seed,
        )  # fmt: skip
        states.save(path)
        return _said(states, path, self.json, {"command": "plan states"})


@dataclass(kw_only=True)
class Sample:
    """Sample grasps all over an object that hold, without a tree (stable-grasp sampling).

    They go into a file as those of `dexctl plan states` do.
    """

    count: int = 1000
    """How many distinct ones are wanted."""
    axis: Vector = "z"
    """About which the object lies any way round: x, y, z, -x, -y, -z, or x,y,z."""
    seed: int = 0
    """Of the random numbers."""
    out: Path = Path("out/grasps.npz")
    """The file to be written."""
    json: Switch = False
    """Print one JSON object."""
    sampling: GraspSampling = field(default_factory=GraspSampling)
    stability: Stability = field(default_factory=Stability)
    scene: Annotated[SceneConfig, NESTED] = field(default_factory=SceneConfig)

    def run(self) -> int:
        check_count("--count", self.count)
        if len(self.scene.object) != 1:
            raise InvalidInput(
                f"--object is {' '.join(self.scene.object)}; this command takes one object"
            )
        check_used(self.scene)
        (scene,) = self.scene.scenes()
        path, so_far = make_parent(self.out, "--out"), 0
        with progress(notes()) as bar:
            task = bar.add_task("grasps", total=self.count)

            def show(now: int) -> None:
                nonlocal so_far
                so_far = now
                bar.update(task, completed=now)

            try:
                with terminated_like_interrupted():
                    found = sample_grasps(
                        scene, self.count, self.sampling, axis=unit_axis(self.axis),
                        seed=self.seed, stability=self.stability, threads=self.scene.threads,
                        scene_config=self.scene, path=path, progress=show,
                    )  # fmt: skip
            except KeyboardInterrupt:
                raise KeyboardInterrupt(
                    f"interrupted; {so_far} of {self.count} grasps are in {path}"
                    if so_far
                    else "interrupted before a grasp was found"
                ) from None
        about = {"command": "plan sample", "tried": found.tried, "refused": found.refused}
        return _said(found.states, path, self.json, about)


def _said(states: GraspStates, path: Path, as_json: bool, about: dict[str, Any]) -> int:
    if as_json:
        print_json({**about, "states": len(states), "file": str(path)})
    else:
        results().print(f"{len(states)} grasps in {path}", soft_wrap=True)
    return 0
