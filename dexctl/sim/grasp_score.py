"""Grasp score: how well contacts hold, with one finger lifted too, and how far fingers can go."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from dexctl.grasp import epsilon_quality, isotropy
from dexctl.hand import HandModel
from dexctl.rotations import cross
from dexctl.sim.grasp_search import Contacts, GraspSearch
from dexctl.sim.grasp_sweep import jacobians, sweep, velocities
from dexctl.state import Floats

_EDGES = 6  # of the friction pyramids
_NEEDED = 3  # fingers that hold while one is lifted

# What is enough of each: more does not make a grasp better. Chosen on which of 200 grasps of
# Allegro and LEAP were held for 10 s (margin, isotropy and stiffness tell the most of it) and
# which of 100 the coordinated gait turned for 30 s (spare and swing).
_ENOUGH = {
    "margin": 4.0,
    "spare": 1.0,
    "isotropy": 0.6,
    "dexterity": 0.05,
    "reach": 0.6,
    "swing": 0.4,
    "stiffness": 300.0,
    "clearance": 0.008,
}


class GraspScore(NamedTuple):
    """How good a grasp is; the parts of its rank.

    Attributes:
        total: geometric mean of the parts, each over what is enough, and of the balance; 0 to 1.
        margin: weights of the object that the grasp resists in any direction, up to the least
            favourable: Ferrari-Canny epsilon times the grip of all fingers over the weight.
        spare: the same with any one of the fingers lifted, the one that is missed most; 0 where
            three hold.
        balance: 1 where normal forces alone leave no wrench, towards 0 where friction has to
            carry as much as they.
        isotropy: least over largest singular value of the grasp map.
        dexterity: least over the fingers, speed of the contact in the direction of the wanted
            twist at unit joint speed [m/rad].
        reach: how far the fingers carry the object along the wanted twist and back, before one
            comes to a joint limit or a singularity [rad] (for a shift, over the lever).
        swing: how far each of them can go about the wanted twist by itself, to either side, with
            nothing but its fingertip touching [rad]; the least.
        stiffness: least of the object's in the servos' hold, over all directions, torques over the
            lever [N/m]; the weight moves it by no more than the weight over this.
        clearance: distance of palm and links from the object [m].
        fingers: how many hold.
    """

    total: float
    margin: float
    spare: float
    balance: float
    isotropy: float
    dexterity: float
    reach: float
    swing: float
    stiffness: float
    clearance: float
    fingers: int


class Ranked(NamedTuple):
    """Contacts and the score of each, best first."""

    contacts: Contacts
    score: tuple[GraspScore, ...]


def ranked(search: GraspSearch, placements: int, keep: int = 48) -> Ranked | None:
    """The best combinations of contacts that a search finds, best first; None without any.

    Those in which links of the hand cross each other are left out.
    """
    found = search.run(placements, keep)
    if found is None:
        return None
    free = [i for i in range(len(found)) if not search.workspace.balls.crosses_itself(found.q[i])]
    found = found.take(np.array(free, int))
    given = scores(search, found)
    order = np.argsort([-score.total for score in given], kind="stable")
    return Ranked(found.take(order), tuple(given[i] for i in order))


def scores(search: GraspSearch, found: Contacts) -> list[GraspScore]:
    """The score of each combination of contacts."""
    if not len(found):
        return []
    hand, lower, upper = search.workspace.hand, search.workspace.lower, search.workspace.upper
    contacts = (found.position, found.normal, found.active, found.centre)
    crew = found.active.sum(axis=-1)
    weights = crew * search.grip / max(search.weight, 1e-9)
    lever = found.position - found.centre[:, None]
    length = np.linalg.norm(lever, axis=-1).sum(axis=-1) / np.maximum(crew, 1)
    motion = _motion(np.asarray(search.twist, float), length)
    ways = [sweep(search, found, lower, upper, way) for way in (motion, -motion)]
    held, clear = ([np.where(found.active, way[i], np.inf) for way in ways] for i in (0, 1))
    parts = {
        "margin": _epsilon(search, found) * weights,
        "spare": _spare(search, found) * weights * (1 - 1 / np.maximum(crew, 1)),
        "balance": 1.0 / (1.0 + (found.imbalance / 0.5) ** 2),
        "isotropy": np.atleast_1d(isotropy(*contacts)),
        "dexterity": _dexterity(hand, found, motion),
        "reach": held[0].min(axis=-1) + held[1].min(axis=-1),
        "swing": np.minimum(*clear).min(axis=-1),
        "stiffness": _stiffness(search, found, length),
        "clearance": found.clearance,
    }
    shares = [np.clip(value / _ENOUGH.get(name, 1.0), 0.02, 1.0) for name, value in parts.items()]
    total = np.prod(shares, axis=0) ** (1 / len(shares))
    return [
        GraspScore(
            total=float(total[i]),
            **{name: float(value[i]) for name, value in parts.items()},
            fingers=int(crew[i]),
        )
        for i in range(len(found))
    ]


def _epsilon(search: GraspSearch, found: Contacts) -> Floats:
    contacts = (found.position, found.normal, found.active, found.centre)
    return np.atleast_1d(epsilon_quality(*contacts, search.friction, edges=_EDGES))


def _spare(search: GraspSearch, found: Contacts) -> Floats:
    """Epsilon ``(n,)`` without the finger whose absence leaves the least."""
    least = np.full(len(found), np.inf)
    for finger in range(found.active.shape[1]):
        others = found.active.copy()
        others[:, finger] = False
        left = np.flatnonzero(found.active[:, finger] & (others.sum(axis=-1) >= _NEEDED))
        without = replace(found.take(left), active=others[left])
        least[left] = np.minimum(least[left], _epsilon(search, without)) if len(left) else 0.0
    return np.where(np.isfinite(least), least, 0.0)


def _motion(twist: Floats, length: Floats) -> Floats:
    """The twist of each ``(n, 6)`` that is one radian, or one lever [m]."""
    linear, angular = twist[:3], twist[3:]
    if np.linalg.norm(angular) > 0:
        return np.broadcast_to(twist / np.linalg.norm(angular), (len(length), 6))
    return length[:, None] * (twist / np.linalg.norm(linear))


def _dexterity(hand: HandModel, found: Contacts, motion: Floats) -> Floats:
    lever = found.position - found.centre[:, None]
    velocity = velocities(motion, lever)
    speed = np.linalg.norm(velocity, axis=-1, keepdims=True)
    direction = np.where(speed > 1e-9, velocity / np.maximum(speed, 1e-9), 0.0)
    jacobian = jacobians(hand, hand.configuration(found.q), found.position)
    gram = jacobian @ jacobian.swapaxes(-1, -2) + 1e-10 * np.eye(3)
    need = np.einsum("nmx,nmx->nm", direction, np.linalg.solve(gram, direction[..., None])[..., 0])
    each = 1.0 / np.sqrt(np.maximum(need, 1e-12))
    return np.where(found.active & (speed[..., 0] > 1e-9), each, np.inf).min(axis=-1)


def _stiffness(search: GraspSearch, found: Contacts, length: Floats) -> Floats:
    """Least eigenvalue ``(n,)`` [N/m] of G K G', K the stiffness of contact points on the servos.

    Point contacts that neither slide nor roll; Cutkosky and Kao, "Computing and controlling the
    compliance of a robotic hand" (1989), without the terms of the grip's own forces.
    """
    hand = search.workspace.hand
    jacobian = jacobians(hand, hand.configuration(found.q), found.position)
    yielding = 1.0 / np.maximum(search.stiffness, 1e-6)[hand.finger_joints]
    compliance = (jacobian * yielding[:, None]) @ jacobian.swapaxes(-1, -2)
    contact = np.linalg.inv(compliance + 1e-6 * np.eye(3)) * found.active[..., None, None]
    lever = (found.position - found.centre[:, None]) / np.maximum(length, 1e-6)[:, None, None]
    turn = cross(lever[..., None, :], np.broadcast_to(np.eye(3), (*lever.shape[:2], 3, 3)))
    # rows of `turn`: torque of a unit force along each axis
    grasp = np.concatenate([np.broadcast_to(np.eye(3), turn.shape), turn.swapaxes(-1, -2)], axis=-2)
    total = (grasp @ contact @ grasp.swapaxes(-1, -2)).sum(axis=1)
    return np.asarray(np.linalg.eigvalsh(total)[:, 0], float)
