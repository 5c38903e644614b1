"""The simulated plant: hands and objects in MuJoCo, tactile sensing, many at once.

Its names are loaded when they are first used; MuJoCo comes with the first that simulates.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from dexctl.limits import HandLimits

if TYPE_CHECKING:
    from dexctl.sim.engine import MUJOCO_VERSION
    from dexctl.sim.grasp_states import GraspStates
    from dexctl.sim.grouped import GroupedSimulator
    from dexctl.sim.limited_hand import LimitedHand
    from dexctl.sim.link_weights import LinkWeights
    from dexctl.sim.objects import object_names
    from dexctl.sim.pushes import Push
    from dexctl.sim.randomisation import Randomisation
    from dexctl.sim.record import Recorder, draw_failure
    from dexctl.sim.scene import Scene
    from dexctl.sim.scene_config import SceneConfig
    from dexctl.sim.sensing import Sensing
    from dexctl.sim.settle_failure import SettleFailure
    from dexctl.sim.shapes import Shape
    from dexctl.sim.simulation import Simulation
    from dexctl.sim.simulator import BatchSimulator, SimulatorState
    from dexctl.sim.state_rows import StateRows
    from dexctl.sim.suggest import SuggestedGrasp
    from dexctl.sim.trial import Trace, rotation_about, run
    from dexctl.sim.viewer import Viewer

__all__ = [
    "MUJOCO_VERSION",
    "BatchSimulator",
    "GraspStates",
    "GroupedSimulator",
    "HandLimits",
    "LimitedHand",
    "LinkWeights",
    "Push",
    "Randomisation",
    "Recorder",
    "Scene",
    "SceneConfig",
    "Sensing",
    "SettleFailure",
    "Shape",
    "Simulation",
    "SimulatorState",
    "StateRows",
    "SuggestedGrasp",
    "Trace",
    "Viewer",
    "draw_failure",
    "object_names",
    "rotation_about",
    "run",
]

_HOMES = {
    "engine": ("MUJOCO_VERSION",),
    "grasp_states": ("GraspStates",),
    "grouped": ("GroupedSimulator",),
    "limited_hand": ("LimitedHand",),
    "link_weights": ("LinkWeights",),
    "objects": ("object_names",),
    "pushes": ("Push",),
    "randomisation": ("Randomisation",),
    "record": ("Recorder", "draw_failure"),
    "scene": ("Scene",),
    "scene_config": ("SceneConfig",),
    "sensing": ("Sensing",),
    "settle_failure": ("SettleFailure",),
    "shapes": ("Shape",),
    "simulation": ("Simulation",),
    "simulator": ("BatchSimulator", "SimulatorState"),
    "state_rows": ("StateRows",),
    "suggest": ("SuggestedGrasp",),
    "trial": ("Trace", "rotation_about", "run"),
    "viewer": ("Viewer",),
}
_WITHOUT_MUJOCO = (
    "grasp_states",
    "limited_hand",
    "pushes",
    "randomisation",
    "scene_config",
    "sensing",
    "state_rows",
)


def __getattr__(name: str) -> object:
    """Load a name of ``_HOMES`` (PEP 562); later uses find it in the module directly."""
    home = next((module for module, those in _HOMES.items() if name in those), None)
    if home is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if home not in _WITHOUT_MUJOCO:
        import_module("dexctl.sim.engine")  # says in one line why MuJoCo cannot be loaded
    value = getattr(import_module(f"{__name__}.{home}"), name)
    globals()[name] = value
    return value
