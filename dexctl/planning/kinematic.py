"""Kinematic: trees without physics, on the manifolds of the contacts (M-RRT).

The thesis's chapter 5 names M-RRT and leaves its description to the conference paper behind it
(Khandate et al., "Sampling-based Exploration for Reinforcement Learning of Dexterous
Manipulation", RSS 2023): motions towards a target are projected on those that keep the contacts,
fingers are moved when at least three others hold.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dexctl.exceptions import InvalidInput
from dexctl.planning.contacts import ContactModel, Reached
from dexctl.planning.expansion import Expander, Expansion, Offspring, Problem
from dexctl.planning.nodes import Nodes
from dexctl.rotations import inverse, multiply, rotate
from dexctl.state import Bools, Floats
from dexctl.switch.landing import azimuth, split, turned
from dexctl.validation import check_numbers, check_whole

_SWITCH_TIME, _TURNING_SPEED = 1.5, 0.35  # for the cost of an edge [s], [rad/s]


@dataclass(frozen=True, kw_only=True)
class Kinematic(Expansion):
    """M-RRT: at most one finger is moved to another place, then the object with all that hold it.

    No physics: grasps are closures of at least three contacts whose links are clear, and their
    set-points press. Whether they hold in simulation is for `verify` to say; nearly all do.
    """

    step: float = 0.2
    """Greatest rotation or tilt of the object in an edge [rad]."""
    shift: float = 0.005
    """Greatest displacement of the object in an edge [m]."""
    substeps: int = 2
    """An edge is checked at so many places."""
    switch: float = 0.6
    """Share of expansions that move a finger first."""
    guided: float = 0.5
    """Share of those that move the finger which has gone furthest with the object, back against
    the rotation; the others move a random one."""
    landing: float = 0.6
    """Landings lie within this about the axis of where the finger was at the root [rad]."""
    height: float = 0.01
    """And within this of the object's centre along the axis [m]."""
    friction: float = 0.7
    """Assumed by the closure test; below the real one."""
    margin: float = 0.002
    """How far links stay away from the object and from other fingers [m]."""
    force: float = 2.0
    """With which each finger is pressed on [N]."""
    batch: int = 256
    """How many nodes are expanded at a time."""

    def __post_init__(self) -> None:
        check_numbers(
            self,
            positive=("step", "shift", "landing", "friction", "force"),
            not_negative=("height", "margin"),
            fractions=("switch", "guided"),
        )
        check_whole(self, substeps=1, batch=1)

    def open(self, problem: Problem) -> Expander:
        return _KinematicExpander(self, problem)


