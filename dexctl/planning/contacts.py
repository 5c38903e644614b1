"""Contacts without physics: fingertips on an object's surface, moved with it, let go and put down.

A fingertip is a ball, its contact the point of the object's surface nearest to the ball's centre;
it stays there while the object moves, and the ball rolls on it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dexctl.exceptions import InvalidInput
from dexctl.grasp import is_force_closure
from dexctl.igm import stable_forces
from dexctl.rotations import inverse, rotate
from dexctl.state import Bools, Floats

if TYPE_CHECKING:
    from dexctl.sim import Scene
    from dexctl.sim.hand_geometry import LinkPoses

_TOUCHING = 1e-4  # how deep a ball that touches is in the surface [m]
_WEAKEST = 0.2  # least share of a finger that touches
_NEWTON = 12  # steps of inverse kinematics at most
_DAMPING = 1e-6  # of its least squares [m^2]
_MISSED = 2e-4  # a ball further than this from its place has not reached it [m]


class Reached(NamedTuple):
    """Postures found by inverse kinematics.

    Attributes:
        q: ``(N, d)`` [rad].
        poses: the links there.
        tip: the balls there, ``(N, m, 3)`` [m].
        good: whose wanted balls are in their places, within the joint limits, ``(N,)``.
    """

    q: Floats
    poses: LinkPoses
    tip: Floats
    good: Bools

    def take(self, index: NDArray[np.intp] | Bools) -> Reached:
        """Some of them, copied."""
        poses = self.poses._make(part[index] for part in self.poses)
        return Reached(self.q[index], poses, self.tip[index], self.good[index])

    def put(self, rows: NDArray[np.intp], new: Reached) -> None:
        """Write others over ``rows``."""
        for part, value in zip(self.poses, new.poses, strict=True):
            part[rows] = value
        self.q[rows], self.tip[rows], self.good[rows] = new.q, new.tip, new.good


class Clearance(NamedTuple):
    """How far a hand keeps off what it should not touch; negative where it is inside.

    Attributes:
        links: the nearest of the links below the fingertips to the object's surface, ``(...)`` [m].
        fingertips: each to the object's surface, ``(..., m)`` [m]; about 0 where it touches.
        fingers: the nearest two of different fingers to each other, ``(...)`` [m].
    """

    links: Floats
    fingertips: Floats
    fingers: Floats


def link_clearance(
    scene: Scene, q: ArrayLike, object_position: ArrayLike, object_quaternion: ArrayLike
) -> Clearance:
    """How far links keep off the object and fingers off each other, without physics.

    Links are covered by balls inside of them, as `Kinematic` sees them (its ``margin``), so corners
    of a link may be nearer by some millimetres.

    Args:
        scene: hand and object; the simulated state of it does not matter.
        q: ``(..., d)`` [rad].
        object_position: ``(..., 3)`` [m].
        object_quaternion: wxyz, ``(..., 4)``.

    Raises:
        InvalidInput: arrays of other shapes, or a hand that `Kinematic` is not for.
    """
    joints, position, quaternion = (
        np.asarray(value, float) for value in (q, object_position, object_quaternion)
    )
    batch = joints.shape[:-1]
    for name, value, width in (
        ("q", joints, scene.hand.nq),
        ("object_position", position, 3),
        ("object_quaternion", quaternion, 4),
    ):
        if value.shape != (*batch, width):
            raise InvalidInput(f"{name} has shape {value.shape}; expected {(*batch, width)}")
    model = ContactModel(scene, friction=0.5, margin=0.0)
    poses = model.geometry.poses(joints.reshape(-1, scene.hand.nq))
    found = model.clearance(poses, position.reshape(-1, 3), quaternion.reshape(-1, 4))
    return Clearance(*(part.reshape((*batch, *part.shape[1:])) for part in found))


class ContactModel:
    """Hand and object of a scene as contacts see them.

    Args:
        scene: hand and object.
        friction: assumed by the closure test.
        margin: how far links stay away from the object and from other fingers [m].
    """

    def __init__(self, scene: Scene, friction: float, margin: float) -> None:
        from dexctl.sim.hand_geometry import HandGeometry
        from dexctl.sim.shapes import Shape

        self.scene, self.hand = scene, scene.hand
        self.geometry = HandGeometry(scene)
        self.shape = Shape.of_body(scene.model)
        self.friction, self.margin = friction, margin
        self._joints = np.where(self.geometry.own, self.hand.finger_joints, -1)
        self._between = self._pairs()

    def _pairs(self) -> NDArray[np.intp]:
        """Pairs of balls, tips behind the links, of different fingers, that may meet."""
        links, tips = self.geometry.links, self.geometry.tips
        finger = np.concatenate([links.finger, tips.finger])
        link = np.concatenate([links.link, tips.link])
        # the outer halves of fingers meet; what is near the palm does not
        depth = np.array([int(self.geometry.depth[i]) if i >= 0 else -1 for i in link])
        outer = np.array(
            [d >= self.geometry.depth[t] for d, t in zip(depth, tips.link[finger], strict=True)]
        )
        chosen = np.flatnonzero(outer & (finger >= 0))
        first, second = np.triu_indices(len(chosen), 1)
        a, b = chosen[first], chosen[second]
        return np.stack([a, b])[:, finger[a] != finger[b]]

    def surface(self, tip: Floats, position: Floats, quaternion: Floats) -> tuple[Floats, Floats]:
        """Nearest points of the surface to balls ``(N, m, 3)``, and the normals into the object.

        World frame, ``(N, m, 3)`` each.
        """
        turn = np.broadcast_to(quaternion[:, None], (*tip.shape[:2], 4))
        local = rotate(inverse(turn), tip - position[:, None])
        point, outward = self.shape.nearest(local)
        return rotate(turn, point) + position[:, None], -rotate(turn, outward)

    def on_surface(self, tip: Floats, position: Floats, quaternion: Floats) -> Floats:
        """The places of balls ``(N, m, 3)`` that just touch, in the object's frame.

        Inverse kinematics is not exact: without this, errors of many edges would add up to gaps.
        """
        turn = np.broadcast_to(quaternion[:, None], (*tip.shape[:2], 4))
        point, outward = self.shape.nearest(rotate(inverse(turn), tip - position[:, None]))
        return point + (self.geometry.tips.radius - _TOUCHING)[:, None] * outward

    def closed(self, point: Floats, normal: Floats, touch: Bools, origin: Floats) -> Bools:
        """Whether at least three contacts hold, as a force closure, ``(N,)``."""
        found = touch.sum(axis=1) >= 3
        rows = np.flatnonzero(found)
        if len(rows):
            found[rows] = is_force_closure(
                point[rows], normal[rows], touch[rows], origin[rows], self.friction
            )
        return found

    def reach(self, q: Floats, goal: Floats, wanted: Bools) -> Reached:
        """Joints that bring the balls ``wanted`` ``(N, m)`` to ``goal`` ``(N, m, 3)``, from ``q``.

        Newton's method, damped; joints stop at their limits.
        """
        q = q.copy()
        lower, upper = self.scene.lower, self.scene.upper
        poses = self.geometry.poses(q)
        tip = poses.centres(self.geometry.tips)
        open_ = np.arange(len(q))
        for _ in range(_NEWTON):
            error = np.where(wanted[open_, :, None], goal[open_] - tip[open_], 0.0)
            far = np.abs(error).max(axis=(1, 2)) > 0.25 * _MISSED
            open_, error = open_[far], error[far]
            if not len(open_):
                break
            some = poses._make(part[open_] for part in poses)
            jacobian = self.geometry.tip_jacobian(some, tip[open_])
            length = np.linalg.norm(error, axis=-1, keepdims=True)
            error = error * np.minimum(1.0, 0.03 / np.maximum(length, 1e-12))
            gram = jacobian @ np.swapaxes(jacobian, -1, -2) + _DAMPING * np.eye(3)
            step = np.swapaxes(jacobian, -1, -2) @ np.linalg.solve(gram, error[..., None])
            q[open_] = np.clip(q[open_] + self.joints_of(step[..., 0]), lower, upper)
            moved = self.geometry.poses(q[open_])
            for part, new in zip(poses, moved, strict=True):
                part[open_] = new
            tip[open_] = moved.centres(self.geometry.tips)
        error = np.where(wanted[..., None], goal - tip, 0.0)
        good: Bools = np.asarray(np.linalg.norm(error, axis=-1).max(axis=1) < _MISSED)
        return Reached(q, poses, tip, good)

    def joints_of(self, finger_motion: Floats) -> Floats:
        """Motions of each finger's joints ``(N, m, n)`` as motions of the d joints, ``(N, d)``."""
        count, d = len(finger_motion), self.hand.nq
        out = np.zeros((count, d + 1))
        out[:, self._joints.ravel()] = finger_motion.reshape(count, self._joints.size)
        return out[:, :d]

    def clear(self, reached: Reached, touch: Bools, position: Floats, quaternion: Floats) -> Bools:
        """Whether links keep off the object, free fingertips too, and fingers off each other."""
        links, tips = self.geometry.links, self.geometry.tips
        balls = reached.poses.centres(links)
        turn = np.broadcast_to(quaternion[:, None], (*balls.shape[:2], 4))
        local = rotate(inverse(turn), balls - position[:, None])
        free = self._off(local, np.broadcast_to(links.radius + self.margin, local.shape[:2]))
        turn = np.broadcast_to(quaternion[:, None], (*touch.shape, 4))
        local = rotate(inverse(turn), reached.tip - position[:, None])
        off = self._off(local, np.broadcast_to(tips.radius + self.margin, touch.shape))
        every = np.concatenate([balls, reached.tip], axis=1)
        radius = np.concatenate([links.radius, tips.radius])
        a, b = self._between
        apart = np.linalg.norm(every[:, a] - every[:, b], axis=-1)
        met = (apart < radius[a] + radius[b] + self.margin).any(axis=1)
        return free.all(axis=1) & (off | touch).all(axis=1) & ~met

    def clearance(self, poses: LinkPoses, position: Floats, quaternion: Floats) -> Clearance:
        """See `link_clearance`; what `clear` asks of it more quickly."""
        links, tips = self.geometry.links, self.geometry.tips
        every = np.concatenate([poses.centres(links), poses.centres(tips)], axis=1)
        radius = np.concatenate([links.radius, tips.radius])
        turn = np.broadcast_to(quaternion[:, None], (*every.shape[:2], 4))
        away = self.shape.distance(rotate(inverse(turn), every - position[:, None])) - radius
        a, b = self._between
        apart = np.linalg.norm(every[:, a] - every[:, b], axis=-1) - radius[a] - radius[b]
        below = len(links.radius)
        return Clearance(
            away[:, :below].min(axis=1, initial=np.inf),
            away[:, below:],
            apart.min(axis=1, initial=np.inf),
        )

    def _off(self, local: Floats, radius: Floats) -> Bools:
        """Whether the surface is further than ``radius`` from points in the object's frame."""
        found = np.linalg.norm(local, axis=-1) > self.shape.radius + radius
        for distance in (self.shape.bound, self.shape.distance):  # the cheap one first
            near = ~found
            if near.any():
                found[near] = distance(local[near]) > radius[near]
        return found

    def pressed(
        self,
        reached: Reached,
        point: Floats,
        normal: Floats,
        touch: Bools,
        origin: Floats,
        force: float,
    ) -> tuple[Floats, Floats]:
        """Set-points whose servos press with ``force`` [N] and carry hand and object, ``(N, d)``.

        The force is that of the mean finger; the shares are those of the stability QP, which leave
        the least wrench on the object: a thumb presses as much as the fingers against it together.
        And what wrench they leave, which friction has to hold, as a share of the grip ``(N,)``.
        """
        scene, lever = self.scene, point - origin[:, None]
        shares, residual, _ = stable_forces(
            lever, normal, touch, touch.astype(float),
            min_force=_WEAKEST, regulariser=1e-3, length=None,
        )  # fmt: skip
        mean = shares.sum(axis=1) / np.maximum(touch.sum(axis=1), 1)
        each = force * shares / np.maximum(mean, 0.5)[:, None]
        share = np.maximum(touch.sum(axis=1), 1)[:, None, None]
        weight = -scene.object_mass * scene.gravity / share
        push = np.where(touch[..., None], each[..., None] * normal + weight, 0.0)
        jacobian = self.geometry.tip_jacobian(
            reached.poses, np.where(touch[..., None], point, reached.tip)
        )
        torque = np.swapaxes(jacobian, -1, -2) @ push[..., None]
        carried = self.geometry.carrying(reached.poses, scene.gravity)
        target = reached.q + (self.joints_of(torque[..., 0]) + carried) / scene.stiffness
        return np.clip(target, scene.lower, scene.upper), residual
