"""SwingPlanner: plans how a finger lifts, swings and comes down, as a small nonlinear program.

This is casadi's door into the switch room.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from dexctl.exceptions import InvalidInput
from dexctl.hand import HandModel, random_configurations
from dexctl.state import Floats
from dexctl.switch import swing_guess
from dexctl.switch.chain import Indices, check_finger, own_joints
from dexctl.switch.swing_problem import Surface, SwingProblem, SwingShape
from dexctl.validation import check_vector

_MARGIN = 5e-4  # m: the path bows between knots; kept at the knots on top of the clearance
_SAMPLES = 4  # per segment, where the plan is checked
_LENGTH_TOLERANCE, _ANGLE_TOLERANCE = 1e-4, 1e-6  # m, rad and rad/s: what counts as kept


@dataclass(frozen=True, kw_only=True, eq=False)
class SwingPlan:
    """The path of one finger, from touching here to just above touching there.

    Attributes:
        finger: index of the finger.
        joints: the finger's own joints, indices into the hand's, base to tip, ``(k,)``.
        time: when each knot is reached, from 0, ``(K,)`` [s].
        q: joint set-points at the knots, ``(K, k)`` [rad]; straight lines between them.
        tip: fingertip position at the knots, world frame, ``(K, 3)`` [m].
        feasible: whether everything asked is kept, at the knots and between them.
        violations: what is not kept, by how much: [m], "joint limits" [rad], "speed" [rad/s].
        iterations: of the solver.
        solve_time: wall time of the planning [s].
    """

    finger: int
    joints: Indices
    time: Floats
    q: Floats
    tip: Floats
    feasible: bool
    violations: dict[str, float] = field(default_factory=dict)
    iterations: int
    solve_time: float

    @property
    def duration(self) -> float:
        """Time from the first knot to the last [s]."""
        return float(self.time[-1])

    def at(self, time: ArrayLike) -> Floats:
        """Set-points ``(..., k)`` [rad] at ``time`` ``(...)`` [s]; held before and after."""
        time = np.asarray(time, float)
        return np.stack([np.interp(time, self.time, line) for line in self.q.T], axis=-1)


class SwingPlanner:
    """Plans swings for the fingers of one hand.

    A controller does not know the object's shape, only the plane that it touched and the plane
    that it expects to touch; for a convex object, everything beyond either of them is free. So
    the path, with the fingertip as a sphere:

    1. starts at the present configuration, at rest, and leaves along the outward normal, until
       the gap to the plane it touched is the clearance;
    2. keeps that gap up to the middle of the path, and from the middle on the same gap to the
       plane where it lands (in the middle both: the corner that the two planes make);
    3. comes down along the normal there, and ends at rest, ``pretouch`` above touch. What is
       left is for a controller that feels.

    It stays within the joint limits and speed limits, and has the least joint acceleration
    (squared, over time) plus ``time_weight`` times duration. The plan is then checked against
    HandModel's kinematics at the knots and between them, so ``feasible`` does not rest on the
    solver's word. The solver is capped by iterations, not by time: the same question has the same
    answer however busy the machine is. Where it fails, it gets a second guess. Other fingers and
    the finger's own links are not looked at.

    Args:
        hand: the hand; joints that follow others are not supported.
        knots: K, number of knots, at least 8.
        clearance: gap to the planes while swinging [m].
        pretouch: gap at the end [m], less than the clearance.
        lateral: greatest distance from the normal while lifting and coming down [m].
        speed_limit: joint speed limits, one number or ``(d,)`` [rad/s]; the hand's own are kept
            too.
        duration: shortest and longest duration of a plan [s].
        time_weight: what a second costs [rad^2/s^4]; more makes plans shorter.
        max_iterations: of the solver.

    Raises:
        InvalidInput: a value out of range, or a finger with joints that follow others.
    """

    def __init__(
        self,
        hand: HandModel,
        *,
        knots: int = 13,
        clearance: float = 0.012,
        pretouch: float = 0.004,
        lateral: float = 0.003,
        speed_limit: ArrayLike = 2.0,
        duration: tuple[float, float] = (0.2, 3.0),
        time_weight: float = 20.0,
        max_iterations: int = 100,
    ) -> None:
        self._arguments = {
            "knots": knots,
            "clearance": clearance,
            "pretouch": pretouch,
            "lateral": lateral,
            "speed_limit": speed_limit,
            "duration": duration,
            "time_weight": time_weight,
            "max_iterations": max_iterations,
        }
        for name, least in (("knots", 8), ("max_iterations", 1)):
            value = self._arguments[name]
            if not isinstance(value, (int, np.integer)) or value < least:
                raise InvalidInput(f"{name} is {value!r}; expected an integer of at least {least}")
        for name in ("clearance", "pretouch", "lateral", "time_weight"):
            value = self._arguments[name]
            if not (np.isfinite(value) and value > 0):
                raise InvalidInput(f"{name} is {value}; expected a finite number above 0")
        if pretouch >= clearance:
            raise InvalidInput(
                f"pretouch is {pretouch} m; expected less than clearance, {clearance}"
            )
        shortest, longest = check_vector("duration", duration, 2)
        if not 0 < shortest <= longest:
            raise InvalidInput(f"duration is {duration}; expected 0 < shortest <= longest [s]")
        speed = np.asarray(speed_limit, float)
        if speed.shape not in ((), (hand.nq,)) or not (speed > 0).all():
            raise InvalidInput(
                f"speed_limit is {speed.tolist()}; expected one number or {hand.nq}, above 0"
            )
        self.hand = hand
        self.shape = SwingShape(
            knots=knots,
            clearance=clearance,
            pretouch=pretouch,
            lateral=lateral,
            time_weight=time_weight,
        )
        # 1e3 rad/s for a joint without any limit: the program needs a number
        self.speed_limit = np.minimum(np.minimum(speed, hand.velocity), 1e3)
        self.max_iterations = max_iterations
        self._periods = (shortest / (knots - 1), longest / (knots - 1))
        self._joints = [own_joints(hand, finger) for finger in range(hand.n_fingers)]
        self._problems: dict[int, SwingProblem] = {}
        for finger in range(hand.n_fingers):
            if len(self._joints[finger]):
                self._check_chain(finger)

    def __reduce__(self) -> tuple:
        return partial(type(self), self.hand, **self._arguments), ()  # solvers are not pickled

    def plan(
        self,
        q: ArrayLike,
        finger: int,
        *,
        lift_position: ArrayLike,
        lift_normal: ArrayLike,
        landing_position: ArrayLike,
        landing_normal: ArrayLike,
        tip_radius: float | None = None,
    ) -> SwingPlan:
        """Plan the swing of one finger.

        Args:
            q: joint positions now, ``(d,)`` [rad].
            finger: index of the finger.
            lift_position: where it touches now, world frame, ``(3,)`` [m].
            lift_normal: unit normal there, from the fingertip into the object.
            landing_position: where it is to touch, ``(3,)`` [m].
            landing_normal: unit normal expected there, from the fingertip into the object.
            tip_radius: of the fingertip's sphere [m]. None: the distance along the normal from
                the fingertip's frame to the touched point now.

        Returns:
            The plan; where nothing feasible was found, the solver's last path, with
            ``feasible`` False and what it violates.

        Raises:
            InvalidInput: an array of another size or not finite, a normal that is not of unit
                length, a negative radius.
            UnknownName: the hand has no such finger.
        """
        started = time.perf_counter()
        finger = check_finger(self.hand, finger)
        if not len(self._joints[finger]):
            raise InvalidInput(
                f"finger {self.hand.fingertip_names[finger]!r} has no joint of its own: all move "
                "other fingertips too"
            )
        q = check_vector("q", q, self.hand.nq)
        lift = _surface("lift", lift_position, lift_normal)
        landing = _surface("landing", landing_position, landing_normal)
        tip = self.hand.fingertip_positions(q)[finger]
        radius = max(float(lift.gap(tip, 0.0)), 0.0) if tip_radius is None else float(tip_radius)
        if not (np.isfinite(radius) and radius >= 0):
            raise InvalidInput(f"tip_radius is {radius}; expected metres, not negative")

        joints, shape = self._joints[finger], self.shape
        goal = landing.point - landing.normal * (radius + shape.pretouch)
        path = swing_guess.around(
            shape, shape.clearance + 2 * _MARGIN, tip, lift, landing, goal, radius
        )
        guess = swing_guess.follow(self.hand, q, finger, joints, path)
        question = (q, finger, lift, landing, radius)
        best = self._solve(guess, *question)
        if not best.feasible:
            # the guess may have run into a joint limit on its way: try one that did not
            guess = swing_guess.straight_to(self.hand, q, finger, joints, goal, shape.knots - 1)
            if guess is not None:
                plans = best, self._solve(guess, *question)
                best = min(plans, key=lambda plan: sum(plan.violations.values()))
        return replace(best, solve_time=time.perf_counter() - started)

    def _solve(
        self, guess: Floats, q: Floats, finger: int, lift: Surface, landing: Surface, radius: float
    ) -> SwingPlan:
        """Solve the program from one guess, ``(K - 1, k)`` [rad], and check what comes out."""
        joints, steps = self._joints[finger], self.shape.knots - 1
        now = self.hand.configuration(q)
        lower, upper = self.hand.lower[joints], self.hand.upper[joints]
        speed = np.broadcast_to(self.speed_limit, self.hand.nq)[joints]
        fastest = np.abs(np.diff(guess, axis=0, prepend=q[None, joints]) / speed).max()
        change, period, iterations = self._problem(len(joints)).solve(
            guess - q[joints],
            float(np.clip(2.0 * fastest, *self._periods)),
            screws=now.joint_twist[:, joints],
            tip=now.fingertip_position[finger],
            lift=lift,
            landing=landing,
            radius=radius,
            speed=speed,
            lower=lower - q[joints],
            upper=upper - q[joints],
            periods=self._periods,
        )
        if not (np.isfinite(change).all() and np.isfinite(period)):
            change, period = guess - q[joints], self._periods[1]
        knots = np.tile(q, (steps + 1, 1))
        knots[1:, joints] = np.clip(q[joints] + change, lower, upper)
        violations = self._violations(knots, finger, period, lift, landing, radius)
        return SwingPlan(
            finger=finger,
            joints=joints,
            time=period * np.arange(float(steps + 1)),
            q=knots[:, joints],
            tip=self.hand.fingertip_positions(knots)[:, finger],
            feasible=not violations,
            violations=violations,
            iterations=iterations,
            solve_time=0.0,
        )

    def _problem(self, joints: int) -> SwingProblem:
        if joints not in self._problems:
            self._problems[joints] = SwingProblem(joints, self.shape, _MARGIN, self.max_iterations)
        return self._problems[joints]

    def _check_chain(self, finger: int) -> None:
        """Raise where the product of exponentials is not the finger's kinematics."""
        start, *others = random_configurations(self.hand, 4, seed=0)
        now, joints = self.hand.configuration(start), self._joints[finger]
        chain = self._problem(len(joints)).tip
        for other in others:
            q = start.copy()
            q[joints] = other[joints]
            said = chain(
                now.joint_twist[:, joints], now.fingertip_position[finger], (q - start)[joints]
            )
            found = self.hand.fingertip_positions(q)[finger]
            if np.abs(np.asarray(said).ravel() - found).max() > 1e-9:
                raise InvalidInput(
                    f"finger {self.hand.fingertip_names[finger]!r} of {self.hand.path} has joints "
                    "that follow others; SwingPlanner needs fingers without"
                )

    def _violations(
        self,
        knots: Floats,
        finger: int,
        period: float,
        lift: Surface,
        landing: Surface,
        radius: float,
    ) -> dict[str, float]:
        """What the path ``(K, d)`` does not keep, at the knots and between them."""
        shape, hand, joints = self.shape, self.hand, self._joints[finger]
        share = np.arange(0.0, 1.0, 1.0 / _SAMPLES)[:, None]
        dense = (knots[:-1, None] + share * np.diff(knots, axis=0)[:, None]).reshape(-1, hand.nq)
        tip = hand.fingertip_positions(np.concatenate([dense, knots[-1:]]))[:, finger]
        lifted, turned, approached = (
            _SAMPLES * k for k in (shape.lifted, shape.turned, shape.approached)
        )
        away, above = lift.gap(tip, radius), landing.gap(tip, radius)
        goal = landing.point - landing.normal * (radius + shape.pretouch)
        left = Surface(tip[0], lift.normal)  # the line it leaves along goes through its centre
        speeds = np.abs(np.diff(knots[:, joints], axis=0)) / period
        limits = np.broadcast_to(self.speed_limit, hand.nq)[joints]
        beyond = np.maximum(hand.lower - knots[1:], knots[1:] - hand.upper)[:, joints]
        lengths = {
            "lift line": left.off_normal(tip[: lifted + 1]).max() - shape.lateral,
            "lift": -np.diff(away[: lifted + 1]).min(),
            "lift clearance": shape.clearance - away[lifted : turned + 1].min(),
            "landing clearance": shape.clearance - above[turned : approached + 1].min(),
            "approach line": landing.off_normal(tip[approached:]).max() - shape.lateral,
            "approach": np.diff(above[approached:]).max(),
            "landing": np.linalg.norm(tip[-1] - goal),
        }
        angles = {"joint limits": beyond.max(), "speed": (speeds - limits).max()}
        return {
            name: float(amount)
            for amounts, tolerance in (
                (lengths, _LENGTH_TOLERANCE),
                (angles, _ANGLE_TOLERANCE),
            )
            for name, amount in amounts.items()
            if amount > tolerance
        }


def _surface(name: str, position: ArrayLike, normal: ArrayLike) -> Surface:
    point = check_vector(f"{name}_position", position, 3)
    direction = check_vector(f"{name}_normal", normal, 3)
    length = float(np.linalg.norm(direction))
    if abs(length - 1.0) > 1e-3:
        raise InvalidInput(f"{name}_normal is {direction.tolist()}; expected unit length")
    return Surface(point, direction / length)
