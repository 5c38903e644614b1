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
from dexctl.rotations import from_rotation_vector, inverse, multiply, rotate
from dexctl.state import Bools, Floats
from dexctl.switch.landing import azimuth, split, turned
from dexctl.validation import check_numbers, check_whole

_SUNK = 5e-4  # how far a fingertip may sink into the object where it lands [m]
_ALONG, _ACROSS = 0.3, 2.0  # limits of the residual about axes along the palm's direction, across
_SWITCH_TIME, _TURNING_SPEED = 1.5, 0.35  # for the cost of an edge [s], [rad/s]


@dataclass(frozen=True, kw_only=True)
class Kinematic(Expansion):
    """M-RRT: at most one finger is moved to another place, then the object with all that hold it.

    No physics: grasps are closures of at least three contacts whose links are clear, and their
    set-points press. Whether they hold in simulation is for `holding` to say: nearly all do on
    dex5, the hand of five fingers that the defaults are for; far fewer may on others, such as
    the Allegro and the LEAP hand, which have four.
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
    friction: float = 0.5
    """Assumed by the closure test; below the real one."""
    margin: float = 0.006
    """How far links stay away from the object and from other fingers [m]."""
    force: float = 1.5
    """With which the mean finger is pressed on [N]."""
    residual_limit: float | None = None
    """No grasp is taken whose normal forces leave more than this to friction, as a share of the
    grip. None: 0.3, but 2 about axes across the palm's direction (more than 45 degrees from z),
    about which edged objects get no further with less."""
    batch: int = 256
    """How many nodes are expanded at a time."""

    def __post_init__(self) -> None:
        check_numbers(
            self,
            positive=("step", "shift", "landing", "friction", "force"),
            optional=("residual_limit",),
            not_negative=("height", "margin"),
            fractions=("switch", "guided"),
        )
        check_whole(self, substeps=1, batch=1)

    def open(self, problem: Problem) -> Expander:
        return _KinematicExpander(self, problem)


class _KinematicExpander:
    action_names: tuple[str, ...] = (
        "twist_x", "twist_y", "twist_z", "twist_rx", "twist_ry", "twist_rz",
        "finger", "landing_x", "landing_y", "landing_z",
    )  # fmt: skip

    def __init__(self, config: Kinematic, problem: Problem) -> None:
        scene, frame = problem.scene, problem.frame
        if scene.hand.n_fingers < 3:
            raise InvalidInput(f"{scene.hand.name} has fewer than three fingers; expected more")
        self._config, self._problem, self.batch = config, problem, config.batch
        across = abs(frame.axis[2]) < np.sqrt(0.5)
        self._residual_limit = config.residual_limit or (_ACROSS if across else _ALONG)
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
        problem, model = self._problem, self._model
        poses = model.geometry.poses(nodes.q)
        tip = poses.centres(model.geometry.tips)
        start = Reached(nodes.q.copy(), poses, tip, np.ones(len(nodes), bool))
        towards = (targets - problem.metric.of(problem.frame, nodes)).astype(float)
        finger, where = self._choose(nodes, tip, towards[:, -1], rng)
        placed, touch, landing, refused = self._switch(start, nodes, finger, where, rng)
        rows = np.flatnonzero(placed.good)
        done, twist, position, quaternion = self._move(
            placed.take(rows),
            touch[rows],
            nodes.object_position[rows],
            nodes.object_quaternion[rows],
            towards[rows],
        )
        moved = (np.abs(twist).max(axis=1, initial=0.0) > 0) | (finger[rows] >= 0)
        refused["clearance"] += int((~moved).sum())
        rows, twist = rows[moved], twist[moved]
        made, residual = self._made(
            nodes.take(rows), done.take(moved), touch[rows], position[moved], quaternion[moved],
            twist, finger[rows] >= 0,
        )  # fmt: skip
        balanced = residual <= self._residual_limit
        refused["residual"] += int((~balanced).sum())
        within = problem.bounds.hold(problem.frame, made)
        refused["bounds"] += int((balanced & ~within).sum())
        within &= balanced
        action = np.column_stack([twist, finger[rows].astype(float), landing[rows]])
        return Offspring(made.take(within), rows[within], action[within], refused, 0)

    def _choose(
        self, nodes: Nodes, tip: Floats, towards: Floats, rng: np.random.Generator
    ) -> tuple[NDArray[np.intp], Floats]:
        """The finger that each node moves, -1 for none, and where to about the axis [rad]."""
        config, frame, (count, m) = self._config, self._problem.frame, nodes.in_contact.shape
        sense = np.where(towards < 0, -1.0, 1.0)
        flat = split(tip - nodes.object_position[:, None], frame.axis)[1]
        gone = sense[:, None] * azimuth(self._neutral, flat, frame.axis)
        furthest = np.argmax(gone + rng.uniform(0, 0.2, (count, m)), axis=1)
        guided = rng.uniform(size=count) < config.guided
        finger = np.where(guided, furthest, rng.integers(m, size=count))
        finger = np.where(rng.uniform(size=count) < config.switch, finger, -1)
        where = np.where(
            guided, -sense * rng.uniform(0.2, 1.0, count), rng.uniform(-1.0, 1.0, count)
        )
        return finger, config.landing * where

    def _switch(
        self,
        start: Reached,
        nodes: Nodes,
        finger: NDArray[np.intp],
        where: Floats,
        rng: np.random.Generator,
    ) -> tuple[Reached, Bools, Floats, Counter[str]]:
        """Put fingers down elsewhere, where the others hold and the way there is no matter.

        What is reached (``good``: a grasp, or nothing was to be moved), which fingers touch then,
        and where they landed in the object's frame, ``(N, 3)``, NaN where none did.
        """
        model, refused = self._model, Counter[str]()
        landing, good = np.full((len(finger), 3), np.nan), finger < 0
        touch, reached = nodes.in_contact.copy(), start._replace(good=good)
        rows = np.flatnonzero(~good)
        position, quaternion = nodes.object_position, nodes.object_quaternion
        hit, local, place = self._landings(nodes.take(rows), finger[rows], where[rows], rng)
        others = touch[rows]
        others[np.arange(len(rows)), finger[rows]] = False
        point, normal = model.surface(start.tip[rows], position[rows], quaternion[rows])
        holds = hit & model.closed(point, normal, others, position[rows])
        refused["closure"] += int((~holds).sum())
        rows, place, local, others = rows[holds], place[holds], local[holds], others[holds]
        wanted = np.arange(touch.shape[1]) == finger[rows, None]
        goal = np.where(wanted[..., None], place[:, None], start.tip[rows])
        found = model.reach(start.q[rows], goal, wanted)
        refused["reach"] += int((~found.good).sum())
        rows, local = rows[found.good], local[found.good]
        now = (others | wanted)[found.good]
        found = found.take(found.good)
        clear = model.clear(found, now, position[rows], quaternion[rows])
        refused["clearance"] += int((~clear).sum())
        rows = rows[clear]
        reached.put(rows, found.take(clear))
        touch[rows], landing[rows] = now[clear], local[clear]
        return reached, touch, landing, refused

    def _landings(
        self, nodes: Nodes, finger: NDArray[np.intp], where: Floats, rng: np.random.Generator
    ) -> tuple[Bools, Floats, Floats]:
        """Where rays from outside, towards the object's axis, meet its surface.

        Whether they do and the fingertip fits there, the points in the object's frame, and the
        places of the fingertips' balls that touch there, in the world's.
        """
        model, config, axis = self._model, self._config, self._problem.frame.axis
        into = inverse(nodes.object_quaternion)
        out = rotate(into, turned(self._neutral[finger], where, axis))
        up = rotate(into, np.broadcast_to(axis, out.shape))
        height = rng.uniform(-config.height, config.height, (len(finger), 1))
        begin = height * up + 2.0 * model.shape.radius * out
        distance, outward = model.shape.ray(begin, -out)
        hit: Bools = np.asarray(distance < 2.0 * model.shape.radius)
        local = begin - np.where(hit, distance, 0.0)[:, None] * out
        radius = model.geometry.tips.radius[finger]
        ball = local + radius[:, None] * outward
        # in a corner the ball would sink into the other side
        hit &= model.shape.distance(ball) > radius - _SUNK
        place = rotate(nodes.object_quaternion, ball) + nodes.object_position
        return hit, local, place

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
        inward = model.on_surface(start.tip, position, quaternion)
        reached, total = start, np.zeros_like(twist)
        going = np.arange(len(twist))
        position, quaternion = position.copy(), quaternion.copy()
        for _ in range(config.substeps):
            ahead = position[going] + twist[going, :3]
            facing = multiply(from_rotation_vector(twist[going, 3:]), quaternion[going])
            goal = rotate(facing[:, None], inward[going]) + ahead[:, None]
            found = model.reach(reached.q[going] + free[going], goal, touch[going])
            ok = found.good & model.clear(found, touch[going], ahead, facing)
            going = going[ok]
            reached.put(going, found.take(ok))
            position[going], quaternion[going] = ahead[ok], facing[ok]
            total[going] += twist[going]
        return reached, total, position, quaternion

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
        kept = projected(scaled, towards)
        motion = kept @ into.T
        joints = np.clip(motion[:, :d], -0.5, 0.5)
        held = (touch @ model.hand.moves.astype(int)) > 0
        return motion[:, d:], np.where(held, 0.0, joints)

    def _made(
        self,
        parents: Nodes,
        done: Reached,
        touch: Bools,
        position: Floats,
        quaternion: Floats,
        twist: Floats,
        switched: Bools,
    ) -> tuple[Nodes, Floats]:
        """The nodes, and the wrench that their normal forces leave to friction."""
        point, normal = self._model.surface(done.tip, position, quaternion)
        q_target, residual = self._model.pressed(
            done, point, normal, touch, position, self._config.force
        )
        turn = np.linalg.norm(twist[:, 3:], axis=1)
        seconds = np.maximum(turn / _TURNING_SPEED, np.where(switched, _SWITCH_TIME, 0.0))
        made = Nodes(
            q=done.q,
            q_target=q_target,
            object_position=position,
            object_quaternion=quaternion,
            joint_velocity=np.zeros_like(done.q),
            object_velocity=np.zeros((len(done.q), 6)),
            in_contact=touch,
            rotation=self._problem.frame.rotation(quaternion, parents.rotation),
            cost=parents.cost + seconds,
        )
        return made, residual


def projected(constraint: Floats, wanted: Floats) -> Floats:
    """(I - N^+ N) x: what constraints ``(N, c, k)`` let pass of motions ``wanted`` ``(N, k)``."""
    transposed = np.swapaxes(constraint, 1, 2)
    gram = constraint @ transposed
    size = np.maximum(np.trace(gram, axis1=1, axis2=2), 1e-9)
    gram = gram + 1e-9 * size[:, None, None] * np.eye(gram.shape[1])
    violation = np.linalg.solve(gram, constraint @ wanted[..., None])
    return wanted - (transposed @ violation)[..., 0]
