"""Pictures of a hand by itself: where its fingertips are, and which way its palm looks."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from dexctl.sim.hand_joints import HandJoints
from dexctl.sim.offscreen import Offscreen
from dexctl.sim.scene import Scene
from dexctl.sim.settle_failure import SettleFailure
from dexctl.sim.visuals import colour_fingertips, fingertip_geoms, visual_model
from dexctl.state import Floats

VIEWS = {"from the side of the thumb": (-60.0, -25.0), "from above the palm": (0.0, -89.0)}
"""Names of views, with azimuth and elevation of the camera in the hand's frame [deg]."""
_TIP = np.array([1.0, 0.25, 0.1, 1.0], np.float32)
_AXIS = np.array([0.1, 0.35, 0.9, 1.0], np.float32)
_UP = np.array([0.1, 0.65, 0.25, 1.0], np.float32)
_AWAY = 100.0  # where the object is not seen [m]


def hand_pictures(
    scene: Scene, q: Floats, width: int = 800, height: int = 600
) -> dict[str, NDArray[np.uint8]]:
    """The hand without its object, `VIEWS` by name, each ``(height, width, 3)``.

    The bodies that fingertips are on are orange, their points red balls; the blue arrow is where
    the palm looks (z), the green one where the fingers point (x).

    Args:
        scene: with the hand in it.
        q: joints ``(d,)`` [rad].
        width, height: of the pictures [pixels].

    Raises:
        SimulationError: there is no OpenGL to draw with.
    """
    model = visual_model(scene)
    data = mujoco.MjData(model)
    HandJoints(model, scene.hand).place(data, q)
    data.qpos[scene.object_qpos.start + 2] = -_AWAY
    mujoco.mj_forward(model, data)
    tips = scene.hand.fingertip_positions(q)
    middle = _middle(model, data, tips)
    size = float(np.linalg.norm(np.ptp(tips, axis=0))) + 0.1
    above = middle + np.array([0.0, 0.0, 0.04])  # out of the hand, where the palm looks
    camera, option = mujoco.MjvCamera(), mujoco.MjvOption()
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    camera.lookat, camera.distance = middle, 1.8 * size
    offscreen = Offscreen(model, width, height)
    offscreen.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
    bodies, found = fingertip_geoms(scene, model), {}
    try:
        for name, (azimuth, elevation) in VIEWS.items():
            camera.azimuth, camera.elevation = azimuth, elevation
            mujoco.mjv_updateScene(
                model, data, option, None, camera, mujoco.mjtCatBit.mjCAT_ALL, offscreen.scene
            )
            colour_fingertips(offscreen.scene, bodies, np.ones(len(tips), bool))
            for tip in tips:
                _ball(offscreen.scene, tip)
            for direction, colour in (((0, 0, 1), _AXIS), ((1, 0, 0), _UP)):
                end = above + 0.35 * size * np.array(direction)
                _arrow(offscreen.scene, above, end, colour)
            found[name] = offscreen.draw()
    finally:
        offscreen.close()
    return found


def _middle(model: mujoco.MjModel, data: mujoco.MjData, tips: Floats) -> Floats:
    """Between the fingertips and the hand's bodies that move."""
    bodies = [b for b in range(1, model.nbody) if np.linalg.norm(data.xpos[b]) < _AWAY / 2]
    near = [b for b in bodies if model.body_dofnum[b]]
    return (tips.mean(axis=0) + data.xpos[near or bodies].mean(axis=0)) / 2


def _geom(drawn: mujoco.MjvScene) -> mujoco.MjvGeom:
    drawn.ngeom += 1
    return drawn.geoms[drawn.ngeom - 1]


def _ball(drawn: mujoco.MjvScene, at: Floats) -> None:
    kind = mujoco.mjtGeom.mjGEOM_SPHERE
    size = np.full(3, 0.006)
    mujoco.mjv_initGeom(_geom(drawn), kind, size, at, np.eye(3).ravel(), _TIP)


def _arrow(drawn: mujoco.MjvScene, start: Floats, end: Floats, colour: NDArray[np.float32]) -> None:
    geom, kind = _geom(drawn), mujoco.mjtGeom.mjGEOM_ARROW
    mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.eye(3).ravel(), colour)
    mujoco.mjv_connector(geom, kind, 0.004, start, end)


def grasp_picture(
    scene: Scene, failure: Exception | None = None, width: int = 800, height: int = 600
) -> NDArray[np.uint8]:
    """The settled grasp ``(height, width, 3)``; where it failed, the attempt that came closest.

    Raises:
        SimulationError: there is no OpenGL to draw with, or the object does not stay.
    """
    model = visual_model(scene)
    data = mujoco.MjData(model)
    if isinstance(failure, SettleFailure) and failure.closest is not None:
        qpos = failure.closest.qpos
    else:
        qpos = scene.settled.qpos
    data.qpos[: len(qpos)] = qpos
    mujoco.mj_forward(model, data)
    middle, size = scene.grasp_centre, 0.25 + 2 * scene.object_width
    camera, option = mujoco.MjvCamera(), mujoco.MjvOption()
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    camera.lookat, camera.distance = middle, 1.3 * size
    camera.azimuth, camera.elevation = -60.0, -25.0
    offscreen = Offscreen(model, width, height)
    offscreen.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
    try:
        mujoco.mjv_updateScene(
            model, data, option, None, camera, mujoco.mjtCatBit.mjCAT_ALL, offscreen.scene
        )
        return offscreen.draw()
    finally:
        offscreen.close()
