"""HandGeometry: where a scene's fingertips and links are, for many joint vectors at once.

Forward kinematics without physics, over whole batches level by level of the hand's tree, which is
several times as fast as one row after the other. Fingertips are balls, links are covered by balls;
what is asked of them are distances.
"""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from dexctl.exceptions import InvalidInput
from dexctl.rotations import cross
from dexctl.sim.scene import Scene
from dexctl.state import Bools, Floats

_KINDS = mujoco.mjtGeom
_MOVING = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)


class Balls(NamedTuple):
    """K balls, each fixed to a link.

    Attributes:
        link: what they are fixed to: a moving link, -1 for the world, ``(K,)``.
        centre: in the link's frame, ``(K, 3)`` [m].
        radius: ``(K,)`` [m].
        finger: which finger they are of, -1 for none ``(K,)``.
    """

    link: NDArray[np.intp]
    centre: Floats
    radius: Floats
    finger: NDArray[np.intp]


class LinkPoses(NamedTuple):
    """Moving links of N hands.

    Attributes:
        position: origins ``(N, L, 3)`` [m].
        rotation: ``(N, L, 3, 3)``, from the link's frame to the world's.
        axis: of each link's joint, ``(N, L, 3)``.
        anchor: a point on it, ``(N, L, 3)`` [m].
    """

    position: Floats
    rotation: Floats
    axis: Floats
    anchor: Floats

    def centres(self, balls: Balls) -> Floats:
        """Where balls are, ``(N, K, 3)`` [m]."""
        moved = (self.rotation[:, balls.link] @ balls.centre[..., None])[..., 0]
        return np.where(balls.link[:, None] < 0, balls.centre, self.position[:, balls.link] + moved)


