"""Reinforcement learning with dexctl's controllers as action priors."""
