"""Grasp search: places, sizes and postures in which fingertips could hold an object, by the kernel.

1. Places, sizes and turns of the object are drawn where the fingertips of random postures
   surround them, or near a place that is given; palm and links keep clear.
2. In each, every finger that reaches the surface takes one of the postures that touch it; fingers
   that do not reach are left out, three at least are in. Combinations are drawn.
3. Combinations are ranked by how well their normal forces balance (the thesis's stability QP), with
   all fingers and with any one of them lifted, and the surroundings of the best are searched again.
4. The best get their full score (`dexctl.sim.grasp_score`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dexctl.grasp import stability_forces
from dexctl.sim.shapes import Shape
from dexctl.sim.workspace import CLEAR, Touches, Workspace
from dexctl.state import Bools, Floats

LEAST_FINGERS = 3
_SPREAD = 32  # combinations of fingers' postures that are drawn in each place
PALM_CLEAR = 0.003  # [m]
_REGULARISER = 1e-3
_LEAST_FORCE = 0.3  # what every finger presses with, as a share of the strongest
_SIZES = (0.3, 0.65)  # widths that suit a hand, over the length of its fingers
_LEAST_LIFTED = 0.1  # the same while one is lifted
_LEAST_EASE = 0.02  # of a finger's posture
_EASY = 0.15  # margin of postures that places are drawn amid
_STARTS = 12  # best places whose surroundings are searched


@dataclass(frozen=True)
class Placement:
    """Where an object is: centre [m], width [m], turn about the vertical [rad]."""

    centre: Floats
    size: float
    yaw: float

    @property
    def turn(self) -> Floats:
        """The object's rotation ``(3, 3)``."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Contacts:
    """Combinations of contacts, one of each finger that is in; row i is one combination.

    Attributes:
        placement: of each, ``n`` of them.
        q: ``(n, d)`` [rad].
        active: which fingers hold ``(n, m)``.
        position, normal: of the contacts ``(n, m, 3)``; zero where a finger does not hold.
        clearance: of palm and links from the object ``(n,)`` [m].
        ease: worst finger's distance from joint limits and singularity, ``(n,)``, 0 to 1.
        imbalance: what the normal forces leave of a wrench, over the strongest of them, ``(n,)``.
        lifted: the same with one of the fingers lifted, the one that is missed most, ``(n,)``; 1
            where three hold.
    """

    placement: tuple[Placement, ...]
    q: Floats
    active: Bools
    position: Floats
    normal: Floats
    clearance: Floats
    ease: Floats
    imbalance: Floats
    lifted: Floats

    def __len__(self) -> int:
        return len(self.placement)

    @property
    def centre(self) -> Floats:
        """Of the object in each, ``(n, 3)`` [m]."""
        return np.array([one.centre for one in self.placement]).reshape(-1, 3)

    def take(self, rows: np.ndarray) -> Contacts:
        """Some of them."""
        arrays = {name: getattr(self, name)[rows] for name in _ARRAYS}
        return Contacts(tuple(self.placement[i] for i in rows), **arrays)

    @staticmethod
    def joined(parts: list[Contacts]) -> Contacts:
        """Several sets as one."""
        arrays = {name: np.concatenate([getattr(p, name) for p in parts]) for name in _ARRAYS}
        return Contacts(tuple(one for part in parts for one in part.placement), **arrays)


_ARRAYS = ("q", "active", "position", "normal", "clearance", "ease", "imbalance", "lifted")


