"""Workspace: where each finger can touch an object, out of random postures.

Fingers that share no joint can be looked at one by one: a posture that puts one fingertip on the
object serves with any posture of the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from dexctl.configuration import HandConfiguration
from dexctl.hand import HandModel
from dexctl.rotations import cross
from dexctl.sim.hand_balls import HandBalls
from dexctl.sim.shapes import Shape
from dexctl.state import Floats

BAND = 0.0025
"""How far from touching a fingertip counts as touching in the search [m]."""
CLEAR = 0.002
"""How far links and palm keep from the object [m]."""
_EDGE = 1e-6  # what distance and bound differ by over a face, at most [m]
_NO_FINGER = -1


class Touches(NamedTuple):
    """Postures in which one finger touches an object, and nothing else of it does.

    Attributes:
        posture: rows of `Workspace.q`, ``(k,)``.
        position: of the contact ``(k, 3)`` [m], world frame.
        normal: from the fingertip into the object, unit, ``(k, 3)``.
        clearance: between the finger's links and the object ``(k,)`` [m].
    """

    posture: NDArray[np.intp]
    position: Floats
    normal: Floats
    clearance: Floats


class _Part(NamedTuple):
    """The balls of one finger's tip or links in every posture.

    Attributes:
        centres: ``(n, b, 3)`` [m].
        radius: ``(b,)`` [m].
        middle: amid them ``(n, 3)`` [m].
        around: a fingertip, which is rigid, is within so much of it [m].
    """

    centres: Floats
    radius: Floats
    middle: Floats
    around: float


class Workspace:
    """A hand in random postures.

    Args:
        model: compiled, with the hand.
        hand: its kinematics.
        lower, upper: of the set-points ``(d,)`` [rad].
        object_body: name of the body in the model that is not the hand's.
        base: posture that joints shared by several fingers keep ``(d,)`` [rad].
        count: of postures.
        seed: of the postures.

    Attributes:
        q: ``(n, d)`` [rad].
        margin: how far each finger is from its joint limits, over half their range, ``(n, m)``.
        dexterity: least singular value of each fingertip's Jacobian, ``(n, m)`` [m/rad].
        reach: typical length of the fingers [m].
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        hand: HandModel,
        lower: Floats,
        upper: Floats,
        base: Floats,
        object_body: str = "object",
        count: int = 1000,
        seed: int = 0,
    ) -> None:
        self.hand = hand
        self.lower, self.upper = np.maximum(lower, -np.pi), np.minimum(upper, np.pi)
        rng = np.random.default_rng(seed)
        self.q = rng.uniform(self.lower, self.upper, (count, hand.nq))
        shared = hand.moves.sum(axis=0) > 1
        self.q[:, shared] = base[shared]
        self.balls = HandBalls(model, hand, object_body)
        centres = self.balls.centres(self.q)
        self._configuration = hand.configuration(self.q)
        self.tips = self._configuration.fingertip_position
        self.margin = self._margins(shared)
        jacobian = self._configuration.finger_jacobian(self.tips)
        self.dexterity = np.asarray(np.linalg.svd(jacobian, compute_uv=False)[..., -1], float)
        offsets = np.linalg.norm(hand.fingertip_offsets, axis=-1)
        lengths = _lengths(model, hand.fingertip_bodies)
        self.reach = max(0.02, float(np.median(offsets + lengths)))
        self._tips = [self._part(centres, f, tip=True) for f in range(hand.n_fingers)]
        self._links = [self._part(centres, f, tip=False) for f in range(hand.n_fingers)]
        self._palm = self._part(centres[:1], _NO_FINGER, tip=False)

    def _part(self, centres: Floats, finger: int, *, tip: bool) -> _Part:
        chosen = np.flatnonzero((self.balls.tip == tip) & (self.balls.finger == finger))
        own, radius = np.ascontiguousarray(centres[:, chosen]), self.balls.radius[chosen]
        if not len(chosen):
            return _Part(own, radius, np.zeros((len(own), 3)), 0.0)
        middle = own.mean(axis=1)
        around = float((np.linalg.norm(own[0] - middle[0], axis=-1) + radius).max())
        return _Part(own, radius, middle, around)

    def _margins(self, shared: NDArray[np.bool_]) -> Floats:
        half = np.maximum((self.upper - self.lower) / 2, 1e-9)
        share = np.minimum(self.q - self.lower, self.upper - self.q) / half
        own = self.hand.moves & ~shared
        return np.where(own, share[:, None], np.inf).min(axis=-1)

    def palm_clearance(self, shape: Shape, centre: Floats, turn: Floats) -> float:
        """Distance of the object from the palm and what else does not move [m]."""
        if not len(self._palm.radius):
            return np.inf
        gap = shape.bound((self._palm.centres[0] - centre) @ turn) - self._palm.radius
        return float(gap.min())

    def touches(self, finger: int, shape: Shape, centre: Floats, turn: Floats) -> Touches:
        """Postures in which a finger touches the object.

        Args:
            finger: which.
            shape: of the object.
            centre: where the object is ``(3,)`` [m].
            turn: its rotation ``(3, 3)``.
        """
        tip, link = self._tips[finger], self._links[finger]
        away = shape.bound((tip.middle - centre) @ turn)
        near = np.flatnonzero(np.abs(away) < tip.around + BAND)
        points = (tip.centres[near] - centre) @ turn
        gap = shape.bound(points) - tip.radius
        first = gap.argmin(axis=-1) if len(near) else np.zeros(0, int)
        touching = np.flatnonzero(np.abs(gap[np.arange(len(near)), first]) < BAND)
        near, points = near[touching], points[touching, first[touching]]
        others = (link.centres[near] - centre) @ turn
        clearance = (shape.bound(others) - link.radius).min(axis=-1, initial=np.inf)
        free = np.flatnonzero(clearance > CLEAR)
        spots, normals = shape.nearest(points[free])
        # an edge or a corner is no place to hold: there the bound is less than the distance
        away = np.linalg.norm(points[free] - spots, axis=-1)
        flat = away - np.abs(shape.bound(points[free])) < _EDGE
        free, spots, normals = free[flat], spots[flat], normals[flat]
        return Touches(near[free], spots @ turn.T + centre, -normals @ turn.T, clearance[free])

    def approach(self, finger: int, shape: Shape, centre: Floats, turn: Floats) -> float:
        """How near a fingertip comes to the object in any posture, 0 where it touches [m].

        Args:
            finger: which.
            shape: of the object.
            centre: where the object is ``(3,)`` [m].
            turn: its rotation ``(3, 3)``.
        """
        tip = self._tips[finger]
        if not len(tip.radius):
            return np.inf
        gap = shape.bound((tip.centres - centre) @ turn) - tip.radius
        return max(0.0, float(gap.min()))

    def jacobian(self, finger: int, touches: Touches) -> Floats:
        """What the finger's own joints do to its contact points, ``(k, 3, n)``."""
        return jacobian_at(self._configuration, finger, touches.posture, touches.position)


