"""Agents that explore with the controllers: RL, RL+BC, FGE, VGE, VGE+BC, with SAC and TD3."""

from learning.agents.replay import GuidedReplayBuffer
from learning.agents.sac import GuidedSAC
from learning.agents.td3 import GuidedTD3
from learning.agents.vec_env import StableBaselinesVecEnv

__all__ = ["GuidedReplayBuffer", "GuidedSAC", "GuidedTD3", "StableBaselinesVecEnv"]
