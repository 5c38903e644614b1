"""Everything of an agent that decides what it does next, for checkpoints."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import torch

from dexctl.exceptions import DexctlError
from learning.agents.guided import GuidedExploration
from learning.agents.vec_env import StableBaselinesVecEnv
from learning.training.checkpoint import CheckpointError


def capture(agent: GuidedExploration) -> dict[str, Any]:
    """Everything of an agent that decides what it does next, its environments included.

    To be taken between updates and rollouts. Large arrays are views: write them before the agent
    goes on.
    """
    env = agent.env
    assert isinstance(env, StableBaselinesVecEnv)
    assert agent.replay_buffer is not None
    averaged = agent.averaged_actor
    return {
        "algorithm": type(agent).__name__,
        "policy": agent.policy.state_dict(),
        "optimizers": {
            "actor": agent.actor.optimizer.state_dict(),
            "critic": agent.critic.optimizer.state_dict(),
        },
        "averaged_actor": averaged and averaged.state_dict(),
        "replay_buffer": agent.replay_buffer.state_dict(),
        "guide": None if agent.guide is None else agent.guide.state_dict(),
        "env": env.env.save(),
        "last_obs": np.array(agent._last_obs),
        "counters": {
            "num_timesteps": agent.num_timesteps,
            "_episode_num": agent._episode_num,
            "_n_updates": agent._n_updates,
        },
        "statistics": dict(agent.statistics),
        "random": _random_states(),
    }


def restore(agent: GuidedExploration, content: dict[str, Any]) -> None:
    """Put what `capture` gave into an agent built from the same configuration.

    Raises:
        CheckpointError: it was taken from another kind of agent.
    """
    env = agent.env
    assert isinstance(env, StableBaselinesVecEnv)
    assert agent.replay_buffer is not None
    if content["algorithm"] != type(agent).__name__:
        raise CheckpointError(
            f"the checkpoint is of a {content['algorithm']}; this run trains a "
            f"{type(agent).__name__}"
        )
    try:
        agent.policy.load_state_dict(content["policy"])
        if agent.averaged_actor is not None:  # a run may begin to average when it is resumed
            averaged = content.get("averaged_actor") or agent.actor.state_dict()
            agent.averaged_actor.load_state_dict(averaged)
        agent.actor.optimizer.load_state_dict(content["optimizers"]["actor"])
        agent.critic.optimizer.load_state_dict(content["optimizers"]["critic"])
        agent.replay_buffer.load_state_dict(content["replay_buffer"])
        env.env.restore(content["env"])
        if agent.guide is not None:
            agent.guide.load_state_dict(content["guide"])
    except (DexctlError, RuntimeError, ValueError, KeyError, TypeError) as error:
        reason = str(error).partition("\n")[0]
        raise CheckpointError(
            f"the checkpoint does not fit this configuration: {reason}"
        ) from error
    agent._last_obs = content["last_obs"].copy()
    for name, value in content["counters"].items():
        setattr(agent, name, value)
    agent.statistics = dict(content["statistics"])
    _restore_random_states(content["random"])


def _random_states() -> dict[str, Any]:
    cuda = torch.cuda.get_rng_state_all() if torch.cuda.is_available() else []
    return {
        "python": random.getstate(),
        "numpy": np.random.get_state(),  # noqa: NPY002 (what stable-baselines3 draws from)
        "torch": torch.get_rng_state(),
        "cuda": cuda,
    }


def _restore_random_states(saved: dict[str, Any]) -> None:
    random.setstate(saved["python"])
    np.random.set_state(saved["numpy"])  # noqa: NPY002
    torch.set_rng_state(saved["torch"])
    if saved["cuda"] and torch.cuda.is_available():
        torch.cuda.set_rng_state_all(saved["cuda"])
