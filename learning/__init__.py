"""Reinforcement learning with dexctl's controllers as action priors (thesis, chapter 4).

Importing this package registers the environments with gymnasium, which loads no plug-ins by
itself; it imports neither torch nor MuJoCo:

    import gymnasium, learning

    env = gymnasium.make("dexctl/FingerGaiting-v0", hand="dex5", object="cube")
    envs = gymnasium.make_vec("dexctl/FingerGaiting-v0", num_envs=64, object="cylinder")
    goals = gymnasium.make("dexctl/Reorientation-v0", goals="uniform")

`load_policy` and what it loads need no more than the core install, gymnasium included.
"""

from __future__ import annotations

from importlib.util import find_spec

from learning.policies import Policy
from learning.policies import load as load_policy
from learning.policies import save as save_policy

FINGER_GAITING = "dexctl/FingerGaiting-v0"
REORIENTATION = "dexctl/Reorientation-v0"

__all__ = ["FINGER_GAITING", "REORIENTATION", "Policy", "load_policy", "save_policy"]


def _register() -> None:
    import gymnasium

    from learning.envs.observation import DEFAULT_PARTS

    goals = {"goals": "cube", "parts": (*DEFAULT_PARTS, "goal_rotation")}
    for name, options in ((FINGER_GAITING, {}), (REORIENTATION, goals)):
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point="learning.envs.single:ManipulationEnv",
                vector_entry_point="learning.envs.vector:make_from_options",
                kwargs=options,
            )


if find_spec("gymnasium") is not None:
    _register()
