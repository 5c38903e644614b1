"""How a scene looks: floor, light, sky, the object's pattern, fingertips that light up on touch."""

from __future__ import annotations

import mujoco
import numpy as np

from dexctl.sim.objects import OWN
from dexctl.sim.scene import Scene
from dexctl.state import Bools, Floats

CAMERA = OWN + "overview"
_IDLE = np.array([0.80, 0.82, 0.85, 1.0], np.float32)
_TOUCHING = np.array([1.00, 0.42, 0.10, 1.0], np.float32)
_AZIMUTH, _ELEVATION = np.deg2rad(-52.0), np.deg2rad(27.0)
_FIELD_OF_VIEW = 32.0  # [deg]


def up_direction(scene: Scene) -> Floats:
    """The unit vector against gravity, ``(3,)``; z where there is no gravity."""
    strength = float(np.linalg.norm(scene.gravity))
    return -scene.gravity / strength if strength > 1e-9 else np.array([0.0, 0.0, 1.0])


def visual_model(scene: Scene) -> mujoco.MjModel:
    """The scene with everything visual: same joints as ``scene.model``, floor below the hand."""
    spec = scene.spec
    up = up_direction(scene)
    centre, extent = _bounds(scene)
    frame = _frame(up)
    spec.visual.headlight.ambient = [0.38, 0.38, 0.40]
    spec.visual.headlight.diffuse = [0.25, 0.25, 0.25]
    spec.visual.headlight.specular = [0.05, 0.05, 0.05]
    spec.visual.quality.shadowsize = 1024
    spec.visual.quality.offsamples = 4
    getattr(spec.visual, "global").offwidth = 1920
    getattr(spec.visual, "global").offheight = 1440
    _textures(spec)
    world = spec.worldbody
    world.add_geom(
        name=OWN + "floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0, 0, 0.05],
        pos=centre - 0.62 * extent * up,
        quat=_quaternion(frame),
        material=OWN + "floor",
        contype=0,
        conaffinity=0,
        mass=0,
    )
    for position, strength, shadow in (
        ((0.6, -0.9, 2.2), 0.62, True),
        ((-1.2, 0.4, 1.4), 0.25, False),
    ):
        world.add_light(
            type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
            pos=centre + extent * frame @ np.array(position),
            dir=-frame @ np.array(position) / np.linalg.norm(position),
            diffuse=[strength] * 3,
            specular=[0.2 * shadow] * 3,
            castshadow=shadow,
        )
    for geom in spec.body(scene.object_body).geoms:
        geom.material = OWN + "object"
        geom.rgba = [1.0, 1.0, 1.0, 1.0]  # it tints the material
    _add_camera(world, centre, extent, frame)
    return spec.compile()


def _bounds(scene: Scene) -> tuple[Floats, float]:
    """Middle and size of the box around hand and object in the settled or open grasp."""
    data = mujoco.MjData(scene.model)
    data.qpos[scene.qpos_columns] = scene.open_q
    mujoco.mj_kinematics(scene.model, data)
    radius = scene.model.geom_rbound[:, None]
    low = (data.geom_xpos - radius).min(axis=0)
    high = (data.geom_xpos + radius).max(axis=0)
    return (low + high) / 2, float(np.linalg.norm(high - low))


def _frame(up: Floats) -> Floats:
    """Rotation ``(3, 3)`` whose z column is ``up`` and whose x column stays near the world's x."""
    side = np.array([1.0, 0.0, 0.0]) if abs(up[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    x = side - up * (side @ up)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(up, x), up])


def _quaternion(rotation: Floats) -> Floats:
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(rotation).ravel())
    return quaternion


def _textures(spec: mujoco.MjSpec) -> None:
    spec.add_texture(
        name=OWN + "sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.80, 0.85, 0.90],
        rgb2=[0.50, 0.60, 0.70],
        width=256,
        height=1536,
    )
    spec.add_texture(
        name=OWN + "floor",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.58, 0.61, 0.65],
        rgb2=[0.51, 0.54, 0.58],
        width=512,
        height=512,
    )
    # a two-colour pattern makes turning visible, on a sphere too
    spec.add_texture(
        name=OWN + "object",
        type=mujoco.mjtTexture.mjTEXTURE_CUBE,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        mark=mujoco.mjtMark.mjMARK_EDGE,
        rgb1=[0.13, 0.42, 0.62],
        rgb2=[0.93, 0.86, 0.66],
        markrgb=[0.10, 0.20, 0.30],
        width=256,
        height=256,
    )
    for name, repeat, reflectance, specular in (
        ("floor", 6.0, 0.0, 0.1),
        ("object", 1.0, 0.0, 0.4),
    ):
        material = spec.add_material(
            name=OWN + name, reflectance=reflectance, specular=specular, shininess=0.5
        )
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = OWN + name
        material.texrepeat = [repeat, repeat]
        material.texuniform = name == "floor"


def _add_camera(world: mujoco.MjsBody, centre: Floats, extent: float, frame: Floats) -> None:
    distance = 0.5 * extent / np.tan(np.deg2rad(_FIELD_OF_VIEW) / 2)
    away = np.array(
        [
            np.cos(_ELEVATION) * np.cos(_AZIMUTH),
            np.cos(_ELEVATION) * np.sin(_AZIMUTH),
            np.sin(_ELEVATION),
        ]
    )
    right = np.array([-np.sin(_AZIMUTH), np.cos(_AZIMUTH), 0.0])
    axes = frame @ np.column_stack([right, np.cross(away, right), away])
    world.add_camera(
        name=CAMERA,
        pos=centre + distance * frame @ away,
        quat=_quaternion(axes),
        fovy=_FIELD_OF_VIEW,
    )


def colour_fingertips(drawn: mujoco.MjvScene, tips: dict[int, int], touching: Bools) -> None:
    """Colour the fingertips in a scene about to be drawn.

    Args:
        drawn: the scene after ``mjv_updateScene``.
        tips: geom id -> finger.
        touching: ``(m,)`` bool.
    """
    for geom in drawn.geoms[: drawn.ngeom]:
        if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and geom.objid in tips:
            geom.matid = -1
            geom.rgba = _TOUCHING if touching[tips[geom.objid]] else _IDLE


def fingertip_geoms(scene: Scene, model: mujoco.MjModel) -> dict[int, int]:
    """Geom id -> finger, of all geoms on the fingertip bodies."""
    bodies = {model.body(name).id: i for i, name in enumerate(scene.hand.fingertip_bodies)}
    return {
        geom: bodies[int(body)] for geom, body in enumerate(model.geom_bodyid) if body in bodies
    }
