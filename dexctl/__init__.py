"""Controllers for multi-fingered robot hands.

One line tells the flow: ``HandModel + GraspState -> Grasp -> stability forces (QP) ->
Controller.act -> joint set-point change -> Plant -> GraspState``.

``import dexctl`` loads numpy, scipy and pinocchio only. The rooms below it (`dexctl.grasp`,
`dexctl.igm`, `dexctl.switch`, `dexctl.gait`, `dexctl.sim`) and their controllers are loaded when
they are first named, and bring casadi or MuJoCo when these are first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from dexctl import hands
from dexctl.controller import Controller, Superposition
from dexctl.exceptions import (
    DexctlError,
    HandModelError,
    InvalidInput,
    MissingExtra,
    SimulationError,
    UnknownName,
)
from dexctl.hand import HandModel
from dexctl.plant import Plant
from dexctl.state import GraspState

if TYPE_CHECKING:
    from dexctl import gait, grasp, igm, sim, switch
    from dexctl.gait import CoordinatedGait, FingerGaiting
    from dexctl.igm import InGraspManipulation
    from dexctl.joint_touch import JointTouch
    from dexctl.switch import ContactSwitch
    from dexctl.touch import TouchConfig
    from dexctl.version import __version__

__all__ = [
    "ContactSwitch",
    "Controller",
    "CoordinatedGait",
    "DexctlError",
    "FingerGaiting",
    "GraspState",
    "HandModel",
    "HandModelError",
    "InGraspManipulation",
    "InvalidInput",
    "JointTouch",
    "MissingExtra",
    "Plant",
    "SimulationError",
    "Superposition",
    "TouchConfig",
    "UnknownName",
    "__version__",
    "gait",
    "grasp",
    "hands",
    "igm",
    "sim",
    "switch",
]

# Names that are loaded when first used: the module, and the attribute of it (None: the module).
_LAZY: dict[str, tuple[str, str | None]] = {
    "grasp": ("dexctl.grasp", None),
    "igm": ("dexctl.igm", None),
    "switch": ("dexctl.switch", None),
    "gait": ("dexctl.gait", None),
    "sim": ("dexctl.sim", None),
    "InGraspManipulation": ("dexctl.igm", "InGraspManipulation"),
    "TouchConfig": ("dexctl.touch", "TouchConfig"),
    "JointTouch": ("dexctl.joint_touch", "JointTouch"),
    "ContactSwitch": ("dexctl.switch", "ContactSwitch"),
    "CoordinatedGait": ("dexctl.gait", "CoordinatedGait"),
    "FingerGaiting": ("dexctl.gait", "FingerGaiting"),
    "__version__": ("dexctl.version", "__version__"),
}


def __getattr__(name: str) -> object:
    """Load a name of ``_LAZY`` (PEP 562); later uses find it in the module directly."""
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module_name, attribute = _LAZY[name]
    module = import_module(module_name)
    value = module if attribute is None else getattr(module, attribute)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
