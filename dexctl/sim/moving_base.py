"""A hand that something carries: the body that moves it, and how it gets from pose to pose.

The hand's root body floats and is held, by a stiff constraint, at a body that is put where the
arm would have it. So the base has a velocity, which fingers and contacts feel; a body that is
merely put somewhere else would slide under the object.
"""

from __future__ import annotations

import mujoco
import numpy as np

from dexctl.exceptions import SimulationError
from dexctl.hand import HandModel
from dexctl.rotations import inverse, multiply, rotate
from dexctl.sim.file_settings import TIMESTEP
from dexctl.sim.objects import OWN
from dexctl.state import Floats

BASE = OWN + "base"
"""Name of the base's joint, and of the body that it is held at."""
REST = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
"""Pose of the hand's frame in the world as long as nothing moves it: position, quaternion."""
_CARRIED = 10.0  # as heavy as an arm, so that the fingers do not shake it [kg], [kg m^2]
_SOLREF, _SOLIMP = (2 * TIMESTEP, 1.0), (0.999, 0.9999, 0.001, 0.5, 2.0)


def add_moving_base(spec: mujoco.MjSpec, hand: HandModel) -> None:
    """Let the hand's root body float, held at a body that can be moved.

    Raises:
        SimulationError: the hand is not on one root body without joints of its own.
    """
    used = {*hand.joint_names, *hand.couplings}
    roots = [
        body
        for body in spec.worldbody.bodies
        if any(joint.name in used for one in (body, *body.find_all("body")) for joint in one.joints)
    ]
    if len(roots) != 1 or roots[0].joints:
        found = ", ".join(body.name for body in roots)
        raise SimulationError(
            f"{hand.path}: the joints hang on {found}; a moving base needs one root body without "
            "joints that carries them all: put a <body> around the hand"
        )
    root = roots[0]
    weightless = root.explicitinertial and not root.mass
    if weightless or not any((root.explicitinertial, *root.geoms)):
        root.explicitinertial, root.mass, root.inertia = True, 1.0, [1e-3] * 3
    joint = root.add_freejoint(name=BASE)
    joint.armature = _CARRIED
    spec.worldbody.add_body(name=BASE, mocap=True)
    spec.add_equality(
        name=BASE,
        type=mujoco.mjtEq.mjEQ_WELD,
        objtype=mujoco.mjtObj.mjOBJ_BODY,
        name1=BASE,
        name2=root.name,
        solref=_SOLREF,
        solimp=_SOLIMP,
    )


class BaseMotion:
    """Where the base is in states and inputs of a scene's physics.

    Args:
        model: of a scene with a moving base.
        qpos: where ``qpos`` begins in a state.
        inputs: where the pose of the body that moves the base begins in an input.

    Attributes:
        input: columns of that pose in an input: position, quaternion.
    """

    def __init__(self, model: mujoco.MjModel, qpos: int, inputs: int) -> None:
        first = qpos + int(model.joint(BASE).qposadr[0])
        self._columns = slice(first, first + 7)
        self.input = slice(inputs, inputs + 7)
        self._origin = model.qpos0[first - qpos : first - qpos + 7].copy()

    def pose(self, physics: Floats) -> Floats:
        """The hand's frame in the world ``(..., 7)``, from states ``(..., size)``."""
        body = physics[..., self._columns]
        turn = multiply(body[..., 3:], inverse(self._origin[3:]))
        return np.concatenate([body[..., :3] - rotate(turn, self._origin[:3]), turn], axis=-1)

    @staticmethod
    def between(start: Floats, end: Floats, steps: int) -> Floats:
        """Poses ``(N, steps, 7)`` from ``start`` (not among them) to ``end``, ``(N, 7)`` each."""
        share = np.arange(1, steps + 1)[None, :, None] / steps
        # the shorter of the two ways round; between neighbours a chord is as good as the arc
        same = (start[:, 3:] * end[:, 3:]).sum(axis=1, keepdims=True) >= 0
        end = np.concatenate([end[:, :3], np.where(same, end[:, 3:], -end[:, 3:])], axis=1)
        poses = (1 - share) * start[:, None] + share * end[:, None]
        poses[..., 3:] /= np.linalg.norm(poses[..., 3:], axis=-1, keepdims=True)
        return poses
