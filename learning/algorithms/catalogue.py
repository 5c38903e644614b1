"""Which algorithm settings are of."""

from __future__ import annotations

from typing import Any

from learning.algorithms.base import Algorithm
from learning.algorithms.config import DAggerConfig, PPOConfig, SACConfig, TD3Config
from learning.algorithms.dagger import DAgger
from learning.algorithms.ppo import PPO
from learning.algorithms.sac import SAC
from learning.algorithms.td3 import TD3


def make(config: SACConfig | TD3Config | PPOConfig | DAggerConfig, **options: Any) -> Algorithm:
    """The algorithm that these settings are of; ``options`` are its further arguments."""
    kinds: dict[type, Any] = {SACConfig: SAC, TD3Config: TD3, PPOConfig: PPO, DAggerConfig: DAgger}
    return kinds[type(config)](config, **options)
