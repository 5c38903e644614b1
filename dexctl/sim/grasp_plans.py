"""Grasp plans: which point of the object's surface each fingertip closes on."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dexctl.grasp import stability_forces
from dexctl.sim.grasp_score import ranked
from dexctl.sim.grasp_search import GraspSearch, Placement
from dexctl.sim.hand_balls import HandBalls
from dexctl.sim.shapes import Shape
from dexctl.state import Bools, Floats

_NEAR = 0.015  # a fingertip of the grasp posture holds where it is so near to the object [m]
_TURNS = 48  # of the object about the vertical
_TRIED = 4
_LEAST_FINGERS = 3
_SEARCHED = 6
_POSTURE = "where the grasp posture has its fingertips"
_SEARCH = "where a search for a grasp found them"


class GraspPlan(NamedTuple):
    """Where each finger goes.

    Attributes:
        how: where that comes from, for people.
        yaw: how far the object is turned about z [rad].
        points, normals: of the object's surface, normals outward, ``(m, 3)``, world frame.
        active: which fingers hold ``(m,)``.
        q: posture that inverse kinematics starts from and keeps near to, ``(d,)`` [rad].
    """

    how: str
    yaw: float
    points: Floats
    normals: Floats
    active: Bools
    q: Floats


def posture_plans(balls: HandBalls, shape: Shape, centre: Floats, q: Floats) -> list[GraspPlan]:
    """The points nearest to the fingertips of a grasp posture, the object turned to fit it.

    Fingers whose tips are further from the object are left out. The turns in which the tips'
    normal forces balance best come first.
    """
    m = balls.fingers
    where = balls.centres(q[None])[0]
    plans, cost = [], []
    for yaw in 2 * np.pi / _TURNS * np.arange(_TURNS):
        turn = Placement(centre, 1.0, float(yaw)).turn
        points, normals, gaps = (np.zeros((m, *one)) for one in ((3,), (3,), ()))
        for finger in range(m):
            own = np.flatnonzero(balls.tip & (balls.finger == finger))
            if not len(own):
                gaps[finger] = np.inf
                continue
            local = (where[own] - centre) @ turn
            away = shape.distance(local) - balls.radius[own]
            near = int(away.argmin())
            spot, normal = shape.nearest(local[near])
            points[finger], normals[finger] = spot @ turn.T + centre, turn @ normal
            gaps[finger] = away[near]
        active = np.abs(gaps) < _NEAR
        if active.sum() < min(_LEAST_FINGERS, m):
            continue
        left = stability_forces(points, -normals, active, centre, min_force=0.3).residual
        uneven = float(np.sqrt(np.mean(gaps[active] ** 2)))
        plans.append(GraspPlan(_POSTURE, float(yaw), points, normals, active, q))
        cost.append(float(left) + uneven / 0.005 + 0.5 * float((~active).sum()))
    return [plans[i] for i in np.argsort(cost, kind="stable")[:_TRIED]]


def searched_plans(search: GraspSearch) -> list[GraspPlan]:
    """The best of a search."""
    best = ranked(search, placements=60, keep=24)
    if best is None:
        return []
    found = best.contacts
    return [
        GraspPlan(
            _SEARCH,
            found.placement[i].yaw,
            found.position[i],
            -found.normal[i],
            found.active[i],
            found.q[i],
        )
        for i in range(min(_SEARCHED, len(found)))
    ]
