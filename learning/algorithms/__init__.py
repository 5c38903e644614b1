"""Algorithms: SAC, TD3 and PPO, each by itself; a trainer steps the environments."""
