"""Which finger of each hand to switch next: the one that has gone furthest and can be spared."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dexctl.grasp import is_force_closure
from dexctl.igm import push_directions, stable_forces
from dexctl.state import Bools, Floats


class Grasps(NamedTuple):
    """The contacts of N hands as the gait sees them.

    Attributes:
        point, normal: ``(N, m, 3)``; normals of fingers out of touch are zero.
        touch: ``(N, m)``.
        firm: fingers that press hard enough to count on, ``(N, m)``.
        origin: the objects' centres, ``(N, 3)``.
        friction: that the force-closure guard assumes, ``(N,)``.
    """

    point: Floats
    normal: Floats
    touch: Bools
    firm: Bools
    origin: Floats
    friction: Floats

    def of(self, rows: NDArray[np.intp]) -> Grasps:
        """The contacts of some of the hands."""
        return Grasps(
            self.point[rows],
            self.normal[rows],
            self.touch[rows],
            self.firm[rows],
            self.origin[rows],
            self.friction[rows],
        )


class Choice(NamedTuple):
    """The finger to switch in each hand ``(N,)``, and whether there is one ``(N,)``."""

    finger: NDArray[np.intp]
    found: Bools


def choose(
    grasps: Grasps,
    travel: Floats,
    *,
    least_travel: float,
    residual_weight: float,
    residual_limit: float,
    push_friction: float,
) -> Choice:
    """The finger with the most travel whose absence the others can stand.

    Args:
        grasps: of K hands.
        travel: how far each finger has come since it was last put down, ``(K, m)`` [rad].
        least_travel: fingers below it are not worth a switch [rad].
        residual_weight: what a wrench left unbalanced counts against travel [rad]; the wrench
            is that of the stability QP without the finger, as a share of the grip.
        residual_limit: fingers that would leave more than this are not spared.
        push_friction: of `InGraspManipulationConfig.friction`.
    """
    fingers = travel.shape[1]
    missing = np.eye(fingers, dtype=bool)
    others = grasps.firm[:, None, :] & ~missing
    score = np.where(
        grasps.touch & (travel > least_travel) & (others.sum(-1) >= 3), travel, -np.inf
    )
    hopeful = np.flatnonzero(np.isfinite(score).any(axis=1))
    finger = np.zeros(len(travel), int)
    found = np.zeros(len(travel), bool)
    if not len(hopeful):
        return Choice(finger, found)
    residual = _residuals(grasps.of(hopeful), others[hopeful], push_friction)
    score = score[hopeful] - residual_weight * residual
    score[residual > residual_limit] = -np.inf
    left = np.flatnonzero(np.isfinite(score).any(axis=1))
    while len(left):
        at, best = hopeful[left], score[left].argmax(axis=1)
        holds = holds_without(grasps.of(at), best, firm_only=True)
        finger[at], found[at] = best, holds
        score[left, best] = -np.inf
        left = left[~holds & np.isfinite(score[left]).any(axis=1)]
    return Choice(finger, found)


def holds_without(grasps: Grasps, finger: NDArray[np.intp], *, firm_only: bool = False) -> Bools:
    """Whether the grasps ``(K,)`` are force closures without ``finger`` ``(K,)``."""
    if not len(finger):
        return np.zeros(0, bool)
    others = (grasps.firm if firm_only else grasps.touch).copy()
    others[np.arange(len(finger)), finger] = False
    friction = np.broadcast_to(grasps.friction[:, None], others.shape)
    return is_force_closure(grasps.point, grasps.normal, others, grasps.origin, friction)


def _residuals(grasps: Grasps, others: Bools, push_friction: float) -> Floats:
    """Wrench left by the stability QP without each finger in turn, ``(K, m)``."""
    count, fingers = grasps.touch.shape
    mask = others.reshape(-1, fingers)
    lever = np.repeat(grasps.point - grasps.origin[:, None], fingers, axis=0)
    push = push_directions(grasps.normal, grasps.point - grasps.origin[:, None], push_friction)
    push = np.repeat(push, fingers, axis=0) * mask[..., None]
    solved = stable_forces(
        lever, push, mask, mask.astype(float), min_force=0.1, regulariser=1e-3, length=None
    )
    return solved.residual.reshape(count, fingers)
