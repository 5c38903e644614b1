"""Judged: a simulation whose task says what is wanted of the hands, and what their steps are worth.

It stands as the plant between controller and simulation, as an environment does between those.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dexctl.state import Bools, Floats, GraspState
from learning.envs.task import Judgement, Step
from learning.envs.tasks import TaskConfig

if TYPE_CHECKING:
    from dexctl.sim import Simulation, Trace

WANTED = ("goal_quaternion", "goal_angular_velocity")


@dataclass(frozen=True, eq=False, kw_only=True)
class Goals:
    """What came of the goal orientations of N episodes, up to the drop or the end.

    Attributes:
        reached, missed: how many goals, ``(N,)``; missed are those whose time was over.
        in_a_row: reached before the first that was not, ``(N,)``.
        first_time: until the first was reached, ``(N,)`` [s]; infinite where it was not.
    """

    reached: np.ndarray
    missed: np.ndarray
    in_a_row: np.ndarray
    first_time: Floats


class Judged:
    """The plant that is ``simulation``, with a task; it keeps what is wanted and what it is worth.

    Args:
        simulation: fresh, at the start of its episodes.
        task: what the hands are to do.
    """

    def __init__(self, simulation: Simulation, task: TaskConfig) -> None:
        self._simulation = simulation
        self.hand, self.control_period = simulation.hand, simulation.control_period
        self._task = task.build(simulation)
        self._task.begin(np.ones(simulation.num_envs, bool), simulation.state)
        self._found: list[Judgement] = []
        self._gravity = [_gravity(simulation)]
        self._wanted: list[dict[str, Floats]] = []

    def read(self) -> GraspState:
        """What the sensors tell, and what is wanted."""
        state = self._task.with_goal(self._simulation.read())
        if len(self._wanted) == len(self._found):  # the first time in this step
            told = {name: getattr(state, name) for name in WANTED}
            self._wanted.append({name: v.copy() for name, v in told.items() if v is not None})
        return state

    def write(self, q_target: Floats) -> Floats:
        """As `Simulation.write`."""
        return self._simulation.write(q_target)

    def step(self) -> None:
        """One control period, and what the task says of it."""
        self._simulation.step()
        self._gravity.append(_gravity(self._simulation))
        self._found.append(self._task.judge(Step.of(self._simulation)))

    @property
    def wanted(self) -> dict[str, Floats]:
        """What was wanted at rows 0 to T, ``(T+1, N, ...)``, by `GraspState`'s names."""
        return {name: np.array([row[name] for row in self._wanted]) for name in self._wanted[0]}

    @property
    def gravity(self) -> Floats:
        """As it was at rows 0 to T, hand frame, ``(T+1, N, 3)`` [m/s^2]."""
        return np.array(self._gravity)

    @property
    def rotation(self) -> Floats:
        """About the axes that were wanted, since the start, ``(T+1, N)`` [rad]."""
        found = np.array([one.info["rotation"] for one in self._found])
        return np.concatenate([np.zeros((1, found.shape[1])), found])

    def held(self, trace: Trace) -> Bools:
        """Rows in which the object of an episode has not been lost, ``(T+1, N)``.

        It is lost by the trace's own rule, or by one of the task's (`HoldingConfig.end_on_links`).
        """
        lost = np.cumsum([one.dropped for one in self._found], axis=0) > 0
        return trace.held & np.concatenate([np.ones((1, lost.shape[1]), bool), ~lost])

    def within(self) -> Bools:
        """Rows up to that at which an episode's last goal is reached, ``(T+1, N)``."""
        reached = np.cumsum([one.succeeded for one in self._found], axis=0) > 0
        first = np.ones((2, reached.shape[1]), bool)
        return np.concatenate([first, ~reached[:-1]])

    def _counts(self, trace: Trace) -> Bools:
        """The steps that count, ``(T, N)``: while the object is held and the task is not over.

        The step that drops the object counts still; one that breaks down does not.
        """
        over = np.array([one.succeeded | one.dropped for one in self._found])
        done = np.cumsum(over, axis=0) - over > 0
        return trace.held[:-1] & ~trace.diverged[1:] & ~done

    def returns(self, trace: Trace) -> Floats:
        """The return ``(N,)`` of the episodes in ``trace``, up to the drop."""
        worth = np.array([one.reward for one in self._found])
        return np.where(self._counts(trace), worth, 0.0).sum(axis=0)

    def goals(self, trace: Trace) -> Goals:
        """What came of the goals of the episodes in ``trace``; zeros where there were none."""
        counts = self._counts(trace)
        none = np.zeros(counts.shape, bool)
        reached, missed = (
            np.array([one.info.get(name, row) for one, row in zip(self._found, none, strict=True)])
            & counts
            for name in ("goal_reached", "goal_missed")
        )
        alone = np.cumsum(missed, axis=0) == 0
        first = np.where(reached.any(axis=0), reached.argmax(axis=0), -1)
        # the first goal is reached where it was the first to be, and none was missed before
        right = (first >= 0) & alone[first, np.arange(len(first))]
        return Goals(
            reached=reached.sum(axis=0),
            missed=missed.sum(axis=0),
            in_a_row=(reached & alone).sum(axis=0),
            first_time=np.where(right, trace.time[first + 1], np.inf),
        )


def _gravity(simulation: Simulation) -> Floats:
    gravity = simulation.state.gravity
    assert gravity is not None
    return gravity.copy()