@dataclass(frozen=True)
class GraspSearch:
    """What is searched for.

    Attributes:
        workspace: of the hand.
        shape: the object, one metre wide (or of its own size, with ``size`` 1).
        size: width [m], or None for what suits the hand.
        centre: where it is held ``(3,)`` [m], or None to be found.
        base: posture of the joints of fingers that are left out ``(d,)`` [rad].
        torque: of each joint ``(d,)`` [N m], infinite where unknown.
        stiffness: of each joint's servo ``(d,)`` [N m/rad].
        grip: normal force of a finger [N].
        friction: coefficient between fingertips and object.
        weight: of the object [N].
        twist: that the object is wanted to move with, ``(6,)`` (linear, angular), of any size.
        seed: of what is drawn.
        near: a place whose surroundings are searched, and nothing else; None: all over.
    """

    workspace: Workspace
    shape: Shape
    size: float | None
    centre: Floats | None
    base: Floats
    torque: Floats
    stiffness: Floats
    grip: float
    friction: float = 1.0
    weight: float = 1.0
    twist: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    seed: int = 0
    near: Placement | None = None

    def run(self, placements: int, keep: int = 48) -> Contacts | None:
        """The best ``keep`` combinations, best first; None where no place is in reach."""
        rng = np.random.default_rng(self.seed)
        found = self._explore(self.drawn(placements, rng), rng)
        if found is None:
            return None
        best = _distinct(found, _STARTS, 1)
        nearby = [
            self._moved(found.placement[i], rng)
            for i in best
            for _ in range(max(1, placements // (3 * _STARTS)))
        ]
        more = self._explore(nearby, rng)
        if more is not None:
            found = Contacts.joined([found, more])
        return found.take(_distinct(found, keep, 2))

    def drawn(self, count: int, rng: np.random.Generator) -> list[Placement]:
        """Places, sizes and turns amid the fingertips of random postures, or near one."""
        centres, sizes = self.centre, self.size
        if self.near is not None:
            there = Placement(
                self.near.centre if centres is None else centres,
                self.near.size if sizes is None else sizes,
                self.near.yaw,
            )
            return [self._moved(there, rng) for _ in range(count)]
        space = self.workspace
        # amid the tips of random postures that are far from limits
        easy = [np.flatnonzero(margin > _EASY) for margin in space.margin.T]
        if not any(map(len, easy)):  # of very many joints one is always near its limits
            easy = [np.argsort(-margin)[: max(1, len(margin) // 10)] for margin in space.margin.T]
        picks = np.array([rng.choice(rows, count) for rows in easy if len(rows)])
        fingers = [f for f, rows in enumerate(easy) if len(rows)]
        tips = np.array([space.tips[rows, f] for f, rows in zip(fingers, picks, strict=True)])
        widths = space.reach * rng.uniform(*_SIZES, count)
        yaws = rng.uniform(-np.pi, np.pi, count)
        return [
            Placement(
                tips[:, i].mean(axis=0) if centres is None else centres,
                float(widths[i]) if sizes is None else sizes,
                float(yaws[i]),
            )
            for i in range(count)
        ]

    def _moved(self, place: Placement, rng: np.random.Generator) -> Placement:
        centre, size = place.centre, place.size
        if self.centre is None:
            centre = centre + rng.normal(0.0, 0.006, 3)
        if self.size is None:
            low, high = (share * self.workspace.reach for share in _SIZES)
            size = float(np.clip(size * (1 + 0.06 * rng.normal()), low, high))
        return Placement(centre, size, place.yaw + 0.15 * rng.normal())

    def _explore(self, places: list[Placement], rng: np.random.Generator) -> Contacts | None:
        parts = [part for place in places if (part := self._at(place, rng)) is not None]
        if not parts:
            return None
        found = Contacts.joined(parts)
        forces = stability_forces(
            found.position,
            found.normal,
            found.active,
            found.centre,
            regulariser=_REGULARISER,
            min_force=_LEAST_FORCE,
        )
        found.imbalance[:] = forces.residual
        found.lifted[:] = _lifted(found)
        return found

    def _at(self, place: Placement, rng: np.random.Generator) -> Contacts | None:
        """Combinations in one place, without their imbalance yet."""
        space, shape = self.workspace, self.shape.scaled(place.size)
        palm = space.palm_clearance(shape, place.centre, place.turn)
        if palm < PALM_CLEAR:
            return None
        m, d = space.hand.n_fingers, space.hand.nq
        q = np.broadcast_to(self.base, (_SPREAD, d)).copy()
        active = np.zeros((_SPREAD, m), bool)
        position, normal = np.zeros((_SPREAD, m, 3)), np.zeros((_SPREAD, m, 3))
        clearance, ease = np.full(_SPREAD, palm), np.ones(_SPREAD)
        for finger in range(m):
            if active[0].sum() + m - finger < min(LEAST_FINGERS, m):
                return None
            touch = space.touches(finger, shape, place.centre, place.turn)
            if not len(touch.posture):
                continue
            value = self._ease(finger, touch.posture)
            strong = self._strong(finger, touch)
            rows = np.flatnonzero(strong & (value > _LEAST_EASE))
            if not len(rows):
                continue
            weight = value[rows] * np.minimum(touch.clearance[rows] / 0.01, 1.0)
            pick = rows[rng.choice(len(rows), _SPREAD, p=weight / weight.sum())]
            own = space.hand.moves[finger]
            q[:, own] = space.q[touch.posture[pick]][:, own]
            active[:, finger] = True
            position[:, finger], normal[:, finger] = touch.position[pick], touch.normal[pick]
            clearance = np.minimum(clearance, touch.clearance[pick])
            ease = np.minimum(ease, value[pick])
        apart = _apart(position, active) > 0.014
        rows = np.flatnonzero(apart)
        if not len(rows) or active[0].sum() < min(LEAST_FINGERS, m):
            return None
        return Contacts(
            (place,) * len(rows), q[rows], active[rows], position[rows], normal[rows],
            clearance[rows], ease[rows], np.zeros(len(rows)), np.ones(len(rows)),
        )  # fmt: skip

    def flat(self) -> Bools:
        """Which fingers move their tips along a plane or a line only, in every posture, ``(m,)``.

        They are left out of every combination.
        """
        return self._dexterous(self.workspace.dexterity).max(axis=0) <= _LEAST_EASE

    def able(self, finger: int, touch: Touches) -> tuple[Bools, Bools]:
        """In which postures ``(k,)`` a finger can press, and in which it can move all ways."""
        return self._strong(finger, touch), self._ease(finger, touch.posture) > _LEAST_EASE

    def _ease(self, finger: int, rows: np.ndarray) -> Floats:
        space = self.workspace
        margin = np.minimum(space.margin[rows, finger] / 0.3, 1.0)
        return margin * self._dexterous(space.dexterity[rows, finger])

    def _dexterous(self, dexterity: Floats) -> Floats:
        return np.minimum(dexterity / (0.15 * self.workspace.reach), 1.0)

    def _strong(self, finger: int, touch: object) -> Bools:
        jacobian = self.workspace.jacobian(finger, touch)  # type: ignore[arg-type]
        torque = np.abs(np.einsum("kxn,kx->kn", jacobian, touch.normal))  # type: ignore[attr-defined]
        own = self.workspace.hand.finger_joints[finger][: torque.shape[1]]
        limit = self.torque[own] / self.grip
        count = int(self.workspace.hand.moves[finger].sum())
        return (torque[:, :count] <= limit[:count]).all(axis=-1)


def _apart(position: Floats, active: Bools) -> Floats:
    """The least distance between two contacts of each combination ``(n,)`` [m]."""
    away = np.linalg.norm(position[:, :, None] - position[:, None], axis=-1)
    other = active[:, :, None] & active[:, None] & ~np.eye(active.shape[1], dtype=bool)
    return np.where(other, away, np.inf).min(axis=(-1, -2))


def _lifted(found: Contacts) -> Floats:
    """See `Contacts.lifted`."""
    worst = np.where(found.active.sum(axis=-1) > LEAST_FINGERS, 0.0, 1.0)
    for finger in range(found.active.shape[1]):
        others = found.active.copy()
        others[:, finger] = False
        rows = np.flatnonzero(found.active[:, finger] & (worst < 1.0))
        left = stability_forces(
            found.position[rows],
            found.normal[rows],
            others[rows],
            found.centre[rows],
            regulariser=_REGULARISER,
            min_force=_LEAST_LIFTED,
        )
        worst[rows] = np.maximum(worst[rows], left.residual)
    return np.minimum(worst, 1.0)


def merit(found: Contacts) -> Floats:
    """What combinations are sorted by before they get their full score, ``(n,)``."""
    room = np.minimum(found.clearance / 0.006, 1.0)
    balance = 1.0 / (1.0 + (found.imbalance / 0.3) ** 2)
    crew = found.active.sum(axis=-1) / found.active.shape[1]
    spare = 1.0 / (1.0 + (found.lifted / 0.6) ** 2)
    return balance * np.sqrt(found.ease) * (0.3 + 0.7 * room) * crew * spare


def _distinct(found: Contacts, count: int, each: int) -> np.ndarray:
    """The best ``count``, of each place ``each`` at most."""
    chosen: list[int] = []
    seen: dict[int, int] = {}
    for i in np.argsort(-merit(found), kind="stable"):
        place = id(found.placement[i])
        if seen.get(place, 0) < each:
            seen[place] = seen.get(place, 0) + 1
            chosen.append(int(i))
        if len(chosen) == count:
            break
    return np.array(chosen, int)


__all__ = ["CLEAR", "Contacts", "GraspSearch", "Placement", "merit"]
