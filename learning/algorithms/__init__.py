"""Algorithms: SAC, TD3, PPO and DAgger, each by itself; a trainer steps the environments.

The names are loaded when they are first used; their settings need no torch.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from learning.algorithms.base import Algorithm, Cloning, Transitions
    from learning.algorithms.catalogue import make
    from learning.algorithms.config import DAggerConfig, PPOConfig, SACConfig, TD3Config
    from learning.algorithms.dagger import DAgger
    from learning.algorithms.ppo import PPO
    from learning.algorithms.sac import SAC
    from learning.algorithms.td3 import TD3

__all__ = [
    "PPO",
    "SAC",
    "TD3",
    "Algorithm",
    "Cloning",
    "DAgger",
    "DAggerConfig",
    "PPOConfig",
    "SACConfig",
    "TD3Config",
    "Transitions",
    "make",
]

_HOMES = {
    "catalogue": ("make",),
    "base": ("Algorithm", "Cloning", "Transitions"),
    "config": ("DAggerConfig", "PPOConfig", "SACConfig", "TD3Config"),
    "dagger": ("DAgger",),
    "ppo": ("PPO",),
    "sac": ("SAC",),
    "td3": ("TD3",),
}


def __getattr__(name: str) -> object:
    """Load a name of ``_HOMES`` (PEP 562); later uses find it in the module directly."""
    for home, those in _HOMES.items():
        if name in those:
            value = getattr(import_module(f"{__name__}.{home}"), name)
            globals()[name] = value
            return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
