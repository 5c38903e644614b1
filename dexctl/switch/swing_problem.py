"""The swing of one finger as a nonlinear program, written in casadi and solved by IPOPT.

Split from the planner so that a test can look at the program.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from dexctl.state import Floats

_LENGTH = 0.01  # m: constraints on lengths are divided by it, to be of the size of angles


@dataclass(frozen=True, kw_only=True)
class SwingShape:
    """What the path has to keep to; the settings that are built into the program.

    Attributes:
        knots: K, number of knots, the present configuration among them.
        clearance: gap between fingertip and tangent planes while it swings [m].
        pretouch: gap at which the path ends, to be closed by placing until touch [m].
        lateral: greatest distance from the normal while lifting and approaching [m].
        time_weight: what a second costs, against squared joint acceleration over time
            [rad^2/s^4].
    """

    knots: int
    clearance: float
    pretouch: float
    lateral: float
    time_weight: float

    @property
    def lifted(self) -> int:
        """The knot at which the finger has lifted: a quarter of the way."""
        return self.knots // 4

    @property
    def turned(self) -> int:
        """The knot from which the landing plane counts instead of the one that was left."""
        return self.knots // 2

    @property
    def approached(self) -> int:
        """The knot at which the approach begins."""
        return self.knots - 1 - self.knots // 4


class Surface(NamedTuple):
    """A contact point and the normal there, pointing from the fingertip into the object."""

    point: Floats
    normal: Floats

    def gap(self, tip: Floats, radius: float) -> Floats:
        """Distance of the fingertip's sphere from the tangent plane, ``(...)`` [m]."""
        return (self.point - tip) @ self.normal - radius

    def off_normal(self, tip: Floats) -> Floats:
        """Distance of the tip's centre from the normal's line, ``(...)`` [m]."""
        return np.linalg.norm(np.cross(tip - self.point, self.normal), axis=-1)


