"""GoalSequence: which turns are made, one after the other, until the goal is reached."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dexctl import GraspState, InvalidInput, controllers
from dexctl.gait import GoalSequence
from dexctl.gait.sequence import Leg
from dexctl.rotations import angle_between, from_rotation_vector, inverse, multiply
from dexctl.sim import BatchSimulator, Scene
from learning.envs.goals import CUBE

X, Z = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])


def about(axis: np.ndarray, angle: Any) -> np.ndarray:
    return from_rotation_vector(np.asarray(angle, float)[..., None] * axis)


@pytest.fixture(scope="module")
def start(cylinder: Scene) -> GraspState:
    with BatchSimulator(cylinder, 24, seed=0, threads=1) as sim:
        return sim.read()


@pytest.fixture
def sequence(cylinder: Scene, still: Callable[..., Any]) -> GoalSequence:
    return GoalSequence(cylinder.hand, about=still(cylinder.hand), across=still(cylinder.hand))


def test_what_is_left_is_a_tilt_and_two_turns(sequence: GoalSequence) -> None:
    goal = about(Z, [0.3, 0.0, 0.0])
    now = multiply(inverse(about(X, [1.0, -2.0, 3.0])), multiply(about(Z, [0.1, 0.0, 0.0]), goal))
    left = sequence.left(now, goal)
    np.testing.assert_allclose(left.across, [1.0, -2.0, 3.0])
    np.testing.assert_allclose(left.tilt, [1.0, 2.0, 3.0])
    only = sequence.left(about(Z, [0.4]), about(Z, [-0.5]))
    np.testing.assert_allclose(only.about, [-0.9])
    np.testing.assert_allclose(only.tilt, [0.0], atol=1e-12)


def test_all_orientations_of_a_cube_are_reached_by_turns_one_way(
    sequence: GoalSequence, start: GraspState
) -> None:
    """An object that turns as it is told: no leg is missing, none goes on for ever."""
    upright = start.object_quaternion
    assert upright is not None
    goal = multiply(CUBE, upright)
    assert len(goal) == 24
    now, legs, turned = upright.copy(), [], np.zeros(24)
    for _ in range(600):
        sequence.act(replace(start, object_quaternion=now, goal_quaternion=goal))
        leg = sequence.diagnostics["leg"]
        legs.append(leg)
        axis = np.where((leg == Leg.ACROSS)[:, None], X, Z)
        now = np.where((leg == Leg.GRASP)[:, None], now, multiply(about(axis, [0.03] * 24), now))
        turned += np.where(leg == Leg.GRASP, 0.0, 0.03)
    assert (legs[-1] == Leg.GRASP).all()
    left = angle_between(now, goal)
    assert (left < 0.3).all()  # each turn ends a tenth or two before, and the grasp does the rest
    assert turned.max() < 3.3 * np.pi  # each of three turns is three quarters at most
    np.testing.assert_array_equal(np.array(legs)[:, 0], Leg.GRASP)  # it is there at the start
    assert (np.diff(np.array(legs), axis=0) != 0).sum(axis=0).max() <= 4


def test_each_controller_is_told_its_axis_and_no_goal(
    sequence: GoalSequence, start: GraspState
) -> None:
    assert start.object_quaternion is not None
    turns = multiply(about(X, [1.5] * 24), start.object_quaternion)
    sequence.act(replace(start, goal_quaternion=turns))
    turners: Any = (sequence.about, sequence.across)
    for one, axis in zip(turners, (Z, X), strict=True):
        np.testing.assert_array_equal(one.asked.goal_angular_velocity, np.tile(0.5 * axis, (24, 1)))
        assert one.asked.goal_quaternion is None
    assert (sequence.diagnostics["leg"] == Leg.ACROSS).all()
    np.testing.assert_allclose(sequence.diagnostics["across"], 1.5, atol=0.05)
    turners[1].asked = None
    sequence.act(start)  # no goal: it is turned about the axis
    assert turners[1].asked is None
    one = replace(start[0], goal_quaternion=turns[0])
    sequence.reset()
    assert sequence.act(one).shape == (15,)
    assert sequence.diagnostics["leg"] == Leg.ACROSS


def test_a_tilt_that_is_lost_in_the_grasp_is_turned_back(
    sequence: GoalSequence, start: GraspState
) -> None:
    now = start.object_quaternion
    assert now is not None
    sequence.act(replace(start, goal_quaternion=multiply(about(X, [0.3] * 24), now)))
    assert (sequence.diagnostics["leg"] == Leg.GRASP).all()
    fallen = multiply(about(X, [-0.5] * 24), now)
    goal = multiply(about(X, [0.3] * 24), now)
    sequence.act(replace(start, object_quaternion=fallen, goal_quaternion=goal))
    assert (sequence.diagnostics["leg"] == Leg.ACROSS).all()


def test_it_is_known_by_name(cylinder: Scene) -> None:
    made = controllers.make("sequence:goal,coordinated", cylinder.hand, control_period=0.02)
    assert isinstance(made, GoalSequence)
    assert type(made.across).__name__ == "CoordinatedGait" and made.control_period == 0.02
    with pytest.raises(InvalidInput, match="expected sequence:ABOUT,ACROSS"):
        controllers.make("sequence", cylinder.hand)
    for wrong in ("goal", ",goal", "goal,", "goal,goal,goal"):
        with pytest.raises(InvalidInput, match=f"got '{wrong}'; expected two controllers"):
            controllers.make(f"sequence:{wrong}", cylinder.hand)


def test_what_it_refuses(
    cylinder: Scene, sequence: GoalSequence, start: GraspState, still: Callable[..., Any]
) -> None:
    hand = cylinder.hand
    with pytest.raises(InvalidInput, match=r"across_axis is \(0, 0, 2\); expected one at right"):
        GoalSequence(hand, across_axis=(0, 0, 2))
    with pytest.raises(InvalidInput, match="most_tilt is 0.8; expected less than lost_tilt, 0.7"):
        GoalSequence(hand, most_tilt=0.8)
    with pytest.raises(InvalidInput, match="about is 'goal'; expected a Controller"):
        GoalSequence(hand, about="goal")  # type: ignore[arg-type]
    with pytest.raises(InvalidInput, match="across has a control period of 0.02; expected 0.05"):
        GoalSequence(hand, across=still(hand, control_period=0.02))
    blind = replace(start, goal_quaternion=start.object_quaternion, object_quaternion=None)
    with pytest.raises(InvalidInput, match="a goal and no pose"):
        sequence.act(blind)
