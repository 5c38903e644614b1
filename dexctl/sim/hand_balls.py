"""The hand's surface as balls on its bodies: where links and fingertips are, for many postures."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from dexctl.hand import HandModel
from dexctl.state import Bools, Floats

_SPACING = 0.016  # of balls on a surface [m]
_MOST = 64  # balls of one mesh


class HandBalls:
    """Balls that stand for the collision geoms of a hand: spheres and capsules as they are,
    boxes, cylinders and meshes by points of their surface.

    Args:
        model: compiled, with the hand and an object.
        hand: its kinematics.
        object_body: name of the object's body, which is left out.

    Attributes:
        fingers: how many fingertips the hand has.
        radius: ``(b,)`` [m].
        finger: whose link each is on, ``(b,)``; -1: the palm, and what several fingers share.
        tip: which are on a fingertip's body, ``(b,)`` bool.
    """

    def __init__(self, model: mujoco.MjModel, hand: HandModel, object_body: str = "object") -> None:
        self._model, self._data = model, mujoco.MjData(model)
        self._object = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, object_body)
        joints = [model.joint(name).id for name in hand.joint_names]
        self._columns = model.jnt_qposadr[joints]
        self._followers = followers(model)
        owner = _owners(model, hand)
        bodies, offsets, radii = [], [], []
        solid = (model.geom_contype | model.geom_conaffinity) != 0
        for geom in np.flatnonzero(solid & (model.geom_bodyid != self._object)):
            centres, radius = _balls(model, int(geom))
            bodies += [int(model.geom_bodyid[geom])] * len(centres)
            offsets.append(centres)
            radii += [radius] * len(centres)
        self._body = np.array(bodies, int)
        self._offset = np.concatenate(offsets) if offsets else np.zeros((0, 3))
        self.radius = np.array(radii)
        self.finger = owner[self._body]
        self.fingers = hand.n_fingers
        tips = [model.body(name).id for name in hand.fingertip_bodies]
        self.tip: Bools = np.isin(self._body, tips)

    def centres(self, q: Floats) -> Floats:
        """Where the balls are in postures ``(n, d)``, ``(n, b, 3)`` [m]."""
        model, data = self._model, self._data
        position = np.empty((len(q), model.nbody, 3))
        rotation = np.empty((len(q), model.nbody, 9))
        for i, row in enumerate(q):
            data.qpos[self._columns] = row
            set_followers(data.qpos, self._followers)
            mujoco.mj_kinematics(model, data)
            position[i], rotation[i] = data.xpos, data.xmat
        turned = rotation.reshape(len(q), -1, 3, 3)[:, self._body] @ self._offset[:, :, None]
        return position[:, self._body] + turned[..., 0]

    def crosses_itself(self, q: Floats, depth: float = 0.001) -> bool:
        """Whether links of a posture ``(d,)`` are in each other by more than ``depth`` [m]."""
        model, data = self._model, self._data
        data.qpos[self._columns] = q
        set_followers(data.qpos, self._followers)
        mujoco.mj_fwdPosition(model, data)
        own = model.geom_bodyid[data.contact.geom] != self._object
        return bool((own.all(axis=-1) & (data.contact.dist < -depth)).any())


Followers = list[tuple[int, int, Floats]]


def followers(model: mujoco.MjModel) -> Followers:
    """Joints that a joint equality couples to another: column in qpos, master's, polynomial."""
    found = []
    kind = int(mujoco.mjtEq.mjEQ_JOINT)
    for i in np.flatnonzero((model.eq_type == kind) & (model.eq_obj2id >= 0)):
        own, master = (int(model.jnt_qposadr[j]) for j in (model.eq_obj1id[i], model.eq_obj2id[i]))
        polynomial = model.eq_data[i, :5].copy()
        polynomial[0] += model.qpos0[own]
        found.append((own, master, polynomial))
    return found


def set_followers(qpos: Floats, coupled: Followers) -> None:
    """Put the joints that follow others where these take them, in ``qpos``."""
    for own, master, polynomial in coupled:
        qpos[own] = np.polynomial.polynomial.polyval(qpos[master], polynomial)


def _owners(model: mujoco.MjModel, hand: HandModel) -> NDArray[np.intp]:
    """The finger of each body, ``(nbody,)``: the one fingertip that hangs on it, or on its parent.

    -1 where there are several, or none at all.
    """
    carries = np.zeros((model.nbody, hand.n_fingers), bool)
    for finger, name in enumerate(hand.fingertip_bodies):
        body = model.body(name).id
        while body > 0:
            carries[body, finger] = True
            body = int(model.body_parentid[body])
    owner = np.full(model.nbody, -1)
    for body in range(1, model.nbody):
        if carries[body].sum() == 1:
            owner[body] = carries[body].argmax()
        elif not carries[body].any():
            owner[body] = owner[model.body_parentid[body]]
    return owner


def _balls(model: mujoco.MjModel, geom: int) -> tuple[Floats, float]:
    """Centres ``(n, 3)`` in the body's frame and the radius of the balls of one geom."""
    kinds, kind, size = mujoco.mjtGeom, int(model.geom_type[geom]), model.geom_size[geom]
    radius = 0.0
    if kind == kinds.mjGEOM_SPHERE:
        points, radius = np.zeros((1, 3)), float(size[0])
    elif kind == kinds.mjGEOM_CAPSULE:
        radius = float(size[0])
        points = _line(float(size[1]), radius)[:, None] * [0.0, 0.0, 1.0]
    elif kind == kinds.mjGEOM_BOX:
        points = _shell(size)
    elif kind == kinds.mjGEOM_CYLINDER:
        points = _rounded(size[[0, 0, 1]], 2)
    elif kind == kinds.mjGEOM_ELLIPSOID:
        points = _rounded(size, 3)
    elif kind == kinds.mjGEOM_MESH:
        mesh = int(model.geom_dataid[geom])
        first = int(model.mesh_vertadr[mesh])
        vertices = model.mesh_vert[first : first + int(model.mesh_vertnum[mesh])].astype(float)
        points = _of_hull(vertices)
    else:  # planes and height fields: a floor, not the hand
        points = np.zeros((0, 3))
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    return points @ rotation.reshape(3, 3).T + model.geom_pos[geom], radius


def _line(half: float, spacing: float) -> Floats:
    return np.linspace(-half, half, max(2, int(np.ceil(2 * half / max(spacing, 1e-3))) + 1))


def _shell(half: Floats) -> Floats:
    """A lattice on the surface of a box."""
    axes = [_line(float(h), _SPACING) for h in half]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return grid[(np.abs(np.abs(grid) - half) < 1e-12).any(axis=-1)]


def _rounded(half: Floats, axes: int) -> Floats:
    """The same on a cylinder (round in the first two axes) or an ellipsoid (in all three)."""
    points = _shell(half)
    part = points[:, :axes] / half[:axes]
    length = np.linalg.norm(part, axis=-1, keepdims=True)
    points[:, :axes] *= np.abs(part).max(-1, keepdims=True) / np.where(length > 0, length, 1.0)
    return points


def _of_hull(vertices: Floats) -> Floats:
    """Vertices of the hull and points of its faces, spread out."""
    hull = ConvexHull(vertices)
    points = np.concatenate([vertices[hull.vertices], vertices[hull.simplices].mean(axis=1)])
    chosen = [0]
    away = np.linalg.norm(points - points[0], axis=-1)
    while len(chosen) < min(_MOST, len(points)) and away.max() > _SPACING / 2:
        chosen.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(points - points[chosen[-1]], axis=-1))
    return points[chosen]