class SwingProblem:
    """The program for fingers of k joints, built once; everything else is a parameter.

    Unknowns: the changes of the joints from the present configuration at knots 1 to K - 1, and
    the time h between knots. Forward kinematics is a product of exponentials about the present
    configuration: p(q + dq) = exp([S_1] dq_1) ... exp([S_k] dq_k) p(q), with S_i the joints'
    twists at q, base first (Lynch and Park, *Modern Robotics*, section 4.1). Joints that stand
    still drop out of the product, a wrist among them, so one program serves all fingers of k
    joints.
    """

    def __init__(self, joints: int, shape: SwingShape, margin: float, max_iterations: int) -> None:
        import casadi

        self.shape, self.joints = shape, joints
        self._casadi = casadi
        steps = shape.knots - 1
        change = casadi.SX.sym("change", joints, steps)
        period = casadi.SX.sym("period")
        screws = casadi.SX.sym("screws", 6, joints)
        tip = casadi.SX.sym("tip", 3)
        lift, landing = casadi.SX.sym("lift", 6), casadi.SX.sym("landing", 6)
        radius, speed = casadi.SX.sym("radius"), casadi.SX.sym("speed", joints)

        delta = casadi.horzcat(casadi.SX.zeros(joints), change)
        path = [_tip(casadi, screws, tip, delta[:, k]) for k in range(shape.knots)]
        self.tip = casadi.Function("tip", [screws, tip, change[:, 0]], [path[1]])

        def gap(surface: Any, point: Any) -> Any:
            return (casadi.dot(surface[3:], surface[:3] - point) - radius) / _LENGTH

        def off_normal(surface: Any, foot: Any, point: Any) -> Any:
            return casadi.sumsqr(casadi.cross(point - foot, surface[3:])) / shape.lateral**2

        rows, floor, ceiling = [], [], []

        def between(low: float, row: Any, high: float) -> None:
            rows.append(row)
            floor.extend([low] * row.numel())
            ceiling.extend([high] * row.numel())

        clear = (shape.clearance + margin) / _LENGTH
        moves = casadi.diff(delta, 1, 1)
        for k in range(steps):
            between(-np.inf, moves[:, k] - speed * period, 0.0)
            between(0.0, moves[:, k] + speed * period, np.inf)
        for k in range(1, shape.lifted + 1):
            between(-np.inf, off_normal(lift, tip, path[k]), 1.0)
            between(0.0, gap(lift, path[k]) - gap(lift, path[k - 1]), np.inf)
        for k in range(shape.lifted, shape.turned + 1):
            between(clear, gap(lift, path[k]), np.inf)
        for k in range(shape.turned, shape.approached + 1):
            between(clear, gap(landing, path[k]), np.inf)
        for k in range(shape.approached, steps):
            between(-np.inf, off_normal(landing, landing[:3], path[k]), 1.0)
            between(0.0, gap(landing, path[k]) - gap(landing, path[k + 1]), np.inf)
        goal = landing[:3] - (radius + shape.pretouch) * landing[3:]
        between(0.0, (path[-1] - goal) / _LENGTH, 0.0)

        # the finger is at rest before the first knot and after the last
        resting = casadi.horzcat(casadi.SX.zeros(joints), moves, casadi.SX.zeros(joints))
        acceleration = casadi.diff(resting, 1, 1) / period**2
        cost = casadi.sumsqr(acceleration) * period + shape.time_weight * steps * period

        self._bounds = np.array(floor), np.array(ceiling)
        self._solver = casadi.nlpsol(
            "swing",
            "ipopt",
            {
                "x": casadi.vertcat(casadi.vec(change), period),
                "p": casadi.vertcat(casadi.vec(screws), tip, lift, landing, radius, speed),
                "f": cost,
                "g": casadi.vertcat(*rows),
            },
            {
                "print_time": False,
                "error_on_fail": False,
                "show_eval_warnings": False,
                "ipopt.print_level": 0,
                "ipopt.sb": "yes",
                "ipopt.max_iter": max_iterations,
                "ipopt.tol": 1e-4,
                "ipopt.constr_viol_tol": 1e-6,
                "ipopt.mu_strategy": "adaptive",
            },
        )

    def solve(
        self,
        guess: Floats,
        period: float,
        *,
        screws: Floats,
        tip: Floats,
        lift: Surface,
        landing: Surface,
        radius: float,
        speed: Floats,
        lower: Floats,
        upper: Floats,
        periods: tuple[float, float],
    ) -> tuple[Floats, float, int]:
        """Solve from ``guess`` ``(K - 1, k)``; (changes ``(K - 1, k)``, period, iterations)."""
        steps = len(guess)
        parameters = [screws.T.ravel(), tip, *lift, *landing, [radius], speed]
        found = self._solver(
            x0=np.append(guess.ravel(), period),
            p=np.concatenate(parameters),
            lbx=np.append(np.tile(lower, steps), periods[0]),
            ubx=np.append(np.tile(upper, steps), periods[1]),
            lbg=self._bounds[0],
            ubg=self._bounds[1],
        )
        x = np.asarray(found["x"]).ravel()
        return x[:-1].reshape(steps, -1), float(x[-1]), int(self._solver.stats()["iter_count"])


def _tip(casadi: Any, screws: Any, tip: Any, change: Any) -> Any:
    """The fingertip after the finger's joints have changed by ``change``."""
    for joint in reversed(range(change.numel())):
        linear, angular, angle = screws[:3, joint], screws[3:, joint], change[joint]
        speed = casadi.cross(angular, tip) + linear
        # along the axis: nothing for a hinge, everything for a slide
        slide = linear + casadi.cross(angular, casadi.cross(angular, linear))
        tip = (
            tip
            + casadi.sin(angle) * speed
            + (1 - casadi.cos(angle)) * casadi.cross(angular, speed)
            + (angle - casadi.sin(angle)) * slide
        )
    return tip
