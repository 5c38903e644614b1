"""Where the simulator has a hand's fingertips, and what they touch with."""

from __future__ import annotations

import mujoco
import numpy as np

from dexctl.sim.hand_joints import HandJoints
from dexctl.sim.scene import Scene
from dexctl.state import Floats


def simulated_tips(scene: Scene, q: Floats) -> Floats:
    """Where the simulator has the fingertips ``(m, 3)`` [m] at joints ``(d,)``."""
    data = _forward(scene, q)
    bodies = [scene.model.body(name).id for name in scene.hand.fingertip_bodies]
    rotation = data.xmat[bodies].reshape(-1, 3, 3)
    turned = np.einsum("mij,mj->mi", rotation, scene.hand.fingertip_offsets)
    return data.xpos[bodies] + turned


def tip_gaps(scene: Scene) -> Floats:
    """How far each fingertip's point is outside of its body's collision geometry ``(m,)`` [m].

    Geometries are taken for the balls around them, so this is what it is at least; infinite where
    there is none.
    """
    model, data = scene.model, _forward(scene, scene.open_q)
    tips = simulated_tips(scene, scene.open_q)
    solid = (model.geom_contype | model.geom_conaffinity) != 0
    found = np.full(len(tips), np.inf)
    for i, name in enumerate(scene.hand.fingertip_bodies):
        geoms = np.flatnonzero(solid & (model.geom_bodyid == model.body(name).id))
        if len(geoms):
            distance = np.linalg.norm(data.geom_xpos[geoms] - tips[i], axis=1)
            found[i] = max(0.0, float((distance - model.geom_rbound[geoms]).min()))
    return found


def _forward(scene: Scene, q: Floats) -> mujoco.MjData:
    data = mujoco.MjData(scene.model)
    HandJoints(scene.model, scene.hand).place(data, q)
    mujoco.mj_kinematics(scene.model, data)
    return data
