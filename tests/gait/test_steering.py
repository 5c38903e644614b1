"""GoalSteering: what it asks for, and goals that are reached so."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dexctl import GraspState, InvalidInput, UnknownName, controllers
from dexctl.gait import GoalGait, GoalSteering
from dexctl.rotations import from_rotation_vector, inverse, multiply, rotation_vector
from dexctl.sim import BatchSimulator, Scene


def asked(turner: Any) -> np.ndarray:
    """The angular velocity that a controller was asked for."""
    assert turner.asked.goal_quaternion is None
    return turner.asked.goal_angular_velocity


@pytest.fixture(scope="module")
def start(cylinder: Scene) -> GraspState:
    with BatchSimulator(cylinder, 3, seed=0, threads=1) as sim:
        return sim.read()


def ahead(state: GraspState, turns: list[list[float]]) -> GraspState:
    """With goals that are so far from where the objects are."""
    assert state.object_quaternion is not None
    goal = multiply(from_rotation_vector(np.array(turns)), state.object_quaternion)
    return replace(state, goal_quaternion=goal)


def test_it_asks_for_the_turn_that_is_left(
    cylinder: Scene, start: GraspState, still: Callable[..., Any]
) -> None:
    turner = still(cylinder.hand)
    steering = GoalSteering(cylinder.hand, turner=turner, gain=2.0, speed=0.5)
    steering.act(ahead(start, [[0.1, 0, -0.05], [0, 3.0, 0], [0, 0, 0]]))
    np.testing.assert_allclose(asked(turner), [[0.2, 0, -0.1], [0, 0.5, 0], [0, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(steering.diagnostics["left"], [0.1118034, 3.0, 0.0], atol=1e-7)
    one = ahead(start, [[0, 3.0, 0]] * 3)[1]
    steering.reset()
    steering.act(one)
    np.testing.assert_allclose(asked(turner), [[0, 0.5, 0]], atol=1e-12)
    told = GoalSteering(cylinder.hand, turner=turner, goal=(0.0, 1.0, 0.0, 0.0))
    told.act(start)
    assert np.linalg.norm(asked(turner), axis=-1) == pytest.approx(0.5)
    steering.act(start)  # no goal, nothing asked
    assert turner.asked.goal_angular_velocity is None


def test_what_little_is_left_is_made_good_in_the_grasp(
    cylinder: Scene, start: GraspState, still: Callable[..., Any]
) -> None:
    """By a gait to the goal, from where it is taken over until half as much again is left."""
    steering = GoalSteering(cylinder.hand, turner=still(cylinder.hand), grasp_angle=0.4)
    moved = []
    for angles in ([0.5, 0.5, 0.3], [0.3, 0.5, 0.5], [0.5, 0.5, 0.7]):
        action = steering.act(ahead(start, [[angle, 0, 0] for angle in angles]))
        moved.append(action.any(axis=1).tolist())
    assert moved == [[False, False, True], [True, False, True], [True, False, False]]
    alone = GoalSteering(cylinder.hand, turner=still(cylinder.hand), grasp_angle=0.0)
    assert not alone.act(ahead(start, [[0.1, 0, 0]] * 3)).any()


def test_goals_are_reached(cylinder: Scene) -> None:
    steering = controllers.make("steered:goal", cylinder.hand)
    assert isinstance(steering, GoalSteering) and isinstance(steering.turner, GoalGait)
    with BatchSimulator(cylinder, 2, seed=0, threads=1) as sim:
        goal = ahead(sim.read(), [[0, 0, 0.8], [0, 0, -0.5]]).goal_quaternion
        for _ in range(160):
            state = replace(sim.read(), goal_quaternion=goal)
            sim.write(state.q_target + steering.act(state))
            sim.step()
        came = sim.read().object_quaternion
    assert came is not None and goal is not None
    left = np.linalg.norm(rotation_vector(multiply(goal, inverse(came))), axis=-1)
    assert (left < 0.2).all()


def test_what_it_refuses(cylinder: Scene, start: GraspState) -> None:
    with pytest.raises(InvalidInput, match="expected steered:NAME"):
        controllers.make("steered", cylinder.hand)
    with pytest.raises(UnknownName, match="unknown controller 'nobody'"):
        controllers.make("steered:nobody", cylinder.hand)
    with pytest.raises(InvalidInput, match="gain is 0.0"):
        GoalSteering(cylinder.hand, gain=0.0)
    with pytest.raises(InvalidInput, match="goal is .*; expected a unit quaternion"):
        GoalSteering(cylinder.hand, goal=(1.0, 1.0, 0.0, 0.0))
    with pytest.raises(InvalidInput, match="turner is 'goal'; expected a Controller"):
        GoalSteering(cylinder.hand, turner="goal")  # type: ignore[arg-type]
    turner = GoalSteering(cylinder.hand)
    with pytest.raises(InvalidInput, match="turner has a control_period of 0.05 s; expected 0.02"):
        GoalSteering(cylinder.hand, turner=turner, control_period=0.02)
    names = cylinder.hand.joint_names[::-1]
    other = replace(cylinder.hand.config, joints=names).build()
    with pytest.raises(InvalidInput, match="for joints in the order 'f1_.*; expected 'f5_"):
        GoalSteering(other, turner=turner)  # its changes would go to other joints
    blind = replace(ahead(start, [[0, 0, 1.0]] * 3), object_quaternion=None)
    with pytest.raises(InvalidInput, match="a goal and no pose"):
        GoalSteering(cylinder.hand).act(blind)
