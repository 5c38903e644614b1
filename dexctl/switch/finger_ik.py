"""FingerIK: where must a finger's joints be for its tip to be at a given point?

A controller follows its finger's Jacobian for a small step; this is for far placements, where such
steps run into a joint limit and stay there.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from dexctl.exceptions import InvalidInput
from dexctl.grasp.box_qp import solve_box_batch
from dexctl.hand import HandModel
from dexctl.state import Bools, Floats
from dexctl.switch.chain import Indices, check_finger, own_joints, spread
from dexctl.validation import check_vector

_ITERATIONS_PER_START = 25
_DAMPING = 1e-8  # m^2/rad^2: keeps steps finite where the finger is straight
_FAR = 1.0  # of the squared distance, more of the same: the linear model is worse from afar
_MAX_STEP = 0.5  # rad: the linear model of a step holds no further than this
_ROUND_OFF = 1e-12  # of multipliers


class IKResult(NamedTuple):
    """What the solver found.

    Attributes:
        q: joint positions of the whole hand, ``(d,)`` [rad]; only the finger's own joints differ
            from those given, and they are within their limits.
        error: distance of the fingertip from the target [m].
        converged: whether ``error`` is within the tolerance.
        iterations: quadratic programs solved, over all starts.
    """

    q: Floats
    error: float
    converged: bool
    iterations: int


class FingerIK:
    """Inverse kinematics of one finger at a time, position only, within joint limits.

    Each step is a quadratic program: the damped least squares of Levenberg and Marquardt over the
    finger's own joints (Sugihara, "Solvability-unconcerned inverse kinematics by the
    Levenberg-Marquardt method", 2011), with the joint limits and the length of a step as bounds.
    Joints that follow another go with it, and all others stay. The first start is where the finger
    is; if that gets stuck, others follow, spread over the finger's joint range, the same every
    time.

    Args:
        hand: the hand.
    """

    def __init__(self, hand: HandModel) -> None:
        self.hand = hand
        self._own = [own_joints(hand, finger) for finger in range(hand.n_fingers)]
        self._lower = np.maximum(hand.lower, -np.pi)
        self._upper = np.minimum(hand.upper, np.pi)

    def solve(
        self,
        q: ArrayLike,
        finger: int,
        target_position: ArrayLike,
        *,
        tolerance: float = 1e-4,
        max_iterations: int = 200,
    ) -> IKResult:
        """Move the finger's own joints until its tip is at ``target_position``.

        Args:
            q: joint positions to start from, ``(d,)`` [rad]; the other joints stay there.
            finger: index of the finger.
            target_position: where the fingertip is wanted, hand frame, ``(3,)`` [m].
            tolerance: distance from the target that is close enough [m].
            max_iterations: most quadratic programs to solve, over all starts.

        Returns:
            The solution, or, with ``converged`` False, the closest point that was found.

        Raises:
            InvalidInput: q or target of another size or not finite, a tolerance or a number of
                iterations that is not above 0, a finger without a joint of its own.
            UnknownName: the hand has no such finger.
        """
        finger = check_finger(self.hand, finger)
        q = check_vector("q", q, self.hand.nq)
        target = check_vector("target_position", target_position, 3)
        if not tolerance > 0:
            raise InvalidInput(f"tolerance is {tolerance}; expected metres above 0")
        if max_iterations < 1:
            raise InvalidInput(f"max_iterations is {max_iterations}; expected at least 1")
        if not len(self._own[finger]):
            raise InvalidInput(
                f"finger {self.hand.fingertip_names[finger]!r} has no joint of its own: all move "
                "other fingertips too"
            )
        best, used, start = IKResult(q, np.inf, False, 0), 0, 0
        while used < max_iterations and not best.converged:
            budget = min(_ITERATIONS_PER_START, max_iterations - used)
            begin = self._start(q, finger, start)
            found, error, count = self._descend(begin, finger, target, tolerance, budget)
            used, start = used + count, start + 1
            if error < best.error:
                best = IKResult(found, error, error <= tolerance, used)
        return best._replace(iterations=used)

    def _start(self, q: Floats, finger: int, number: int) -> Floats:
        """The ``number``-th configuration to start from; the first is ``q`` within its limits."""
        own, q = self._own[finger], q.copy()
        lower, upper = self._lower[own], self._upper[own]
        if number == 0:
            q[own] = self.hand.clip(q)[own]
        else:
            q[own] = lower + (upper - lower) * spread(number, len(own))[-1]
        return q

    def _descend(
        self, q: Floats, finger: int, target: Floats, tolerance: float, budget: int
    ) -> tuple[Floats, float, int]:
        """Take up to ``budget`` steps from ``q``: what is reached, how far off, and the number."""
        own, q, previous, count = self._own[finger], q.copy(), np.inf, 0
        lower, upper = self.hand.lower[own], self.hand.upper[own]
        while True:
            configuration = self.hand.configuration(q)
            tips = configuration.fingertip_position
            off = target - tips[finger]
            error = float(np.linalg.norm(off))
            settled = error <= tolerance or abs(previous - error) < 1e-3 * tolerance
            if settled or count == budget:
                return q, error, count
            previous = error
            jacobian = configuration.contact_jacobian(tips)[finger][:, own]
            hessian = jacobian.T @ jacobian
            hessian.flat[:: len(own) + 1] += _DAMPING + _FAR * error**2
            step = _bounded(
                hessian,
                jacobian.T @ off,
                np.maximum(lower - q[own], -_MAX_STEP),
                np.minimum(upper - q[own], _MAX_STEP),
            )
            q[own] = np.clip(q[own] + step, lower, upper)
            count += 1


def _bounded(hessian: Floats, linear: Floats, lower: Floats, upper: Floats) -> Floats:
    """The least of x'Hx/2 - b'x within bounds ``(k,)``."""
    anywhere = np.asarray(np.linalg.solve(hessian, linear), float)
    if (lower <= anywhere).all() and (anywhere <= upper).all():
        return anywhere

    def solve(_: Indices, free: Bools, held: Floats) -> Floats:
        inside, x = free[0], held[0].copy()
        rest = linear - hessian @ x
        x[inside] = np.linalg.solve(hessian[np.ix_(inside, inside)], rest[inside])
        return np.where(inside, x, hessian @ x - linear)[None]

    scale = max(float(np.abs(linear).max()), _ROUND_OFF)
    found, _ = solve_box_batch(
        solve,
        np.where(lower < upper, 0, 1)[None].astype(np.int8),
        lower[None],
        upper[None],
        np.array([scale]),
        np.array([_ROUND_OFF * scale]),
    )
    return found[0]
