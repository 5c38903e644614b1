"""Where things lie in MuJoCo's full physics state, and what else decides a simulator's future."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from dexctl.sim.moving_base import BaseMotion
from dexctl.sim.scene import Scene
from dexctl.state import Bools, Floats

FULL_PHYSICS = mujoco.mjtState.mjSTATE_FULLPHYSICS
_GIVEN = mujoco.mjtState
# What a physics step is given: control values, force and torque on every body, then where the
# body is that carries a moving base.
INPUT = (
    _GIVEN.mjSTATE_CTRL.value
    | _GIVEN.mjSTATE_XFRC_APPLIED.value
    | _GIVEN.mjSTATE_MOCAP_POS.value
    | _GIVEN.mjSTATE_MOCAP_QUAT.value
)
# Faster than anything in a hand; what falls is faster by what gravity adds in its time.
_FASTEST = 1000.0  # [m/s], [rad/s]

SimulatorState = dict[str, Any]
"""Everything that decides the future of a `BatchSimulator`: arrays of N rows by name."""


class PhysicsLayout:
    """The columns of the full physics state (time, qpos, qvel, ...) of one scene.

    Attributes:
        size: number of columns.
        q: the hand's joints, ``(d,)``.
        qpos, qvel: MuJoCo's generalised positions and velocities.
        position, quaternion, pose: the object's, the last being both.
        object_velocity: the object's, linear and angular.
        inputs: number of columns of ``INPUT``.
        push: the force on the object among them.
        base: where the base is, in a scene whose base moves, else None.
    """

    def __init__(self, scene: Scene) -> None:
        model = scene.model
        self.size = mujoco.mj_stateSize(model, FULL_PHYSICS)
        self.qpos = slice(1, 1 + model.nq)
        self.qvel = slice(1 + model.nq, 1 + model.nq + model.nv)
        self.q = 1 + scene.qpos_columns
        pose = 1 + scene.object_qpos.start
        self.position = slice(pose, pose + 3)
        self.quaternion = slice(pose + 3, pose + 7)
        self.pose = slice(pose, pose + 7)
        velocity = self.qvel.start + scene.object_qvel.start
        self.object_velocity = slice(velocity, velocity + 6)
        self.inputs = mujoco.mj_stateSize(model, INPUT)
        push = model.nu + 6 * model.body(scene.object_body).id
        self.push = slice(push, push + 3)
        moving = BaseMotion(model, self.qpos.start, self.inputs - 7) if scene.moving_base else None
        self.base: BaseMotion | None = moving

    def state(self, qpos: Floats, qvel: Floats | None = None) -> Floats:
        """Full physics states ``(..., size)`` at time 0, at rest without ``qvel``."""
        physics = np.zeros((*qpos.shape[:-1], self.size))
        physics[..., self.qpos] = qpos
        if qvel is not None:
            physics[..., self.qvel] = qvel
        return physics

    def broken(
        self, after: Floats, expected_time: Floats, timestep: float, gravity: float
    ) -> Bools:
        """Where a step ended in something that is not a simulation any more, ``(N,)``.

        MuJoCo resets a diverged simulation and goes on: its time has fallen back. An object that
        falls, however far, is none: pushed and pulled, it gains a few times gravity's speed.
        """
        late = np.abs(after[:, 0] - expected_time) > 0.5 * timestep
        fastest = _FASTEST + 10.0 * gravity * np.abs(expected_time)
        # comparisons with NaN are False, so state what is good
        slow = (np.abs(after[:, self.qvel]) < fastest[:, None]).all(axis=1)
        finite = np.isfinite(after.sum(axis=1))
        return late | ~(slow & finite)
