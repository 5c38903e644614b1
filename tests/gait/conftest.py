"""The controllers under test, and closed loops on the simulated hand."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
import pytest

from dexctl import ContactSwitch, Controller, FingerGaiting, GraspState, InGraspManipulation
from dexctl.gait import (
    CommandedTurning,
    CoordinatedGait,
    GoalGait,
    GoalPursuit,
    GoalSequence,
    GoalSteering,
    RegulatedTurning,
    TrackedByTouch,
)
from dexctl.igm import InGraspManipulationConfig
from dexctl.planning import Kinematic, PlannedGait, Tree, grow
from dexctl.sim import BatchSimulator, Scene, Shape
from dexctl.switch import GuardedSwitchConfig


@cache
def planned_tree() -> Tree:
    """A turn of a radian, for a controller that follows it."""
    scene = Scene.build("dex5", "cylinder", "down")
    return grow(scene, Kinematic(batch=64), until_rotation=1.0, seed=0)


# quick to act, so that a few seconds show all that they do
CONTROLLERS: dict[str, Callable[..., Controller]] = {
    "in-grasp": InGraspManipulation,
    "in-grasp, thesis": lambda hand, **settings: InGraspManipulation(
        hand, InGraspManipulationConfig.thesis(), **settings
    ),
    "switch, profile": lambda hand, **settings: ContactSwitch(hand, duration=0.6, **settings),
    "switch, guarded": lambda hand, **settings: ContactSwitch(
        hand, kind="guarded", pause=0.1, **settings
    ),
    "gait, random": lambda hand, **settings: FingerGaiting(hand, duration=0.6, **settings),
    "gait, coordinated": lambda hand, **settings: CoordinatedGait(
        hand, least_travel=0.0, **settings
    ),
    "gait, goal": GoalGait,
    "gait, steered": GoalSteering,
    "gait, pursuit": lambda hand, **settings: GoalPursuit(hand, reacher=GoalGait(hand, **settings)),
    "gait, sequence": GoalSequence,
    "gait, commanded": lambda hand, **settings: CommandedTurning(
        hand, [CoordinatedGait(hand, least_travel=0.0, **settings)], axis=(0.0, 0.0, -1.0)
    ),
    "gait, regulated": lambda hand, **settings: RegulatedTurning(
        hand, turner=CoordinatedGait(hand, least_travel=0.0, **settings)
    ),
    "gait, tracked by touch": lambda hand, **settings: TrackedByTouch(
        hand,
        CoordinatedGait(hand, least_travel=0.0, **settings),
        Shape.of_object("cylinder", 0.1),
        position=(0.0, 0.0, 0.13),
    ),
    "gait, planned": lambda hand, **settings: CoordinatedGait(
        hand, least_travel=0.0, switch=GuardedSwitchConfig(path="planned"), **settings
    ),
    "tree followed": lambda hand, **settings: PlannedGait(hand, planned_tree(), **settings),
}


class Still(Controller):
    """Holds still, and keeps what it was asked; told to turn about an axis."""

    asked: GraspState | None = None
    axis = np.array([0.0, 0.0, 1.0])

    def act(self, state: GraspState) -> np.ndarray:
        self.asked = state
        return np.zeros_like(state.q)

    def reset(self, seed: Any = None, mask: Any = None) -> None:
        pass

    def state_dict(self) -> dict[str, Any]:
        return self._signed()

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        self._parts(saved)


@dataclass
class Run:
    """A closed loop: what the controller saw, and what it did."""

    states: list[GraspState] = field(default_factory=list)
    actions: list[np.ndarray] = field(default_factory=list)
    diagnostics: list[dict[str, Any]] = field(default_factory=list)

    def of(self, name: str) -> np.ndarray:
        """A diagnostic over time, ``(T, ...)``."""
        return np.array([row[name] for row in self.diagnostics])


def close_loop(
    controller: Controller,
    sim: BatchSimulator,
    steps: int,
    see: Callable[[GraspState], GraspState] = lambda state: state,
) -> Run:
    """Run ``controller`` on ``sim`` from where both are; ``see`` is what it sees of a state."""
    run = Run()
    for _ in range(steps):
        state = see(sim.read())
        action = controller.act(state)
        run.states.append(state)
        run.actions.append(action)
        run.diagnostics.append({n: np.array(v) for n, v in controller.diagnostics.items()})
        sim.write(state.q_target + action)
        sim.step()
    return run


@pytest.fixture(scope="session")
def loop() -> Callable[..., Run]:
    return close_loop


@pytest.fixture(scope="session")
def still() -> Callable[..., Any]:
    """Makes a controller that holds still, and keeps in ``asked`` what it was asked."""
    return Still


@pytest.fixture(scope="session")
def cylinder() -> Scene:
    return Scene.build("dex5", "cylinder", "down")


@pytest.fixture(scope="session")
def cube() -> Scene:
    return Scene.build("dex5", "cube", "down")


@pytest.fixture(scope="session")
def makers() -> dict[str, Callable[..., Controller]]:
    """What makes each of the controllers, by name."""
    return CONTROLLERS


@pytest.fixture(params=CONTROLLERS, scope="session")
def make(request: pytest.FixtureRequest) -> Callable[..., Controller]:
    """Makes a controller: each of `CONTROLLERS` in turn."""
    return CONTROLLERS[request.param]
