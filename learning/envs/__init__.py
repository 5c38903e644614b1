"""Environments: what hands do with objects, and what it is worth.

The environments themselves need the extra "learning" and are loaded when they are first named; what
trained policies share with them (observation, action, configuration) does not.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from dexctl.exceptions import MissingExtra
from learning.envs.action import SetPointAction
from learning.envs.config import EnvConfig
from learning.envs.holding import HoldingConfig
from learning.envs.observation import DEFAULT_PARTS, PARTS, Observation
from learning.envs.reorientation import ReorientationConfig
from learning.envs.task import Judgement, Step, Task
from learning.envs.tasks import TaskConfig
from learning.envs.turning import TurningConfig

if TYPE_CHECKING:
    from learning.envs.single import ManipulationEnv
    from learning.envs.vector import ManipulationVectorEnv, make_vector

__all__ = [
    "DEFAULT_PARTS",
    "PARTS",
    "EnvConfig",
    "HoldingConfig",
    "Judgement",
    "ManipulationEnv",
    "ManipulationVectorEnv",
    "Observation",
    "ReorientationConfig",
    "SetPointAction",
    "Step",
    "Task",
    "TaskConfig",
    "TurningConfig",
    "make_vector",
]

_LAZY = {
    "ManipulationEnv": "learning.envs.single",
    "ManipulationVectorEnv": "learning.envs.vector",
    "make_vector": "learning.envs.vector",
}


def __getattr__(name: str) -> object:
    """Load a name of ``_LAZY`` (PEP 562); later uses find it in the module directly."""
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        value = getattr(import_module(_LAZY[name]), name)
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] != "gymnasium":
            raise
        raise MissingExtra(f"learning.envs.{name}", "learning") from None
    globals()[name] = value
    return value
