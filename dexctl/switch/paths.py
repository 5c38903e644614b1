"""Swings as joint angles over time: optimised with casadi, or through inverse kinematics."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dexctl.hand import HandModel
from dexctl.saved import check_names, fill
from dexctl.state import Floats
from dexctl.switch.chain import own_joints
from dexctl.switch.finger_ik import FingerIK
from dexctl.switch.landing import Landing, round_the_axis
from dexctl.switch.planner import SwingPlanner


class JointPath(NamedTuple):
    """Set-points of one finger's own joints over time, straight between the knots.

    Attributes:
        joints: indices into the hand's joints, ``(k,)``.
        time: of the knots, from 0, ``(K,)`` [s].
        q: set-points at the knots, ``(K, k)`` [rad].
    """

    joints: NDArray[np.intp]
    time: Floats
    q: Floats

    def at(self, time: float) -> Floats:
        """Set-points ``(k,)`` at ``time``; held before the first and after the last knot."""
        return np.array([np.interp(time, self.time, line) for line in self.q.T])

    @classmethod
    def loaded(cls, saved: object) -> JointPath:
        """The path that `_asdict` gave.

        Raises:
            InvalidInput: it is none.
        """
        parts: Mapping[str, Any] = check_names("a path", saved, cls._fields)
        knots, joints = (getattr(parts[name], "shape", ())[:1] for name in ("time", "joints"))
        path = cls(np.zeros(joints, int), np.zeros(knots), np.zeros((*knots, *joints)))
        fill("a path", path._asdict(), parts)
        return path


class SwingPaths:
    """Makes joint paths for single fingers; solvers are built when first needed.

    Args:
        hand: the hand.
        axis: unit vector; swings go round it.
        clearance: from the touched planes while swinging [m].
        speed: of the fingertip on paths from inverse kinematics [m/s].
    """

    def __init__(self, hand: HandModel, axis: Floats, clearance: float, speed: float) -> None:
        self._hand = hand
        self._axis = axis
        self._clearance = clearance
        self._speed = speed

    def prepare(self) -> None:
        """Build the planner of swings, so that a hand it is not for is refused before it moves.

        Raises:
            InvalidInput: a finger has joints that follow others.
        """
        _ = self._planner

    @cached_property
    def _planner(self) -> SwingPlanner:
        return SwingPlanner(self._hand, clearance=self._clearance, pretouch=0.4 * self._clearance)

    @cached_property
    def _ik(self) -> FingerIK:
        return FingerIK(self._hand)

    def planned(
        self, q: Floats, finger: int, tip: Floats, contact: Floats, normal: Floats, landing: Landing
    ) -> JointPath | None:
        """The optimised swing from touch here to just above touch there; None if infeasible.

        ``contact`` and ``normal`` are of the touched surface, ``tip`` is the fingertip now.
        """
        radius = max(float((contact - tip) @ normal), 0.0)
        plan = self._planner.plan(
            q,
            finger,
            lift_position=tip + radius * normal,
            lift_normal=normal,
            landing_position=landing.tip + radius * landing.normal,
            landing_normal=landing.normal,
            tip_radius=radius,
        )
        return JointPath(plan.joints, plan.time, plan.q) if plan.feasible else None

    def far(
        self,
        q: Floats,
        finger: int,
        tip: Floats,
        goal: Floats,
        origin: Floats,
        least_radius: float,
    ) -> JointPath | None:
        """Round the axis to a far ``goal`` by inverse kinematics; None where it fails.

        The way stays outside ``least_radius`` [m], see `round_the_axis`.
        """
        least = np.array([least_radius])
        joints = own_joints(self._hand, finger)
        knots, times = [q[joints]], [0.0]
        while np.linalg.norm(goal - tip) > 1e-6 and len(knots) < 30:
            following = round_the_axis(tip[None], goal[None], origin[None], self._axis, least)[0]
            found = self._ik.solve(q, finger, following)
            if not found.converged:
                return None
            times.append(times[-1] + float(np.linalg.norm(following - tip)) / self._speed)
            q, tip = found.q, following
            knots.append(q[joints])
        return JointPath(joints, np.array(times), np.array(knots))
