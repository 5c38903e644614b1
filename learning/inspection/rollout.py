"""Rollouts to inspect: the evaluation protocol, with controllers in shadow."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dexctl import controllers
from dexctl.state import Bools, Floats, GraspState
from learning.evaluation import Evaluation, Protocol, Subject, rollout
from learning.inspection.critic import Critic, Valued
from learning.inspection.shadow import ACTION, Shadowed, action_angle
from learning.policies import Policy

if TYPE_CHECKING:
    from dexctl.hand import HandModel
    from dexctl.sim import Scene, Trace

MOTION = 0.5
"""What counts as a motion, beside the single action [s]."""
SHADOWS = ("igm", "gait", "coordinated")
"""Controllers in shadow where nothing says which guided the training."""


@dataclass(frozen=True, eq=False)
class Rollouts:
    """N episodes of T control steps of who is inspected.

    Attributes:
        scene: hand and object.
        trace: what happened.
        evaluation: what it came to, as `dexctl evaluate` has it.
        action: what who acts did, ``(T, N, d)`` [rad].
        shadows: what each controller would have done, ``(T, N, d)`` [rad], by name.
        horizon: steps that a choice of who acts holds for in training.
        valued: what the run's critic says of the policy and of the shadows, in this order,
            ``(T, N, K)``; None without a critic.
    """

    scene: Scene
    trace: Trace
    evaluation: Evaluation
    action: Floats
    shadows: Mapping[str, Floats]
    horizon: int
    valued: Valued | None = None

    @property
    def hand(self) -> HandModel:
        """The hand."""
        return self.scene.hand

    @property
    def period(self) -> float:
        """Of control [s]."""
        return float(self.trace.time[1] - self.trace.time[0])

    @property
    def acting(self) -> Bools:
        """Steps that count, ``(T, N)``: taken while the object was held."""
        return self.trace.held[:-1]

    @property
    def typical(self) -> int:
        """The episode whose rotation and time held, in ranks, are nearest to the medians."""
        away = np.zeros(self.trace.held.shape[1])
        for values in (self.trace.final_rotation, self.trace.time_held):
            below = (values[:, None] > values).sum(axis=1)
            above = (values[:, None] < values).sum(axis=1)
            away += np.abs(below - above)  # 0 for the median, equal values counted alike
        return int(away.argmin())

    def angle(self, name: str, which: str = "all") -> Floats:
        """Angle to a shadow's action, ``(T, N)`` [rad]; NaN where undefined or not held.

        Args:
            name: of the shadow.
            which: "all" joints, those of fingers that are "on" the object, or "off" it; "motion":
                all joints, of what was done in the last `MOTION` seconds and would have been, so
                that jitter cancels out.
        """
        if which == "motion":
            steps = max(1, round(MOTION / self.period))
            done, asked = (_sum_of_last(x, steps) for x in (self.action, self.shadows[name]))
            return np.where(self.acting, action_angle(done, asked), np.nan)
        joints = None
        if which != "all":
            touching = self.trace.in_contact[:-1]
            chosen = touching if which == "on" else ~touching
            joints = (chosen[..., None] & self.hand.moves).any(axis=-2)
        found = action_angle(self.action, self.shadows[name], joints)
        return np.where(self.acting, found, np.nan)


def roll_out(
    subject: Subject,
    protocol: Protocol,
    shadows: Sequence[str] = (),
    *,
    critic: Critic | None = None,
    progress: Callable[[float], None] | None = None,
) -> Rollouts:
    """Let the subject act in a protocol, and others say what they would do.

    Args:
        subject: who acts.
        protocol: how, with one object.
        shadows: the controllers in shadow, as `dexctl.controllers.resolve` takes them; none: its
            guides, or `SHADOWS`.
        critic: of the subject's run.
        progress: called after each control step with the simulated time so far [s].

    Raises:
        UnknownName, InvalidInput, SimulationError: as `learning.evaluation.rollout`.
    """
    names = tuple(dict.fromkeys(shadows or shadows_of(subject)))
    acting = subject.acting(protocol)
    period, axis = float(acting.control_period), protocol.task.direction
    made = {
        name: controllers.resolve(name, acting.hand, control_period=period, axis=axis)
        for name in names
    }
    horizon = None if subject.trained is None else subject.trained.guidance.horizon
    controller = Shadowed(acting, made, horizon)
    found = rollout(controller, protocol, progress=progress)
    trace, d = found.trace, acting.hand.nq
    asked = {name: trace.diagnostics[f"shadow:{name}"] for name in names}
    valued = None
    if critic is not None and isinstance(acting, Policy) and acting.symmetry is None:
        changes = [acting.action.from_change(change) for change in asked.values()]
        actions = [one.reshape(-1, d) for one in (trace.diagnostics["action"], *changes)]
        judged = critic.judge(states_of(trace, found.wanted), actions)
        valued = Valued(*(part.reshape(*trace.held[:-1].shape, -1) for part in judged))
    return Rollouts(
        scene=found.scene,
        trace=trace,
        evaluation=found.evaluation,
        action=trace.diagnostics[ACTION],
        shadows=asked,
        horizon=controller.horizon,
        valued=valued,
    )


def shadows_of(subject: Subject) -> tuple[str, ...]:
    """The controllers to compare with where nobody says which."""
    return subject.guides or tuple(name for name in SHADOWS if name != subject.name)


def _sum_of_last(actions: Floats, steps: int) -> Floats:
    """Sum of each row ``(T, ...)`` and those before it, ``steps`` in all; NaN before the first."""
    total = np.cumsum(actions, axis=0)
    out = np.full(actions.shape, np.nan)
    out[steps - 1 :] = total[steps - 1 :]
    out[steps:] -= total[:-steps]
    return out


def states_of(trace: Trace, wanted: Mapping[str, Floats]) -> GraspState:
    """The states in which the controller was asked, with what was wanted then, ``(T * N,)``."""

    def flat(values: np.ndarray, trailing: int = 1) -> np.ndarray:
        return values[:-1].reshape(-1, *values.shape[values.ndim - trailing :])

    return GraspState(
        q=flat(trace.q),
        q_target=flat(trace.q_target),
        in_contact=flat(trace.in_contact),
        contact_position=flat(trace.contact_position, 2),
        contact_normal=flat(trace.contact_normal, 2),
        contact_force=flat(trace.contact_force),
        object_position=flat(trace.object_position),
        object_quaternion=flat(trace.object_quaternion),
        **{name: flat(values) for name, values in wanted.items()},
    )
