"""Task: what begins an episode, what it rewards, when it ends and what success is."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from dexctl.state import Bools, Floats, GraspState

if TYPE_CHECKING:
    from dexctl.sim import Simulation


class Step(NamedTuple):
    """What one control step came to, in N environments.

    Attributes:
        state: how things are now, without noise.
        angular_velocity: of the object, mean over the step, ``(N, 3)`` [rad/s].
        fingertips_only: whether nothing of the hand but fingertips touches the object, ``(N,)``.
        start_position: of the object's centre in the episode, ``(N, 3)`` [m].
        diverged: whose simulation has broken down, ``(N,)``.
    """

    state: GraspState
    angular_velocity: Floats
    fingertips_only: Bools
    start_position: Floats
    diverged: Bools

    @classmethod
    def of(cls, simulation: Simulation) -> Step:
        """The control step that ``simulation`` has just made."""
        sim = simulation.sim
        return cls(
            state=simulation.state,
            angular_velocity=sim.object_angular_velocity,
            fingertips_only=sim.other_contact == 0.0,
            start_position=sim.start_position,
            diverged=simulation.diverged,
        )


class Judgement(NamedTuple):
    """What a task says of a step.

    Attributes:
        reward: ``(N,)``.
        dropped: whose episode ends because the object is lost, ``(N,)``.
        succeeded: whose episode ends because its goal is reached, ``(N,)``.
        info: further arrays ``(N,)``, of the step or of the episode up to and with it.
    """

    reward: Floats
    dropped: Bools
    succeeded: Bools
    info: dict[str, np.ndarray]


class Task(ABC):
    """What N environments are for."""

    @abstractmethod
    def begin(self, chosen: Bools, state: GraspState) -> None:
        """Episodes begin with ``state`` in the environments chosen, ``(N,)``."""

    def with_goal(self, state: GraspState) -> GraspState:
        """``state`` with what the object is wanted to do, for those who act and observe."""
        return state

    @abstractmethod
    def judge(self, step: Step) -> Judgement:
        """What the step was worth, and whose episode it ends."""

    @abstractmethod
    def save(self) -> dict[str, Any]:
        """All that decides the future, as arrays, to be given to `restore`."""

    @abstractmethod
    def restore(self, saved: dict[str, Any]) -> None:
        """Go on from what `save` returned."""
