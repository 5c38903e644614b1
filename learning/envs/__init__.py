"""Environments: a hand that is rewarded for turning an object with its fingertips."""

from learning.envs.action import SetPointAction
from learning.envs.config import EnvConfig
from learning.envs.initial_states import InitialStates
from learning.envs.observation import DEFAULT_PARTS, PARTS, Observation
from learning.envs.single import FingerGaitingEnv
from learning.envs.vector import EnvState, FingerGaitingVectorEnv, make_vector

__all__ = [
    "DEFAULT_PARTS",
    "PARTS",
    "EnvConfig",
    "EnvState",
    "FingerGaitingEnv",
    "FingerGaitingVectorEnv",
    "InitialStates",
    "Observation",
    "SetPointAction",
    "make_vector",
]
