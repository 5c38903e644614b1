"""Algorithms: SAC, TD3 and PPO, each by itself; a trainer steps the environments."""

from __future__ import annotations

from typing import Any

from learning.algorithms.base import Algorithm, Cloning, Transitions
from learning.algorithms.ppo import PPO, PPOConfig
from learning.algorithms.sac import SAC, SACConfig
from learning.algorithms.td3 import TD3, TD3Config

__all__ = [
    "PPO", "SAC", "TD3", "Algorithm", "AlgorithmConfig", "Cloning", "PPOConfig", "SACConfig",
    "TD3Config", "Transitions", "make",
]  # fmt: skip

AlgorithmConfig = SACConfig | TD3Config | PPOConfig


def make(config: AlgorithmConfig, **options: Any) -> Algorithm:
    """The algorithm that these settings are of; ``options`` are its further arguments."""
    kinds: dict[type, Any] = {SACConfig: SAC, TD3Config: TD3, PPOConfig: PPO}
    return kinds[type(config)](config, **options)
