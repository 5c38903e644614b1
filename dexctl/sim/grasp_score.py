"""Grasp score: how well contacts hold, and how far the fingers can carry the object."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dexctl.configuration import HandConfiguration
from dexctl.grasp import epsilon_quality, isotropy
from dexctl.hand import HandModel
from dexctl.rotations import cross
from dexctl.sim.grasp_search import Contacts, GraspSearch
from dexctl.state import Bools, Floats

_EDGES = 6  # of the friction pyramids
_STEP = 0.05  # of the wanted motion, turn or shift over the lever [rad]
_FURTHEST = 0.6  # how far it is followed [rad]
_DAMPING = 1e-5
_ERROR = 0.15  # of a step, that a finger may fall short of

# What is enough of each: more does not make a grasp better. Chosen on which of 200 grasps of
# Allegro and LEAP were held for 10 s; margin, isotropy and stiffness tell the most of it.
_ENOUGH = {
    "margin": 4.0,
    "isotropy": 0.6,
    "dexterity": 0.05,
    "reach": 0.6,
    "stiffness": 300.0,
    "clearance": 0.008,
}


class GraspScore(NamedTuple):
    """How good a grasp is; the parts of its rank.

    Attributes:
        total: geometric mean of the parts, each over what is enough, and of the balance; 0 to 1.
        margin: weights of the object that the grasp resists in any direction, up to the least
            favourable: Ferrari-Canny epsilon times the grip of all fingers over the weight.
        balance: 1 where normal forces alone leave no wrench, towards 0 where friction has to
            carry as much as they.
        isotropy: least over largest singular value of the grasp map.
        dexterity: least over the fingers, speed of the contact in the direction of the wanted
            twist at unit joint speed [m/rad].
        reach: how far the fingers carry the object along the wanted twist and back, before one
            comes to a joint limit or a singularity [rad] (for a shift, over the lever).
        stiffness: least of the object's in the servos' hold, over all directions, torques over the
            lever [N/m]; the weight moves it by no more than the weight over this.
        clearance: distance of palm and links from the object [m].
        fingers: how many hold.
    """

    total: float
    margin: float
    balance: float
    isotropy: float
    dexterity: float
    reach: float
    stiffness: float
    clearance: float
    fingers: int


class Ranked(NamedTuple):
    """Contacts and the score of each, best first."""

    contacts: Contacts
    score: tuple[GraspScore, ...]


def ranked(search: GraspSearch, placements: int = 240, keep: int = 48) -> Ranked | None:
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
    epsilon = np.atleast_1d(epsilon_quality(*contacts, search.friction, edges=_EDGES))
    lever = found.position - found.centre[:, None]
    length = np.linalg.norm(lever, axis=-1).sum(axis=-1) / np.maximum(crew, 1)
    motion = _motion(np.asarray(search.twist, float), length)
    parts = {
        "margin": epsilon * crew * search.grip / max(search.weight, 1e-9),
        "balance": 1.0 / (1.0 + (found.imbalance / 0.5) ** 2),
        "isotropy": np.atleast_1d(isotropy(*contacts)),
        "dexterity": _dexterity(hand, found, motion),
        "reach": _reach(hand, found, lower, upper, motion)
        + _reach(hand, found, lower, upper, -motion),
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


def _motion(twist: Floats, length: Floats) -> Floats:
    """The twist of each ``(n, 6)`` that is one radian, or one lever [m]."""
    linear, angular = twist[:3], twist[3:]
    if np.linalg.norm(angular) > 0:
        return np.broadcast_to(twist / np.linalg.norm(angular), (len(length), 6))
    return length[:, None] * (twist / np.linalg.norm(linear))


def _velocities(motion: Floats, lever: Floats) -> Floats:
    """Of the contact points ``(n, m, 3)`` where the object moves so."""
    return motion[:, None, :3] + cross(np.broadcast_to(motion[:, None, 3:], lever.shape), lever)


def _jacobians(hand: HandModel, configuration: HandConfiguration, points: Floats) -> Floats:
    """By each finger's own joints, ``(n, m, 3, k)``; columns of shared ones are zero."""
    own = hand.finger_joint_map @ (hand.moves.sum(axis=0) == 1)
    return configuration.finger_jacobian(points).swapaxes(-1, -2) * own[:, None]


def _dexterity(hand: HandModel, found: Contacts, motion: Floats) -> Floats:
    lever = found.position - found.centre[:, None]
    velocity = _velocities(motion, lever)
    speed = np.linalg.norm(velocity, axis=-1, keepdims=True)
    direction = np.where(speed > 1e-9, velocity / np.maximum(speed, 1e-9), 0.0)
    jacobian = _jacobians(hand, hand.configuration(found.q), found.position)
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
    jacobian = _jacobians(hand, hand.configuration(found.q), found.position)
    yielding = 1.0 / np.maximum(search.stiffness, 1e-6)[hand.finger_joints]
    compliance = (jacobian * yielding[:, None]) @ jacobian.swapaxes(-1, -2)
    contact = np.linalg.inv(compliance + 1e-6 * np.eye(3)) * found.active[..., None, None]
    lever = (found.position - found.centre[:, None]) / np.maximum(length, 1e-6)[:, None, None]
    turn = cross(lever[..., None, :], np.broadcast_to(np.eye(3), (*lever.shape[:2], 3, 3)))
    # rows of `turn`: torque of a unit force along each axis
    grasp = np.concatenate([np.broadcast_to(np.eye(3), turn.shape), turn.swapaxes(-1, -2)], axis=-2)
    total = (grasp @ contact @ grasp.swapaxes(-1, -2)).sum(axis=1)
    return np.asarray(np.linalg.eigvalsh(total)[:, 0], float)


def _reach(
    hand: HandModel, found: Contacts, lower: Floats, upper: Floats, motion: Floats
) -> Floats:
    """How far along ``motion`` all fingers that hold can go, ``(n,)`` [rad].

    The fingers follow their contact points by damped least squares, step by step, until one of
    them is at a joint limit or falls short of its step.
    """
    q, points = found.q.copy(), found.position.copy()
    centre = found.centre[:, None].copy()
    reached = np.zeros(len(q))
    going: Bools = np.ones(len(q), bool)
    used = (found.active[:, :, None] & hand.moves).any(axis=1)
    for _ in range(round(_FURTHEST / _STEP)):
        step = _STEP * _velocities(motion, points - centre)
        jacobian = _jacobians(hand, hand.configuration(q), points)
        gram = jacobian @ jacobian.swapaxes(-1, -2) + _DAMPING * np.eye(3)
        change = jacobian.swapaxes(-1, -2) @ np.linalg.solve(gram, step[..., None])
        short = np.linalg.norm((jacobian @ change)[..., 0] - step, axis=-1)
        fails = (short > _ERROR * np.linalg.norm(step, axis=-1) + 1e-5) & found.active
        q = q + np.einsum("nmk,mkd->nd", change[..., 0], hand.finger_joint_map) * used
        stuck = ((q < lower) | (q > upper)) & used
        going &= ~fails.any(axis=-1) & ~stuck.any(axis=-1)
        if not going.any():
            break
        reached += _STEP * going
        points = points + step
        centre = centre + _STEP * motion[:, None, :3]
    return reached