class HandGeometry:
    """The hand of a scene.

    Attributes:
        tips: the ball that each fingertip touches with, m of them.
        links: balls that cover the links below the fingertips.
        chain: whether each moving link moves each fingertip, ``(m, L)``.
        own: which entries of `HandModel.finger_joints` are joints and no filling, ``(m, n)``.
        depth: how many moving links each link has between it and the world, ``(L,)``.

    Raises:
        InvalidInput: joints that follow others, or a fingertip that is neither ball nor capsule.
    """

    def __init__(self, scene: Scene) -> None:
        self._model, self.hand = scene.model, scene.hand
        self._collect_links()
        self.tips = self._find_tips()
        self.links = self._cover_links()

    def _collect_links(self) -> None:
        model, hand = self._model, self.hand
        order = {name: i for i, name in enumerate(hand.joint_names)}
        link_of_body, parents, joints = {0: -1}, [], []
        pose = {0: (np.zeros(3), np.eye(3))}  # of each body in the frame of its link
        offsets: list[tuple[np.ndarray, np.ndarray]] = []
        masses: list[tuple[int, float, np.ndarray]] = []
        for body in range(1, model.nbody):
            name, above = model.body(body).name, int(model.body_parentid[body])
            if name == "object":
                continue
            position, rotation = pose[above]
            position = position + rotation @ model.body_pos[body]
            rotation = rotation @ _matrix(model.body_quat[body])
            link = link_of_body[above]
            first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
            for joint in range(first, first + count):
                if model.joint(joint).name not in order:
                    if _is_led(model, joint):
                        raise InvalidInput(
                            f"{hand.name}: the joint {model.joint(joint).name!r} follows another; "
                            "planning without physics is for hands whose joints all have servos"
                        )
                    continue  # it moves no fingertip
                anchor = model.jnt_pos[joint]
                # the link's frame is the body's, moved to the joint's anchor
                offsets.append((position + rotation @ anchor, rotation))
                parents.append(link)
                joints.append(joint)
                link, position, rotation = len(joints) - 1, -anchor, np.eye(3)
            link_of_body[body], pose[body] = link, (position, rotation)
            if link >= 0:
                masses.append(
                    (
                        link,
                        float(model.body_mass[body]),
                        position + rotation @ model.body_ipos[body],
                    )
                )
        self._body_link, self._body_pose = link_of_body, pose
        self._parent = np.array(parents, np.intp)
        self._offset = np.array([offset for offset, _ in offsets])
        self._turn = np.array([turn for _, turn in offsets])
        self._columns = np.array([order[model.joint(j).name] for j in joints], np.intp)
        self._slides: Bools = np.asarray(model.jnt_type[joints] == mujoco.mjtJoint.mjJNT_SLIDE)
        self._axis = model.jnt_axis[joints].copy()
        self._reference = model.qpos0[model.jnt_qposadr[joints]].copy()
        # row i of the cross product is e_i x a; column i of the matrix of a x ... is its negative
        self._skew = -np.swapaxes(np.cross(np.eye(3), self._axis[:, None]), 1, 2)
        depth = np.zeros(len(joints), int)
        for i, above in enumerate(parents):
            depth[i] = depth[above] + 1 if above >= 0 else 0
        self.depth = depth
        self._levels = [np.flatnonzero(depth == k) for k in range(depth.max() + 1)]
        self._below: Bools = np.eye(len(joints), dtype=bool)  # which links each joint carries
        for i, above in reversed(list(enumerate(parents))):
            if above >= 0:
                self._below[above] |= self._below[i]
        self._mass, self._centre = np.zeros(len(joints)), np.zeros((len(joints), 3))
        for link, mass, centre in masses:
            self._mass[link] += mass
            self._centre[link] += mass * centre
        self._centre /= np.maximum(self._mass, 1e-12)[:, None]
        tips = [link_of_body[model.body(name).id] for name in hand.fingertip_bodies]
        self.chain: Bools = np.zeros((len(tips), len(joints)), bool)
        for finger, link in enumerate(tips):
            while link >= 0:
                self.chain[finger, link] = True
                link = parents[link]
        # the link of each of the finger's joints, as `HandModel.finger_joints` orders them
        where = {int(column): link for link, column in enumerate(self._columns)}
        self._finger_links = np.vectorize(where.__getitem__)(hand.finger_joints)
        self.own: Bools = np.arange(hand.finger_joints.shape[1]) < hand.moves.sum(axis=1)[:, None]

    def poses(self, q: Floats) -> LinkPoses:
        """The links at joint positions ``(N, d)`` [rad]."""
        count, links = len(q), len(self._parent)
        position, rotation = np.empty((count, links, 3)), np.empty((count, links, 3, 3))
        axis = np.empty((count, links, 3))
        moved = q[:, self._columns] - self._reference
        for level in self._levels:
            above = self._parent[level]
            base, angle = self._turn[level], moved[:, level]
            origin = np.broadcast_to(self._offset[level], (count, len(level), 3))
            frame = np.broadcast_to(base, (count, len(level), 3, 3))
            if above[0] >= 0:
                over = rotation[:, above]
                origin = position[:, above] + (over @ self._offset[level][..., None])[..., 0]
                frame = over @ base
            axis[:, level] = (frame @ self._axis[level][..., None])[..., 0]
            slides = self._slides[level]
            turn = np.where(slides, 0.0, angle)[..., None, None]
            skew = self._skew[level]
            local = np.eye(3) + np.sin(turn) * skew + (1 - np.cos(turn)) * (skew @ skew)
            rotation[:, level] = frame @ local
            shift = np.where(slides, angle, 0.0)[..., None]
            position[:, level] = origin + shift * axis[:, level]
        return LinkPoses(position, rotation, axis, position)

    def tip_jacobian(self, poses: LinkPoses, tip: Floats) -> Floats:
        """Velocities of points ``tip`` ``(N, m, 3)`` on the distal links by their own joints.

        ``(N, m, 3, n)``, n as in `HandModel.finger_joints`; columns that fill up are zero.
        """
        axis, anchor = poses.axis[:, self._finger_links], poses.anchor[:, self._finger_links]
        arm = tip[:, :, None] - anchor
        turning = np.stack(
            [
                axis[..., 1] * arm[..., 2] - axis[..., 2] * arm[..., 1],
                axis[..., 2] * arm[..., 0] - axis[..., 0] * arm[..., 2],
                axis[..., 0] * arm[..., 1] - axis[..., 1] * arm[..., 0],
            ],
            axis=-1,
        )
        slides = self._slides[self._finger_links][..., None]
        columns = np.where(slides, axis, turning) * self.own[..., None]
        return np.swapaxes(columns, -1, -2)

    def carrying(self, poses: LinkPoses, gravity: Floats) -> Floats:
        """Torques of the joints that carry the links' own weight, ``(N, d)`` [N m]."""
        weight = self._mass[:, None] * gravity
        centre = poses.position + (poses.rotation @ self._centre[..., None])[..., 0]
        below = self._below.astype(float)
        force = below @ weight
        moment = below @ cross(centre, weight) - cross(poses.anchor, force)
        pull = np.where(self._slides[:, None], force, moment)
        torque = np.zeros((len(centre), self.hand.nq))
        torque[:, self._columns] = -(poses.axis * pull).sum(axis=-1)
        return torque

    def _find_tips(self) -> Balls:
        """The balls that the fingertips touch with: a sphere, or the outer end of a capsule.

        Where there is neither, as on a mesh, the ball that the hand's toml says is at the tip.
        """
        model, hand = self._model, self.hand
        links, centres, radii = [], [], []
        for finger, name in enumerate(hand.fingertip_bodies):
            body, best = model.body(name).id, (np.inf, np.zeros(3), 0.0)
            for geom in _solid(model, body):
                for centre, radius in _ends(model, geom):
                    away = float(np.linalg.norm(centre - hand.fingertip_offsets[finger]))
                    best = min(best, (away, centre, radius), key=lambda one: one[0])
            if not np.isfinite(best[0]):
                radius = hand.config.fingertip_radius
                if not radius:
                    raise InvalidInput(
                        f"{hand.name}: the fingertip {hand.fingertip_names[finger]!r} is neither a "
                        "sphere nor a capsule, and planning without physics needs one; write "
                        "fingertip_radius [m] of the ball at its tip point into the hand's toml"
                    )
                best = (0.0, hand.fingertip_offsets[finger], radius)
            position, rotation = self._body_pose[body]
            links.append(self._body_link[body])
            centres.append(position + rotation @ best[1])
            radii.append(best[2])
        fingers = np.arange(hand.n_fingers)
        return Balls(np.array(links, np.intp), np.array(centres), np.array(radii), fingers)

    def _cover_links(self) -> Balls:
        model, tips = self._model, set(self.hand.fingertip_bodies)
        found: list[tuple[int, Floats, float, int]] = []
        for body, link in self._body_link.items():
            if link < 0 or model.body(body).name in tips:
                continue
            fingers = np.flatnonzero(self.chain[:, link])
            finger = int(fingers[0]) if len(fingers) == 1 else -1
            position, rotation = self._body_pose[body]
            for geom in _solid(model, body):
                found += [
                    (link, position + rotation @ centre, radius, finger)
                    for centre, radius in _cover(model, geom)
                ]
        links, centres, radii, owners = zip(*found, strict=True) if found else ((), (), (), ())
        return Balls(
            np.array(links, np.intp),
            np.array(centres).reshape(-1, 3),
            np.array(radii, float),
            np.array(owners, np.intp),
        )


