"""The scene of a servo hand: what `dexctl.sim.SceneConfig` says of it, and where that counts."""

from __future__ import annotations

from dataclasses import fields, replace

from dexctl.limits import REAL_SPEED, REAL_TORQUE, HandLimits
from dexctl.settings import Text
from dexctl.sim.scene_config import SceneConfig
from dexctl.sim.sensing import Sensing
from dexctl.touch import TouchConfig
from hardware.tactile import TRUSTED_FORCE

NOTHING = "none"
"""In place of an object's name: the hand is empty."""
AUTO = "auto"
"""In place of an object's name: what the controller is usually tried with."""

HOLDING = SceneConfig(
    object=("cylinder",),
    stiffness=3.0,
    damping=0.15,
    disturbance=0.0,
    sensing=Sensing(touch_threshold=TRUSTED_FORCE, object_pose="unknown"),
    limits=HandLimits(speed_limit=REAL_SPEED, torque_limit=REAL_TORQUE),
)
"""The hand of the thesis on servos, with an object in it; its latency is what the servos have."""
EMPTY = replace(HOLDING, object=(NOTHING,))
"""The same hand with nothing in it."""
ASKED = replace(EMPTY, stiffness=None, damping=None)
"""What commands begin with: gains are those that the hand's toml says, else those of `HOLDING`."""
POSES = ("unknown", "touch", "tracked")
"""How the object's pose can be known on servos: by its controller, or from a tracker."""
HELP = {
    name: Text(
        f"{name.capitalize()} of the joints' servos [{unit}]; none: as [servos] of the hand's "
        f"toml has it, else {getattr(HOLDING, name):g}."
    )
    for name, unit in (("stiffness", "N m/rad"), ("damping", "N m s/rad"))
} | {
    "sensing.object_pose": Text(
        "How the object's pose is known: unknown, not at all; touch, as it is in the grasp that "
        "the hand goes to and from then on by what the fingers feel (`TouchTracking`); tracked, "
        "from a tracker.",
        "{" + ",".join(POSES) + "}",
    )
}
"""What of the settings is another thing on servos than in the simulator."""

CLOCK = ("control_period", "substeps")
"""Settings that a servo hand does not have: its control period is the controller's."""
OF_A_REAL_HAND = (
    "hand", "object", "object_size", "object_mass", "object_mesh", "gravity", "stiffness",
    "damping", "sensing.touch", *(f"sensing.joint_touch.{one.name}" for one in fields(TouchConfig)),
    "sensing.touch_threshold", "sensing.object_pose", "limits.speed_limit", "limits.torque_limit",
)  # fmt: skip
"""Settings that count on a real hand too; those of the object say how to grasp it."""
OF_AN_OBJECT = (
    "object_size", "object_mass", "object_mesh", "object_friction", "initial_states",
    "push.push_force",
)  # fmt: skip
"""Settings that mean nothing in an empty hand."""
