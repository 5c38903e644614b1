"""From a configuration to what trains: environments, guide and algorithm."""

from __future__ import annotations

import numpy as np
import torch

from dexctl import controllers
from dexctl.exceptions import InvalidInput
from dexctl.sim.checks import gravity_vector
from dexctl.sim.shapes import Shape
from learning.algorithms import Algorithm, Cloning, make
from learning.config import TrainConfig
from learning.envs.symmetry import Fixed, Symmetry
from learning.envs.tasks import NO_GOALS
from learning.envs.vector import ManipulationVectorEnv, make_vector
from learning.exploration import Guide, Guiding
from learning.starts.base import Remark


def build_env(config: TrainConfig) -> ManipulationVectorEnv:
    """The environments, as they are before the first step."""
    return make_vector(config.env, config.num_envs, config.seed)


def build_guide(
    config: TrainConfig, env: ManipulationVectorEnv, remark: Remark = lambda text: None
) -> Guide:
    """Who acts in them; ``remark`` is called with what people should know of them."""
    period, axis = env.simulation.control_period, config.env.task.direction
    guides = [Guiding.of(name) for name in config.guides]
    made = [
        controllers.resolve(guide.controller, env.hand, control_period=period, axis=axis)
        for guide in guides
    ]
    objects = np.array(env.objects)
    where = [np.isin(objects, guide.objects or objects) for guide in guides]
    gravity = gravity_vector(config.env.scene.gravity)
    for guide, controller, there in zip(guides, made, where, strict=True):
        turned = tuple(dict.fromkeys(objects[there].tolist()))
        if text := controllers.made_for_another(guide.controller, controller, turned, gravity):
            remark(text)
    return Guide(env, made, config.guidance, config.seed, where or None)


def build_algorithm(config: TrainConfig, env: ManipulationVectorEnv) -> Algorithm:
    """Who learns.

    Raises:
        InvalidInput: there is no such device here, or no symmetry that is asked for.
    """
    guidance, more = config.guidance, {}
    if config.symmetry:
        more["turns"] = Symmetry(env.hand, env.observations, what_stays(env))
    made = make(
        config.learner,
        groups=env.groups,
        observation_size=int(env.single_observation_space.shape[0]),  # type: ignore[index]
        action_size=env.hand.nq,
        num_envs=env.num_envs,
        labels=guidance.labels_all,
        cloning=Cloning(kind=guidance.cloning, weight=guidance.cloning_weight),
        seed=config.seed,
        device=device(config.device),
        **more,
    )
    made.begun = config.begin_from is not None
    return made


def what_stays(env: ManipulationVectorEnv) -> Fixed:
    """What decides in these environments what is worth what, and that no observation tells."""
    scenes, task = [group.scene for group in env.simulation.sim.groups], env.config.task
    always = task.goals == "yaw" or (task.goals == NO_GOALS and not task.turning.commands)
    return Fixed(
        [scene.gravity for scene in scenes],
        [np.array(task.direction)] if always else [],
        all(Shape.of_body(scene.model).is_mirrored for scene in scenes),
    )


def device(name: str) -> str:
    """The torch device of that name; "auto" is a GPU where there is one."""
    available = torch.cuda.is_available()
    if name == "cuda" and not available:
        raise InvalidInput("device is 'cuda', and torch finds no GPU here; expected cpu or auto")
    return ("cuda" if available else "cpu") if name == "auto" else name
