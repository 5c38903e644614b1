"""FingerIK: where must a finger's joints be for its tip to be at a given point?

This is mink's door into the switch room. A controller follows its finger's Jacobian for a small
step; this is for far placements, where such steps run into a joint limit and stay there.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from dexctl.exceptions import HandModelError, InvalidInput
from dexctl.hand import HandModel
from dexctl.state import Floats
from dexctl.switch.chain import Indices, check_finger, own_joints, spread
from dexctl.validation import check_vector

_ITERATIONS_PER_START = 25
_DAMPING = 1e-8  # m^2/rad^2: keeps steps finite where the finger is straight
_MAX_STEP = 0.5  # rad: the linear model of a step holds no further than this


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

    Each step is mink's quadratic program: a frame task on the fingertip, joint limits as
    inequalities, every joint that is not the finger's own frozen by an equality, and joints that
    follow another kept with it by their equality. The first start is where the finger is; if that
    gets stuck, others follow, spread over the finger's joint range, the same every time.

    Args:
        hand: the hand; its file must be an MJCF. Other bodies in it stay where the file has them.

    Raises:
        InvalidInput: the hand comes from a file that is not an MJCF.
        HandModelError: a fingertip's body is no longer found in the file.
    """

    def __init__(self, hand: HandModel) -> None:
        import mink
        import mujoco

        self.hand = hand
        spec = _read(hand, mujoco)
        self._sites = [f"dexctl fingertip {i}" for i in range(hand.n_fingers)]
        for finger, site in enumerate(self._sites):
            _tip_body(hand, finger, spec).add_site(name=site, pos=hand.fingertip_offsets[finger])
        self._model = spec.compile()
        self._configuration = mink.Configuration(self._model)
        names = [self._model.joint(j).name or f"joint {j}" for j in range(self._model.njnt)]
        self._joint = np.array([names.index(name) for name in hand.joint_names])
        self._address = self._model.jnt_qposadr[self._joint]
        self._couplings = _couplings(self._model, mujoco)
        self._problems: dict[int, _Problem] = {}

    def __reduce__(self) -> tuple:
        return type(self), (self.hand,)  # the compiled model is rebuilt, not pickled

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
            target_position: where the fingertip is wanted, world frame, ``(3,)`` [m].
            tolerance: distance from the target that is close enough [m].
            max_iterations: most quadratic programs to solve, over all starts.

        Returns:
            The solution, or, with ``converged`` False, the closest point that was found.

        Raises:
            InvalidInput: q or target of another size or not finite, a tolerance or a number of
                iterations that is not above 0.
            UnknownName: the hand has no such finger.
        """
        finger = check_finger(self.hand, finger)
        q = check_vector("q", q, self.hand.nq)
        target = check_vector("target_position", target_position, 3)
        if not tolerance > 0:
            raise InvalidInput(f"tolerance is {tolerance}; expected metres above 0")
        if max_iterations < 1:
            raise InvalidInput(f"max_iterations is {max_iterations}; expected at least 1")
        if finger not in self._problems:
            self._problems[finger] = _Problem(self, finger)
        problem = self._problems[finger]

        best, used, start = IKResult(q, np.inf, False, 0), 0, 0
        while used < max_iterations and not best.converged:
            budget = min(_ITERATIONS_PER_START, max_iterations - used)
            found, count = problem.descend(problem.start(q, start), target, tolerance, budget)
            used, start = used + count, start + 1
            error = float(np.linalg.norm(self.hand.fingertip_positions(found)[finger] - target))
            if error < best.error:
                best = IKResult(found, error, error <= tolerance, used)
        return best._replace(iterations=used)

    def _qpos(self, q: Floats) -> Floats:
        """MuJoCo's positions for ``q``: other bodies at rest, followers with their masters."""
        qpos = self._model.qpos0.copy()
        qpos[self._address] = q
        for _ in self._couplings:  # once for each link that a chain of followers could have
            for _, follower, master, scale, offset in self._couplings:
                qpos[follower] = offset + scale * (qpos[master] if master >= 0 else 0.0)
        return qpos