def _lengths(model: mujoco.MjModel, tips: Sequence[str]) -> Floats:
    """Of each finger from its first joint to its tip's body, along the links ``(m,)`` [m].

    A joint that moves other fingers too, a wrist's, is not the finger's.
    """
    above = [_above(model, model.body(tip).id) for tip in tips]
    lengths = []
    for i, chain in enumerate(above):
        others = {body for j, other in enumerate(above) if j != i for body in other}
        own = [body for body in chain if body not in others]
        jointed = [k for k, body in enumerate(own) if model.body_jntnum[body] > 0]
        links = own[: jointed[-1]] if jointed else []
        lengths.append(np.linalg.norm(model.body_pos[links], axis=-1).sum())
    return np.array(lengths)


def _above(model: mujoco.MjModel, body: int) -> list[int]:
    """A body and all that it hangs on, itself first, without the world."""
    found = []
    while body > 0:
        found.append(body)
        body = int(model.body_parentid[body])
    return found


def jacobian_at(
    configuration: HandConfiguration, finger: int, rows: NDArray[np.intp], point: Floats
) -> Floats:
    """Contact Jacobians of one finger in some postures, ``(k, 3, n)``."""
    twist = configuration.finger_twist[rows, finger]
    moved = twist[..., :3] + cross(
        twist[..., 3:], np.broadcast_to(point[:, None], twist[..., 3:].shape)
    )
    return moved.swapaxes(-1, -2)
