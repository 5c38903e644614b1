"""The simulated plant: hands and objects in MuJoCo, tactile sensing, many at once.

Importing this package loads MuJoCo; `import dexctl` does not.
"""

from dexctl.sim.grouped import GroupedSimulator
from dexctl.sim.objects import object_names
from dexctl.sim.scene import Scene
from dexctl.sim.simulator import BatchSimulator, SimulatorState
from dexctl.sim.tactile import Tactile
from dexctl.sim.trial import Trace, run

__all__ = [
    "BatchSimulator",
    "GroupedSimulator",
    "Scene",
    "SimulatorState",
    "Tactile",
    "Trace",
    "object_names",
    "run",
]
