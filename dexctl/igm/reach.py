"""Reach: how far fingers can still go with the object, each along the velocity wanted of it.

Three ends are distances along that velocity, to first order, so they look ahead only where the
finger is going: a finger at an end is free to come back. So it is at the fourth, the friction cone:
what counts is the push along the turn, whose sign turns with it.
"""

from __future__ import annotations

import numpy as np

from dexctl.configuration import HandConfiguration
from dexctl.hand import HandModel
from dexctl.igm.config import SLIP_SHARE, InGraspManipulationConfig
from dexctl.igm.inverse import solve_symmetric3
from dexctl.rotations import cross
from dexctl.state import Bools, Floats


class Reach:
    """The share of the wanted motion that the fingers have reach for.

    A finger ends where a joint is at its limit; where its Jacobian grows singular along the wanted
    velocity v (with A = J J^T + damping^2 I and g = v^T A^-1 v, which is infinite there but for the
    damping, Newton's step to the zero of 1 / g takes the time g / g'); and where the contact has
    rolled from the fingertip to its link. A turn ends where the object does not follow: set-points
    run ahead of joints, and what they push along it nears what friction bears. With joints of one
    stiffness k the force of a finger is f = k A^-1 J (q_target - q); the sum of f v over that of
    (f n) |v| says how much of the friction cone is taken up, whatever k is. v is that of the turn
    only: along a line, the weight of object and fingers would count.

    Args:
        hand: the hand.
        config: the settings.
    """

    def __init__(self, hand: HandModel, config: InGraspManipulationConfig) -> None:
        self._config = config
        self._joints = hand.finger_joints
        self._count = hand.moves.sum(axis=1)
        lower, upper = hand.lower[self._joints], hand.upper[self._joints]
        # a filled-up place repeats joint 0, which is not of this finger
        own = np.arange(self._joints.shape[1]) < self._count[:, None]
        self._lower, self._upper = np.where(own, lower, -np.inf), np.where(own, upper, np.inf)
        self._ridge = config.damping**2 * np.eye(3)

    def __call__(
        self,
        now: HandConfiguration,
        q: Floats,
        q_target: Floats,
        twist: Floats,
        point: Floats,
        normal: Floats,
        lever: Floats,
        fingers: Bools,
    ) -> Floats:
        """From 1, nothing near its end, to 0, some finger at it, ``(N,)``.

        Args:
            now: the hand at ``q`` ``(N, d)``.
            q, q_target: joints and their set-points [rad].
            twist: wanted of the object, ``(N, 6)``.
            point: contacts, or fingertips out of touch, ``(N, m, 3)``; ``lever`` from the centre.
            normal: unit, zero out of touch, ``(N, m, 3)``.
            lever: see ``point``.
            fingers: those that count, ``(N, m)``.
        """
        config = self._config
        velocity = twist[:, None, :3] + cross(twist[:, None, 3:], lever)
        speed = np.sqrt((velocity * velocity).sum(axis=-1))
        jacobian = now.finger_jacobian(point)
        gram = jacobian.swapaxes(-1, -2) @ jacobian + self._ridge
        weight = solve_symmetric3(gram, velocity)
        rate = (jacobian @ weight[..., None])[..., 0]
        own = np.where(rate > 0, self._upper, self._lower) - q[:, self._joints]
        with np.errstate(divide="ignore", invalid="ignore"):
            to_limit = np.where(rate != 0, own / rate, np.inf).min(axis=-1)

            # how the Jacobian's rows change while the joints move: those above carry a joint along
            moved = rate[..., None] * now.finger_twist
            below = np.cumsum(moved, axis=-2)
            above = below - moved
            spin, turning = above[..., 3:], now.finger_twist[..., 3:]
            change = cross(spin, now.finger_twist[..., :3]) + cross(above[..., :3], turning)
            change += cross(cross(spin, turning), point[..., None, :])
            tip = (jacobian * rate[..., None]).sum(axis=-2)
            change += cross(turning, tip[..., None, :])
            along = (change * weight[..., None, :]).sum(axis=-1)
            growth = -2.0 * (rate * along).sum(axis=-1)
            size = (velocity * weight).sum(axis=-1)
            to_singular = np.where(growth > 0, size / growth, np.inf)

            # from the tip back along its link: across the axis of the last joint
            last = now.finger_twist[:, np.arange(len(self._count)), self._count - 1]
            arm = last[..., :3] + cross(last[..., 3:], now.fingertip_position)
            back = cross(last[..., 3:], arm)
            length = np.sqrt((back * back).sum(axis=-1, keepdims=True))
            back = back / np.maximum(length, 1e-12)
            lean = (normal * back).sum(axis=-1)
            link = below[:, np.arange(len(self._count)), self._count - 1, 3:]
            rolling = ((twist[:, None, 3:] - link) * cross(normal, back)).sum(axis=-1)
            to_link = np.where(rolling > 0, (config.link_limit - lean) / rolling, np.inf)

            margin = speed * np.minimum(to_limit, to_singular) - config.reach_margin
            way = np.minimum(margin, np.where(np.isinf(to_link), np.inf, speed * to_link))
        way = np.where(fingers & (speed > 1e-9), way, np.inf).min(axis=-1)
        share = np.clip(way / config.reach_distance, 0.0, 1.0)
        if not config.slip_limit:
            return share
        lead = (q_target - q)[:, self._joints]
        force = solve_symmetric3(gram, (lead[..., None, :] @ jacobian)[..., 0, :])
        taken = _friction_taken(force, normal, cross(twist[:, None, 3:], lever), fingers)
        left = (1.0 - taken / config.slip_limit) / SLIP_SHARE
        return np.minimum(share, np.clip(left, 0.0, 1.0))


def _friction_taken(force: Floats, normal: Floats, turn: Floats, fingers: Bools) -> Floats:
    """What ``fingers`` push along the velocities ``turn`` over what they press with, ``(N,)``."""
    holding = fingers & normal.any(axis=-1)
    along = np.where(holding, (force * turn).sum(axis=-1), 0.0).sum(axis=-1)
    pressed = np.where(holding, np.maximum((force * normal).sum(axis=-1), 0.0), 0.0)
    bears = (pressed * np.sqrt((turn * turn).sum(axis=-1))).sum(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(along > 0.0, along / bears, 0.0)
