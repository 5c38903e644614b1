"""How far fingers can follow a motion of the object, each by itself."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dexctl.configuration import HandConfiguration
from dexctl.hand import HandModel
from dexctl.rotations import cross
from dexctl.sim.grasp_search import CLEAR, Contacts, GraspSearch, Placement
from dexctl.state import Bools, Floats

_STEP = 0.05  # of the wanted motion, turn or shift over the lever [rad]
_FURTHEST = 0.6  # how far it is followed [rad]
_DAMPING = 1e-5
_ERROR = 0.15  # of a step, that a finger may fall short of


class Sweep(NamedTuple):
    """How far each finger follows its contact ``(n, m)`` [rad]."""

    held: Floats
    clear: Floats


def sweep(
    search: GraspSearch, found: Contacts, lower: Floats, upper: Floats, motion: Floats
) -> Sweep:
    """How far along ``motion`` each finger can go: by its joints, and with its links clear besides.

    The fingers follow their contact points, each by itself, by damped least squares, step by step,
    until they are at a joint limit or fall short of their step.
    """
    hand = search.workspace.hand
    q, points = found.q.copy(), found.position.copy()
    centre = found.centre[:, None].copy()
    going = found.active.copy()
    clear = going.copy()
    held, swung = np.zeros(going.shape), np.zeros(going.shape)
    for k in range(1, round(_FURTHEST / _STEP) + 1):
        step = _STEP * velocities(motion, points - centre)
        jacobian = jacobians(hand, hand.configuration(q), points)
        gram = jacobian @ jacobian.swapaxes(-1, -2) + _DAMPING * np.eye(3)
        change = jacobian.swapaxes(-1, -2) @ np.linalg.solve(gram, step[..., None])
        short = np.linalg.norm((jacobian @ change)[..., 0] - step, axis=-1)
        going &= short <= _ERROR * np.linalg.norm(step, axis=-1) + 1e-5
        used = (going[:, :, None] & hand.moves).any(axis=1)
        q = q + np.einsum("nmk,mkd->nd", change[..., 0], hand.finger_joint_map) * used
        stuck = ((q < lower) | (q > upper)) & used
        going &= ~(stuck[:, None] & hand.moves).any(axis=-1)
        clear &= going
        if not going.any():
            break
        points = points + step
        centre = centre + _STEP * motion[:, None, :3]
        clear &= _links_clear(search, found, q, centre[:, 0], k * _STEP * motion)
        held += _STEP * going
        swung += _STEP * clear
    return Sweep(held, swung)


def _links_clear(
    search: GraspSearch, found: Contacts, q: Floats, centre: Floats, moved: Floats
) -> Bools:
    """Whether each finger's links keep clear of the object, which has turned along, ``(n, m)``."""
    balls = search.workspace.balls
    where = balls.centres(q)
    out = np.ones(found.active.shape, bool)
    fingers = range(search.workspace.hand.n_fingers)
    for i, place in enumerate(found.placement):
        turned = Placement(centre[i], place.size, place.yaw + float(moved[i, 5]))
        shape = search.shape.scaled(place.size)
        gap = shape.bound((where[i] - turned.centre) @ turned.turn) - balls.radius
        for finger in fingers:
            links = (balls.finger == finger) & ~balls.tip
            out[i, finger] = gap[links].min(initial=np.inf) > CLEAR
    return out


def velocities(motion: Floats, lever: Floats) -> Floats:
    """Of the contact points ``(n, m, 3)`` where the object moves so."""
    return motion[:, None, :3] + cross(np.broadcast_to(motion[:, None, 3:], lever.shape), lever)


def jacobians(hand: HandModel, configuration: HandConfiguration, points: Floats) -> Floats:
    """By each finger's own joints, ``(n, m, 3, k)``; columns of shared ones are zero."""
    own = hand.finger_joint_map @ (hand.moves.sum(axis=0) == 1)
    return configuration.finger_jacobian(points).swapaxes(-1, -2) * own[:, None]
