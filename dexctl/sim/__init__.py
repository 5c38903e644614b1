"""The simulated plant: hands and objects in MuJoCo, tactile sensing, many at once.

Importing this package loads MuJoCo; `import dexctl` does not.
"""

from dexctl.sim.as_real import AsReal
from dexctl.sim.engine import VERSION as MUJOCO_VERSION
from dexctl.sim.grouped import GroupedSimulator
from dexctl.sim.objects import object_names
from dexctl.sim.record import Recorder
from dexctl.sim.scene import Scene
from dexctl.sim.simulator import BatchSimulator, SimulatorState
from dexctl.sim.tactile import Tactile
from dexctl.sim.trial import Trace, run
from dexctl.sim.viewer import Viewer

__all__ = [
    "MUJOCO_VERSION",
    "AsReal",
    "BatchSimulator",
    "GroupedSimulator",
    "Recorder",
    "Scene",
    "SimulatorState",
    "Tactile",
    "Trace",
    "Viewer",
    "object_names",
    "run",
]
