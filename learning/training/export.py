"""From a trained algorithm to its policy file, which runs without torch."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path

from dexctl.hands.identity import identity
from dexctl.settings import to_plain
from learning.algorithms.base import Algorithm
from learning.config import TrainConfig
from learning.envs.vector import ManipulationVectorEnv
from learning.policies import PolicySpec, save

_VERSIONS = ("numpy", "torch", "mujoco")


def policy_spec(
    algorithm: Algorithm, env: ManipulationVectorEnv, config: TrainConfig
) -> PolicySpec:
    """What the weights of the algorithm's policy are for."""
    return PolicySpec.of(
        env.hand, env.observation, env.action, config.env.scene.hand, algorithm.activation,
        env.history.steps,
    )  # fmt: skip


def export_policy(
    algorithm: Algorithm,
    env: ManipulationVectorEnv,
    config: TrainConfig,
    path: Path,
    figures: Mapping[str, float],
) -> None:
    """Write the algorithm's policy and its card."""
    card = {
        "trained": to_plain(config),
        "hand": identity(env.hand),
        "steps": algorithm.steps,
        "figures": dict(figures),
        "versions": {
            "python": platform.python_version(),
            **{name: version(name) for name in _VERSIONS},
        },
    }
    save(path, algorithm.policy_layers(), policy_spec(algorithm, env, config), card)
