"""From a trained agent to its policy file, which runs without torch."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch

from learning import policies
from learning.agents import GuidedSAC, GuidedTD3, StableBaselinesVecEnv
from learning.envs import FingerGaitingVectorEnv
from learning.envs.observation import Observation
from learning.policies import PolicySpec
from learning.settings import TrainConfig

Agent = GuidedSAC | GuidedTD3


def actor_observation(config: TrainConfig, env: FingerGaitingVectorEnv) -> Observation:
    """What the policy sees: the environment's observation but for the critics' own parts."""
    whole = env.observation.to_dict()
    return Observation.from_dict(env.hand, whole | {"parts": list(config.env.parts)})


def export_policy(
    agent: Agent, config: TrainConfig, path: Path, figures: Mapping[str, float]
) -> None:
    """Write the agent's policy, which runs without torch, and its card."""
    assert isinstance(agent.env, StableBaselinesVecEnv)
    env = agent.env.env
    assert isinstance(env, FingerGaitingVectorEnv)
    spec = PolicySpec.of(env.hand, actor_observation(config, env), env.action, config.env)
    card = {
        "trained": config.to_dict(),
        "steps": agent.num_timesteps,
        "figures": dict(figures),
        "versions": {
            "python": platform.python_version(),
            **{name: version(name) for name in ("numpy", "torch", "stable-baselines3", "mujoco")},
        },
    }
    policies.save(path, policy_layers(agent), spec, card)


def policy_layers(agent: Agent) -> list[tuple[np.ndarray, np.ndarray]]:
    """The deterministic policy as (weight, bias) pairs; ReLU between them, tanh at the end."""
    actor = agent.averaged_actor or agent.actor
    modules = [*actor.latent_pi, actor.mu] if isinstance(agent, GuidedSAC) else list(actor.mu)
    return [
        (m.weight.detach().cpu().numpy().copy(), m.bias.detach().cpu().numpy().copy())
        for m in modules
        if isinstance(m, torch.nn.Linear)
    ]