def _solid(model: mujoco.MjModel, body: int) -> list[int]:
    geoms = np.flatnonzero(model.geom_bodyid == body)
    return [int(g) for g in geoms if model.geom_contype[g] or model.geom_conaffinity[g]]


def _is_led(model: mujoco.MjModel, joint: int) -> bool:
    """Whether a joint follows another by an equality."""
    led = model.eq_type == mujoco.mjtEq.mjEQ_JOINT
    return bool((led & (model.eq_obj1id == joint) & (model.eq_obj2id >= 0)).any())


def _ends(model: mujoco.MjModel, geom: int) -> list[tuple[Floats, float]]:
    kind, size, centre = model.geom_type[geom], model.geom_size[geom], model.geom_pos[geom]
    if kind == _KINDS.mjGEOM_SPHERE:
        return [(centre.copy(), float(size[0]))]
    if kind == _KINDS.mjGEOM_CAPSULE:
        along = _matrix(model.geom_quat[geom])[:, 2] * size[1]
        return [(centre + along, float(size[0])), (centre - along, float(size[0]))]
    return []


def _cover(model: mujoco.MjModel, geom: int) -> list[tuple[Floats, float]]:
    """Balls in a row inside a geom, along its longest direction."""
    kind, size, centre = model.geom_type[geom], model.geom_size[geom], model.geom_pos[geom]
    turn = _matrix(model.geom_quat[geom])
    if kind == _KINDS.mjGEOM_SPHERE:
        return [(centre.copy(), float(size[0]))]
    if kind in (_KINDS.mjGEOM_CAPSULE, _KINDS.mjGEOM_CYLINDER):
        radius, along, half = float(size[0]), turn[:, 2], float(size[1])
        half = half if kind == _KINDS.mjGEOM_CAPSULE else max(half - radius, 0.0)
    else:  # a box, or the box around a mesh
        sides = size if kind == _KINDS.mjGEOM_BOX else model.geom_aabb[geom, 3:]
        centre = centre if kind == _KINDS.mjGEOM_BOX else centre + turn @ model.geom_aabb[geom, :3]
        longest = int(np.argmax(sides))
        radius = float(np.delete(sides, longest).min())
        along, half = turn[:, longest], max(float(sides[longest]) - radius, 0.0)
    steps = max(1, int(np.ceil(2 * half / max(1.5 * radius, 1e-4)))) if half else 0
    return [(centre + s * along, radius) for s in np.linspace(-half, half, steps + 1)]


def _matrix(quaternion: Floats) -> Floats:
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, quaternion)
    return out.reshape(3, 3)