class _KinematicExpander:
    action_names = (
        "twist_x", "twist_y", "twist_z", "twist_rx", "twist_ry", "twist_rz",
        "finger", "landing_x", "landing_y", "landing_z",
    )  # fmt: skip

    def __init__(self, config: Kinematic, problem: Problem) -> None:
        scene, frame = problem.scene, problem.frame
        if scene.hand.n_fingers < 3:
            raise InvalidInput(f"{scene.hand.name} has fewer than three fingers; expected more")
        self._config, self._problem, self.batch = config, problem, config.batch
        self._model = ContactModel(scene, config.friction, config.margin)
        geometry = self._model.geometry
        tip = geometry.poses(problem.root.q).centres(geometry.tips)[0]
        flat = split(tip - frame.position, frame.axis)[1]
        length = np.linalg.norm(flat, axis=-1, keepdims=True)
        self._neutral = flat / np.maximum(length, 1e-9)

    def close(self) -> None:
        """Nothing is held."""

    def __call__(
        self, nodes: Nodes, targets: NDArray[np.float32], rng: np.random.Generator
    ) -> Offspring:
        problem, model, config = self._problem, self._model, self._config
        count = len(nodes)
        poses = model.geometry.poses(nodes.q)
        tip = poses.centres(model.geometry.tips)
        start = Reached(nodes.q, poses, tip, np.ones(count, bool))
        touch = nodes.in_contact
        position, quaternion = nodes.object_position, nodes.object_quaternion
        point, normal = model.surface(tip, position, quaternion)
        towards = targets - problem.metric.of(problem.frame, nodes)
        turning = np.where(towards[:, -1] < 0, -1.0, 1.0)

        finger = self._choose(touch, tip, position, turning, rng)
        reached, touch, landing, refused = self._switch(
            start, touch, finger, point, normal, position, quaternion, turning, rng
        )
        good = reached.good
        rows = np.flatnonzero(good)
        moved = self._move(
            Reached(
                reached.q[rows], *_rows(reached, rows)
            ),
            touch[rows], position[rows], quaternion[rows], towards[rows].astype(float),
        )  # fmt: skip
        done, twist, position, quaternion = moved
        same = ~(np.abs(twist).max(axis=1) > 0) & (finger[rows] < 0)
        refused["clearance"] += int(same.sum())
        keep = np.flatnonzero(~same)
        made = self._nodes(nodes.take(rows[keep]), done, keep, touch[rows[keep]],
                           position[keep], quaternion[keep], twist[keep], finger[rows[keep]])  # fmt: skip
        within = problem.bounds.hold(problem.frame, made)
        refused["bounds"] += int((~within).sum())
        source = rows[keep][within]
        action = np.column_stack([twist[keep], finger[rows[keep]].astype(float), landing[rows[keep]]])
        return Offspring(made.take(within), source, action[within], refused, 0)

    def _choose(
        self, touch: Bools, tip: Floats, position: Floats, turning: Floats, rng: np.random.Generator
    ) -> NDArray[np.intp]:
        """The finger that each node moves, -1 for none."""
        config, frame, count = self._config, self._problem.frame, len(touch)
        flat = split(tip - position[:, None], frame.axis)[1]
        self._angle = azimuth(self._neutral, flat, frame.axis)
        finger = rng.integers(touch.shape[1], size=count)
        furthest = np.argmax(turning[:, None] * self._angle + rng.uniform(0, 0.2, touch.shape), axis=1)
        kind = rng.uniform(size=(2, count))
        self._guided = kind[1] < config.guided
        finger = np.where(self._guided, furthest, finger)
        return np.where(kind[0] < config.switch, finger, -1)

    def _switch(
        self,
        start: Reached,
        touch: Bools,
        finger: NDArray[np.intp],
        point: Floats,
        normal: Floats,
        position: Floats,
        quaternion: Floats,
        turning: Floats,
        rng: np.random.Generator,
    ) -> tuple[Reached, Bools, Floats, Counter[str]]:
        """Put fingers down elsewhere: where they land, and whether that is a grasp."""
        model, config, frame = self._model, self._config, self._problem.frame
        refused: Counter[str] = Counter()
        count = len(touch)
        landing = np.full((count, 3), np.nan)
        good = np.ones(count, bool)
        rows = np.flatnonzero(finger >= 0)
        if not len(rows):
            return start, touch, landing, refused
        own = finger[rows]
        where = np.where(
            self._guided[rows],
            -turning[rows] * rng.uniform(0.2, 1.0, len(rows)) * config.landing,
            rng.uniform(-config.landing, config.landing, len(rows)),
        )
        height = rng.uniform(-config.height, config.height, len(rows))
        direction = turned(self._neutral[own], where, frame.axis)
        inverse_turn = inverse(quaternion[rows])
        out = rotate(inverse_turn, direction)
        up = rotate(inverse_turn, np.broadcast_to(frame.axis, direction.shape))
        reach = 2.0 * model.shape.radius
        begin = height[:, None] * up + reach * out
        distance, outward = model.shape.ray(begin, -out)
        hit = np.isfinite(distance) & (distance < reach)
        local = begin - np.where(hit, distance, 0.0)[:, None] * out
        landing[rows] = np.where(hit[:, None], local, np.nan)
        radius = model.geometry.tips.radius[own]
        place = rotate(quaternion[rows], local + radius[:, None] * outward) + position[rows]

        others = touch[rows].copy()
        every = np.arange(len(rows))
        others[every, own] = False
        holds = hit & model.closed(point[rows], normal[rows], others, position[rows])
        refused["closure"] = int((~holds).sum())
        ask = np.flatnonzero(holds)
        good[rows] = False
        q, poses, tip = start.q.copy(), start.poses, start.tip.copy()
        touch = touch.copy()
        if len(ask):
            wanted = np.zeros((len(ask), touch.shape[1]), bool)
            wanted[np.arange(len(ask)), own[ask]] = True
            goal = np.where(wanted[..., None], place[ask][:, None], start.tip[rows[ask]])
            found = model.reach(start.q[rows[ask]], goal, wanted)
            now = others[ask] | wanted
            ok = found.good.copy()
            refused["reach"] = int((~ok).sum())
            at = rows[ask]
            clear = np.zeros(len(ask), bool)
            some = np.flatnonzero(ok)
            if len(some):
                clear[some] = model.clear(
                    Reached(found.q[some], *_rows(found, some)), now[some],
                    position[at[some]], quaternion[at[some]],
                )  # fmt: skip
            refused["clearance"] = int((ok & ~clear).sum())
            good[at] = ok & clear
            keep = np.flatnonzero(ok & clear)
            q[at[keep]], tip[at[keep]], touch[at[keep]] = found.q[keep], found.tip[keep], now[keep]
            for part, new in zip(poses, found.poses, strict=True):
                part[at[keep]] = new[keep]
        return Reached(q, poses, tip, good), touch, landing, refused

    def _move(
        self, start: Reached, touch: Bools, position: Floats, quaternion: Floats, towards: Floats
    ) -> tuple[Reached, Floats, Floats, Floats]:
        """Carry the object towards the target with all fingers that touch, as far as it goes."""
        model, config = self._model, self._config
        twist, free = self._projected(start, touch, position, towards)
        turn = np.linalg.norm(twist[:, 3:], axis=1)
        shift = np.linalg.norm(twist[:, :3], axis=1)
        scale = np.minimum(1.0, config.step / np.maximum(turn, 1e-9))
        scale = np.minimum(scale, config.shift / np.maximum(shift, 1e-9)) / config.substeps
        twist, free = twist * scale[:, None], free * scale[:, None]
        inward = rotate(inverse(quaternion)[:, None], start.tip - position[:, None])
        q, tip, poses = start.q.copy(), start.tip.copy(), start.poses
        total = np.zeros_like(twist)
        going = np.arange(len(q))
        position, quaternion = position.copy(), quaternion.copy()
        for _ in range(config.substeps):
            if not len(going):
                break
            ahead = position[going] + twist[going, :3]
            turned_by = _quaternion(twist[going, 3:])
            facing = multiply(turned_by, quaternion[going])
            goal = rotate(facing[:, None], inward[going]) + ahead[:, None]
            found = model.reach(q[going] + free[going], goal, touch[going])
            ok = found.good & model.clear(found, touch[going], ahead, facing)
            keep, going = np.flatnonzero(ok), going[ok]
            q[going], tip[going] = found.q[keep], found.tip[keep]
            for part, new in zip(poses, found.poses, strict=True):
                part[going] = new[keep]
            position[going], quaternion[going] = ahead[keep], facing[keep]
            total[going] += twist[going]
        return Reached(q, poses, tip, np.ones(len(q), bool)), total, position, quaternion

    def _projected(
        self, start: Reached, touch: Bools, position: Floats, towards: Floats
    ) -> tuple[Floats, Floats]:
        """The motion towards the target that keeps the contacts: I - N^+ N in the metric.

        Rows of N are the velocities between fingertips and object at the contacts; they are zero
        for fingers that touch nothing. The object's twist ``(N, 6)``, and the motion of the joints
        of fingers that are free ``(N, d)``.
        """
        model, frame, metric = self._model, self._problem.frame, self._problem.metric
        count, m, d = len(touch), touch.shape[1], model.hand.nq
        jacobian = model.geometry.tip_jacobian(start.poses, start.tip)
        constraint = np.zeros((count, m, 3, d + 6))
        full = np.swapaxes(jacobian, -1, -2)  # (N, m, n, 3)
        for finger in range(m):
            own = model.hand.finger_joints[finger, : int(model.hand.moves[finger].sum())]
            constraint[:, finger, :, own] = np.swapaxes(full[:, finger, : len(own)], 0, 1)
        arm = start.tip - position[:, None]
        constraint[..., d : d + 3] = -np.eye(3)
        zero = np.zeros(arm.shape[:-1])
        x, y, z = arm[..., 0], arm[..., 1], arm[..., 2]
        skew = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*arm.shape[:-1], 3, 3)
        constraint[..., d + 3 :] = skew  # -(w x r) = [r]x w
        constraint *= touch[..., None, None]
        # what is wanted, in the metric's coordinates; those without weight cost next to nothing
        weight = np.concatenate(
            [np.full(d, metric.joints), np.full(3, metric.position), np.full(2, metric.tilt),
             [metric.rotation]]
        )  # fmt: skip
        weight = np.maximum(weight, 1e-3)
        basis = np.zeros((6, 6))  # object coordinates (position, tilt, rotation) to its twist
        basis[:3, :3] = np.eye(3)
        first, second = frame.across
        # w x axis = t1 e1 + t2 e2, with e2 = axis x e1
        basis[3:, 3], basis[3:, 4], basis[3:, 5] = second, -first, frame.axis
        into = np.zeros((d + 6, d + 6))
        into[:d, :d], into[d:, d:] = np.eye(d), basis
        into = into / weight
        scaled = (constraint.reshape(count, 3 * m, d + 6)) @ into
        gram = scaled @ np.swapaxes(scaled, 1, 2)
        gram += 1e-9 * np.eye(3 * m) * np.maximum(np.trace(gram, axis1=1, axis2=2), 1e-9)[:, None, None]
        violation = scaled @ towards[..., None]
        kept = towards - (np.swapaxes(scaled, 1, 2) @ np.linalg.solve(gram, violation))[..., 0]
        motion = kept @ into.T
        joints = np.clip(motion[:, :d], -0.5, 0.5)
        held = (touch @ model.hand.moves.astype(int)) > 0
        return motion[:, d:], np.where(held, 0.0, joints)

    def _nodes(
        self,
        parents: Nodes,
        done: Reached,
        keep: NDArray[np.intp],
        touch: Bools,
        position: Floats,
        quaternion: Floats,
        twist: Floats,
        finger: NDArray[np.intp],
    ) -> Nodes:
        model, frame = self._model, self._problem.frame
        some = Reached(done.q[keep], *_rows(done, keep))
        point, normal = model.surface(some.tip, position, quaternion)
        count, d = some.q.shape
        turn = np.linalg.norm(twist[:, 3:], axis=1)
        seconds = np.maximum(turn / _TURNING_SPEED, np.where(finger >= 0, _SWITCH_TIME, 0.0))
        return Nodes(
            q=some.q,
            q_target=model.pressed(some, point, normal, touch, self._config.force),
            object_position=position,
            object_quaternion=quaternion,
            joint_velocity=np.zeros((count, d)),
            object_velocity=np.zeros((count, 6)),
            in_contact=touch,
            rotation=frame.rotation(quaternion, parents.rotation),
            cost=parents.cost + seconds,
        )


def _rows(reached: Reached, rows: NDArray[np.intp]) -> tuple:
    """Poses, tips and marks of some rows."""
    poses = type(reached.poses)(*(part[rows] for part in reached.poses))
    return poses, reached.tip[rows], reached.good[rows]


def _quaternion(vector: Floats) -> Floats:
    """The turn about ``vector`` ``(N, 3)`` by its length [rad], wxyz."""
    angle = np.linalg.norm(vector, axis=1, keepdims=True)
    half = 0.5 * angle
    scale = np.where(angle > 1e-9, np.sin(half) / np.maximum(angle, 1e-9), 0.5)
    return np.concatenate([np.cos(half), scale * vector], axis=1)
