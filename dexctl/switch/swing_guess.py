"""First guesses for the swing's nonlinear program: rough, quick, and the same every time."""

from __future__ import annotations

import numpy as np

from dexctl.hand import HandModel
from dexctl.rotations import cross
from dexctl.state import Floats
from dexctl.switch.chain import Indices, spread
from dexctl.switch.swing_problem import Surface, SwingShape

_DAMPING = 1e-5  # m^2/rad^2, of the steps towards a point
_STEPS_PER_WAYPOINT = 2
_POSTURES, _STEPS_PER_POSTURE = 8, 20


def around(
    shape: SwingShape,
    clearance: float,
    tip: Floats,
    lift: Surface,
    landing: Surface,
    goal: Floats,
    radius: float,
) -> Floats:
    """A path of the fingertip from ``tip`` to ``goal`` that stays clear, ``(K - 1, 3)`` [m]."""
    up = tip - lift.normal * max(clearance - float(lift.gap(tip, radius)), 0.0)
    above = landing.point - landing.normal * (radius + clearance)
    corner = 0.5 * (up + above)
    for _ in range(20):  # alternating projections on the free sides of the two planes
        for surface in (lift, landing):
            missing = max(clearance - float(surface.gap(corner, radius)), 0.0)
            corner = corner - surface.normal * missing
    stations = [0, shape.lifted, shape.turned, shape.approached, shape.knots - 1]
    places = np.array([tip, up, corner, above, goal])
    knots = np.arange(1, shape.knots)
    return np.stack([np.interp(knots, stations, line) for line in places.T], axis=-1)


def follow(hand: HandModel, q: Floats, finger: int, joints: Indices, path: Floats) -> Floats:
    """Joint positions ``(len(path), k)`` whose fingertip is near the ``path``, from ``q`` on."""
    q, found = q.copy(), []
    for point in path:
        for _ in range(_STEPS_PER_WAYPOINT):
            _step_towards(hand, q, finger, joints, point)
        found.append(q[joints])
    return np.array(found)


def straight_to(
    hand: HandModel, q: Floats, finger: int, joints: Indices, goal: Floats, count: int
) -> Floats | None:
    """A straight line in the joints to a posture that reaches ``goal``, ``(count, k)``.

    The posture is the one nearest to ``q`` of those found from several starts; None where no
    start got there, and the goal is most likely out of reach.
    """
    lower, upper = np.maximum(hand.lower, -np.pi)[joints], np.minimum(hand.upper, np.pi)[joints]
    postures = np.tile(q, (_POSTURES, 1))
    postures[1:, joints] = lower + (upper - lower) * spread(_POSTURES - 1, len(joints))
    for _ in range(_STEPS_PER_POSTURE):
        _step_towards(hand, postures, finger, joints, goal)
    missed = np.linalg.norm(hand.fingertip_positions(postures)[:, finger] - goal, axis=-1)
    distance = np.abs(postures - q).max(axis=-1)
    best = int(np.argmin(np.where(missed < 1e-4, distance, np.inf)))
    if missed[best] >= 1e-4:
        return None
    share = np.arange(1, count + 1)[:, None] / count
    return q[joints] + share * (postures[best] - q)[joints]


def _step_towards(hand: HandModel, q: Floats, finger: int, joints: Indices, point: Floats) -> None:
    """Move the finger's joints in ``q`` ``(..., d)`` one damped step, within their limits."""
    lower, upper = hand.lower[joints], hand.upper[joints]
    now = hand.configuration(q)
    tip, twist = now.fingertip_position[..., finger, :], now.joint_twist[..., joints]
    moves = np.swapaxes(twist, -1, -2)
    jacobian = moves[..., :3] + cross(moves[..., 3:], tip[..., None, :])  # (..., k, 3)
    pull = (jacobian @ (point - tip)[..., None])[..., 0]
    here = q[..., joints]
    # joints that would leave their range stand still, and the others do their part
    held = ((here <= lower) & (pull < 0)) | ((here >= upper) & (pull > 0))
    jacobian = np.where(held[..., None], 0.0, jacobian)
    damped = np.swapaxes(jacobian, -1, -2) @ jacobian + _DAMPING * np.eye(3)
    step = jacobian @ np.linalg.solve(damped, (point - tip)[..., None])
    q[..., joints] = np.clip(here + step[..., 0], lower, upper)
