"""PlannedStarts: sampled grasps, or the paths of a tree, made before the training."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

from dexctl.exceptions import InvalidInput
from dexctl.planning import grow, path_states, sample_grasps
from dexctl.planning.scene_settings import used_of
from dexctl.sim import Scene, SceneConfig
from dexctl.sim.grasp_states import GraspStates
from learning.envs.vector import ManipulationVectorEnv
from learning.starts.base import Remark, Starts
from learning.starts.config import StartsConfig

if TYPE_CHECKING:
    from learning.config import TrainConfig

PLANNED = ("grasps", "paths")
"""Names of the starts that are planned before a training."""


def planned_alike(one: TrainConfig, other: TrainConfig) -> bool:
    """Whether two trainings on the same hand would plan the same states to start from."""
    return one.starts.start_from in PLANNED and _plan(one) == _plan(other)


def _plan(config: TrainConfig) -> tuple[Any, ...]:
    """All that decides them: neither what is sensed nor what is drawn for an episode does."""
    plain, starts, scene = SceneConfig(), StartsConfig(), config.env.scene
    scene = replace(
        scene,
        sensing=plain.sensing,
        push=plain.push,
        limits=plain.limits,
        randomisation=plain.randomisation,
        disturbance=plain.disturbance,
        threads=plain.threads,
    )
    starts = replace(
        config.starts,
        explored_share=starts.explored_share,
        gravity_steps=starts.gravity_steps,
    )
    return scene, starts, config.seed, tuple(config.env.task.direction)


class PlannedStarts(Starts):
    """Episodes begin in grasps that were planned for the objects of the environments.

    Args:
        env: the environments.
        config: the settings.
        seed: of trees and samples.
    """

    def __init__(self, env: ManipulationVectorEnv, config: StartsConfig, seed: int) -> None:
        super().__init__(env)
        self._config, self._seed = config, seed

    def begin(self, path: Path, remark: Remark) -> None:
        simulation = self.env.simulation
        if path.exists():
            states = GraspStates.load(path)
        else:
            start = perf_counter()
            # an object named twice has two groups of environments, and is planned once
            scenes = {group.scene.object: group.scene for group in simulation.sim.groups}
            remark(self._beginning())
            states = GraspStates.concatenate(
                [self._made(scene, remark) for scene in scenes.values()]
            )
            states.save(path)
            remark(
                f"{len(states)} states to start from in {path}, made in "
                f"{perf_counter() - start:.0f} s"
            )
        simulation.start_from(states)

    def _beginning(self) -> str:
        """What is about to be waited for."""
        config = self._config
        what = "sampling grasps" if config.start_from == "grasps" else "growing a tree"
        return f"{what} for each object, for {config.start_seconds:g} s at most"

    def _made(self, scene: Scene, remark: Remark) -> GraspStates:
        """Those of one object; what was found of what is wanted is remarked on."""
        states, of = self._found(scene)
        wanted = self._config.start_count
        said = f"{scene.object}: {len(states)} of {wanted} states wanted{of}"
        if len(states) == 1 < wanted:  # every episode would begin alike, as from fixed
            raise InvalidInput(
                f"{said}; expected several: more --start-seconds, other --tree settings, "
                "another --tree-expand or --start-from"
            )
        remark(said)
        return states

    def _found(self, scene: Scene) -> tuple[GraspStates, str]:
        """The states, and what they are of."""
        config, threads = self._config, self.env.config.scene.threads
        options: dict[str, Any] = {
            "axis": self.env.config.task.direction, "seed": self._seed, "threads": threads,
            "stability": config.stability,
            "scene_config": used_of(self.env.config.scene, scene.object),
        }  # fmt: skip
        if config.start_from == "grasps":
            found = sample_grasps(
                scene, config.start_count, seconds=config.start_seconds, **options
            )
            return found.states, f", {found.tried} tried"
        tree = grow(
            scene, config.expansion, nodes=config.tree_nodes, seconds=config.start_seconds,
            **options,
        )  # fmt: skip
        # those of simulated trees have been held already
        unseen = None if tree.header.physics_steps else scene
        states = path_states(tree, config.start_count, scene=unseen, threads=threads)
        turned = float(tree.rotation.max())
        return states, f", of a tree of {len(tree)} nodes that turns it by {turned:.2f} rad"
