"""Which starts settings are of."""

from __future__ import annotations

from learning.envs.vector import ManipulationVectorEnv
from learning.starts.base import Starts
from learning.starts.config import StartsConfig
from learning.starts.explored import ExploredStarts
from learning.starts.gravity import GravityStarts
from learning.starts.planned import PLANNED, PlannedStarts


def make_starts(config: StartsConfig, env: ManipulationVectorEnv, seed: int) -> Starts:
    """The starts that these settings are of; nothing is planned before their `begin`."""
    if config.start_from in PLANNED:
        return PlannedStarts(env, config, seed)
    if config.start_from == "explored":
        return ExploredStarts(env, config, seed)
    if config.start_from == "gravity":
        return GravityStarts(env, config)
    return Starts(env)
