"""GoalGait: how a turn is split, where it goes, and goals that it reaches or comes near."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from dexctl import GraspState, HandModel, InGraspManipulation, InvalidInput
from dexctl.gait import CoordinatedGait, GoalGait
from dexctl.gait.goal import shortened, split_turn
from dexctl.rotations import from_rotation_vector, inverse, multiply, rotation_vector
from dexctl.sim import BatchSimulator, Scene

Z = np.array([0.0, 0.0, 1.0])


def about(axis: Any, angle: float) -> np.ndarray:
    return from_rotation_vector(angle * np.asarray(axis, float))


def test_a_turn_is_a_tilt_and_a_turn_about_the_axis() -> None:
    tilt, angle = split_turn(multiply(about(Z, 2.5), about([1, 0, 0], 0.4)), Z)
    np.testing.assert_allclose(tilt, [0.4, 0.0, 0.0], atol=1e-12)
    assert angle == pytest.approx(2.5)
    turns = np.random.default_rng(0).normal(size=(200, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    axis = np.array([0.6, 0.0, 0.8])
    tilt, angle = split_turn(turns, axis)
    np.testing.assert_allclose(tilt @ axis, 0.0, atol=1e-9)
    again = multiply(from_rotation_vector(angle[:, None] * axis), from_rotation_vector(tilt))
    np.testing.assert_allclose(np.abs((again * turns).sum(axis=1)), 1.0)
    assert (np.abs(angle) <= np.pi).all()
    np.testing.assert_allclose(shortened(np.array([3.0, 4.0, 0.0]), 1.0), [0.6, 0.8, 0.0])
    np.testing.assert_array_equal(shortened(np.zeros(3), 1.0), 0.0)


def turned(
    scene: Scene, seconds: float, count: int = 4, **told: Any
) -> tuple[list[GraspState], BatchSimulator]:
    controller, sim = GoalGait(scene.hand), BatchSimulator(scene, count, seed=0, threads=1)
    states = []
    for _ in range(round(seconds / 0.05)):
        states.append(replace(sim.read(), **told))
        sim.write(states[-1].q_target + controller.act(states[-1]))
        sim.step()
    return states, sim


def orientation(state: GraspState) -> np.ndarray:
    assert state.object_quaternion is not None
    return state.object_quaternion


def left(goal: np.ndarray, state: GraspState) -> np.ndarray:
    found = rotation_vector(multiply(goal, inverse(orientation(state))))
    return np.linalg.norm(found, axis=-1)


def test_goals_either_way_round_are_reached(cylinder: Scene) -> None:
    start = BatchSimulator(cylinder, 4, seed=0, threads=1).read()
    angles = np.array([0.9, -0.9, 0.4, 0.0])
    goal = multiply(from_rotation_vector(angles[:, None] * Z), orientation(start))
    states, sim = turned(cylinder, 9.0, goal_quaternion=goal)
    assert left(goal, states[0]) == pytest.approx(np.abs(angles), abs=0.02)
    assert (left(goal, states[-1]) < 0.2).all()
    away = np.linalg.norm(states[-1].object_centre() - states[0].object_centre(), axis=-1)
    assert (away < 0.01).all()
    sim.close()


def test_turns_that_would_leave_a_goal_unreached_are_made(cylinder: Scene) -> None:
    """A fifth of a radian about the axis was too little to begin with, and too much to be there."""
    start = BatchSimulator(cylinder, 2, seed=0, threads=1).read()
    goal = multiply(
        from_rotation_vector(np.array([[0, 0, 0.25], [0, 0, -0.2]])), orientation(start)
    )
    states, sim = turned(cylinder, 5.0, count=2, goal_quaternion=goal)
    assert (left(goal, states[0]) > 0.17).all() and (left(goal, states[-1]) < 0.1).all()
    sim.close()


def test_tilts_are_reached_or_come_near(cylinder: Scene) -> None:
    start = BatchSimulator(cylinder, 4, seed=0, threads=1).read()
    tilts = np.array([[0.25, 0, 0], [0, -0.25, 0], [0, 0, 0], [0, 2.0, 0]])
    goal = multiply(from_rotation_vector(tilts), orientation(start))
    states, sim = turned(cylinder, 4.0, goal_quaternion=goal)
    assert (left(goal, states[-1])[:3] < 0.15).all()
    assert 1.3 < left(goal, states[-1])[3] < 1.9  # out of reach: no further than most_tilt
    sim.close()


def test_a_wanted_angular_velocity_is_followed(cylinder: Scene) -> None:
    spin = np.array([[0, 0, 0.3], [0, 0, -0.3], [0, 0, 0], [0.1, 0, 0]])
    states, sim = turned(cylinder, 3.0, goal_angular_velocity=spin)
    came = rotation_vector(multiply(orientation(states[-1]), inverse(orientation(states[0]))))
    assert 0.4 < came[0, 2] < 1.0
    assert -1.0 < came[1, 2] < -0.4
    assert np.abs(came[2]).max() < 0.05
    assert 0.1 < came[3, 0] < 0.4
    assert np.abs(came[3, 1:]).max() < 0.1
    sim.close()


def test_told_nothing_it_is_the_gait(cylinder: Scene) -> None:
    states, sim = turned(cylinder, 1.0, count=2)
    gait = CoordinatedGait(cylinder.hand)
    for state, after in pairwise(states):
        lower, upper = cylinder.hand.lower, cylinder.hand.upper
        expected = np.clip(state.q_target + gait.act(state), lower, upper)
        np.testing.assert_array_equal(after.q_target, expected)
    sim.close()


def test_a_batch_is_as_each_alone_and_continues_to_the_bit(cylinder: Scene) -> None:
    start = BatchSimulator(cylinder, 3, seed=0, threads=1).read()
    goal = multiply(
        from_rotation_vector(np.array([[0, 0, 0.9], [0, 0.2, -0.9], [0, 0, 3.1]])),
        orientation(start),
    )
    states, sim = turned(cylinder, 3.0, count=3, goal_quaternion=goal)
    sim.close()
    batch, again = GoalGait(cylinder.hand), GoalGait(cylinder.hand)
    alone = [GoalGait(cylinder.hand) for _ in range(3)]
    for i, state in enumerate(states):
        if i == 30:
            again.load_state_dict(batch.state_dict())
        action = batch.act(state)
        for k, one in enumerate(alone):
            np.testing.assert_allclose(one.act(state[k]), action[k], atol=1e-8)
        if i >= 30:
            np.testing.assert_array_equal(again.act(state), action)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"goal": (1.0, 1.0, 0.0, 0.0)}, "goal is .* expected a unit quaternion"),
        ({"goal": (1.0, 0.0)}, "expected a unit quaternion"),
        ({"align_angle": 0.5}, "align_angle is 0.5 and turn_angle 0.15"),
        ({"tilt_lead": 0.0}, "tilt_lead is 0.0"),
        ({"gait": 3}, "gait is 3; expected a CoordinatedGaitConfig"),
    ],
)
def test_bad_settings(dex5: HandModel, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidInput, match=message):
        GoalGait(dex5, **settings)


@pytest.mark.parametrize("make", [GoalGait, InGraspManipulation])
def test_a_reference_that_is_no_pose(dex5: HandModel, make: Any) -> None:
    place, upright = np.zeros((3, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (3, 1))
    for wrong in (None, "x", 10**400, np.zeros((2, 2)), np.zeros((4, 3)) + 1j):
        for arguments in ((wrong, upright), (place, wrong)):
            with pytest.raises(InvalidInput, match="^(position|quaternion) ") as error:
                make(dex5).refer_to(*arguments)
            assert "\n" not in str(error.value)


def test_a_goal_needs_the_objects_pose(cylinder: Scene) -> None:
    with BatchSimulator(cylinder, 1, seed=0, threads=1) as sim:
        state = replace(sim.read(), object_position=None, object_quaternion=None)
    gait = GoalGait(cylinder.hand, goal=(1.0, 0.0, 0.0, 0.0))
    with pytest.raises(InvalidInput, match="a goal and no pose of the object"):
        gait.act(state)
