"""Plant: what a controller runs on, simulated or real."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from dexctl.hand import HandModel
from dexctl.state import Floats, GraspState


@runtime_checkable
class Plant(Protocol):
    """A hand, or a batch of hands, that takes set-points and tells what it feels.

    One control step is ``state = plant.read()``, ``plant.write(state.q_target + change)``,
    ``plant.step()``.

    Attributes:
        hand: the model of the hand.
        control_period: time that one :meth:`step` takes [s].
    """

    hand: HandModel
    control_period: float

    def read(self) -> GraspState:
        """The state now; its ``q_target`` is what the last write really sent."""
        ...

    def write(self, q_target: Floats) -> Floats:
        """Take new set-points ``(..., d)`` [rad]; returns what was really sent, after limits."""
        ...

    def step(self) -> None:
        """Let one control period pass (simulate it, or wait for the next tick)."""
        ...