class _Problem:
    """mink's tasks, limits and constraints for one finger."""

    def __init__(self, ik: FingerIK, finger: int) -> None:
        import mink

        self._ik, model = ik, ik._model
        self._own = own_joints(ik.hand, finger)
        if not len(self._own):
            raise InvalidInput(
                f"finger {ik.hand.fingertip_names[finger]!r} has no joint of its own: all move "
                "other fingertips too"
            )
        self._site = ik._sites[finger]
        free, equalities = _moved(ik, self._own)
        frozen = sorted(set(range(model.nv)) - free)
        self._task = mink.FrameTask(
            self._site, "site", position_cost=1.0, orientation_cost=0.0, lm_damping=1.0
        )
        self._constraints: list[Any] = []
        if frozen:
            self._constraints.append(mink.DofFreezingTask(model, frozen))
        if equalities:
            self._constraints.append(mink.EqualityConstraintTask(model, 1.0, equalities))
        limit = mink.ConfigurationLimit(model, gain=1.0)
        others = np.setdiff1d(np.arange(model.nq), ik._address[self._own])
        # a joint that may not move would make the program infeasible where it is beyond its limit
        limit.lower[others], limit.upper[others] = -1e10, 1e10
        speed: dict[Any, float] = {int(j): _MAX_STEP for j in ik._joint[self._own]}
        self._limits = [limit, mink.VelocityLimit(model, speed)]

    def start(self, q: Floats, number: int) -> Floats:
        """The ``number``-th configuration to start from; the first is ``q`` within its limits."""
        lower = np.maximum(self._ik.hand.lower[self._own], -np.pi)
        upper = np.minimum(self._ik.hand.upper[self._own], np.pi)
        q = q.copy()
        if number == 0:
            q[self._own] = np.clip(q[self._own], lower, upper)
        else:
            q[self._own] = lower + (upper - lower) * spread(number, len(self._own))[-1]
        return q

    def descend(
        self, q: Floats, target: Floats, tolerance: float, budget: int
    ) -> tuple[Floats, int]:
        """Take up to ``budget`` steps from ``q``; the configuration reached, and the number."""
        import mink
        import qpsolvers

        configuration = self._ik._configuration
        configuration.update(self._ik._qpos(q))
        previous = np.inf
        for count in range(budget):
            pose = configuration.get_transform_frame_to_world(self._site, "site")
            error = float(np.linalg.norm(pose.translation() - target))
            # half the tolerance: the answer is judged once more, by pinocchio
            if error <= 0.5 * tolerance or abs(previous - error) < 1e-3 * tolerance:
                return self._joints(q), count
            previous = error
            # the target takes the tip's present orientation, so that the task's error, a
            # logarithm of the pose, is the plain difference of positions
            goal = mink.SE3.from_rotation_and_translation(pose.rotation(), target)
            self._task.set_target(goal)
            problem = mink.build_ik(
                configuration,
                [self._task],
                1.0,
                damping=_DAMPING,
                limits=self._limits,
                constraints=self._constraints or None,
            )
            solution = qpsolvers.solve_problem(problem, solver="daqp")
            if not solution.found or solution.x is None:
                return self._joints(q), count + 1
            configuration.integrate_inplace(solution.x, 1.0)
        return self._joints(q), budget

    def _joints(self, q: Floats) -> Floats:
        """``q`` with the finger's own joints as they are now, within their limits."""
        reached = q.copy()
        reached[self._own] = self._ik._configuration.q[self._ik._address[self._own]]
        reached[self._own] = self._ik.hand.clip(reached)[self._own]
        return reached


def _read(hand: HandModel, mujoco: Any) -> Any:
    """The hand's file, to be added to and compiled."""
    if hand.path.suffix.lower() == ".urdf":
        raise InvalidInput(f"hand is from {hand.path}; FingerIK needs a hand from an MJCF file")
    try:
        return mujoco.MjSpec.from_file(str(hand.path))
    except ValueError as error:
        raise HandModelError(f"{hand.path}: MuJoCo cannot read it: {error}") from None


def _tip_body(hand: HandModel, finger: int, spec: Any) -> Any:
    body = spec.body(hand.fingertip_bodies[finger])
    if body is None:  # a body without a name, found through the site on it
        site = spec.site(hand.fingertip_names[finger])
        body = None if site is None else site.parent
    if body is None:
        raise HandModelError(f"{hand.path}: no body {hand.fingertip_bodies[finger]!r} any more")
    return body


def _couplings(model: Any, mujoco: Any) -> list[tuple[int, int, int, float, float]]:
    """(equality, follower's and master's position address, scale, offset); master -1: none."""
    found = []
    for e in range(model.neq):
        if model.eq_type[e] != mujoco.mjtEq.mjEQ_JOINT or not model.eq_active0[e]:
            continue
        follower = int(model.jnt_qposadr[model.eq_obj1id[e]])
        constant, scale = (float(x) for x in model.eq_data[e, :2])
        offset, master = model.qpos0[follower] + constant, -1
        if model.eq_obj2id[e] >= 0:
            master = int(model.jnt_qposadr[model.eq_obj2id[e]])
            offset -= scale * model.qpos0[master]
        found.append((e, follower, master, scale, float(offset)))
    return found


def _moved(ik: FingerIK, own: Indices) -> tuple[set[int], list[int]]:
    """Degrees of freedom that move with the finger's own joints, and the equalities that say so."""
    model = ik._model
    dof_of = {int(model.jnt_qposadr[j]): int(model.jnt_dofadr[j]) for j in range(model.njnt)}
    moved = {int(address) for address in ik._address[own]}
    equalities: list[int] = []
    for _ in ik._couplings:
        for equality, follower, master, _scale, _offset in ik._couplings:
            if master in moved and equality not in equalities:
                moved.add(follower)
                equalities.append(equality)
    return {dof_of[address] for address in moved}, equalities
