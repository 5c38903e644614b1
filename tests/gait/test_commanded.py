"""CommandedTurning: who is asked for which axis, in which image of the hand; what it refuses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dexctl import GraspState, InvalidInput, UnknownName, controllers
from dexctl.gait import CommandedTurning, CoordinatedGait, GoalGait
from dexctl.igm import InGraspManipulation
from dexctl.rotations import inverse, multiply, rotation_vector
from dexctl.sim import BatchSimulator, Scene

X, Y, Z = np.eye(3)


@pytest.fixture(scope="module")
def start() -> GraspState:
    """Of a cube: in a grasp that is symmetric itself, who presses hardest is a matter of order."""
    with BatchSimulator(Scene.build("dex5", "cube"), 4, seed=0, threads=1) as sim:
        sim.step()
        return sim.read()


def told(state: GraspState, *spins: np.ndarray) -> GraspState:
    return replace(state, goal_angular_velocity=np.array(spins))


def test_axes_are_those_of_the_turners_and_their_images(cylinder: Scene) -> None:
    hand = cylinder.hand
    made = CommandedTurning(hand, [InGraspManipulation(hand), InGraspManipulation(hand, axis=X)])
    fifths = 0.4 * np.pi * np.arange(5)
    around = np.stack([np.cos(fifths), np.sin(fifths), 0.0 * fifths], axis=1)
    for axis in (Z, -Z, *around, *-around):
        assert np.abs(made.axes - axis).max(axis=1).min() < 1e-6
    assert made.axes.shape == (12, 3)


def test_each_hand_is_asked_in_the_image_that_turns_as_told(
    cylinder: Scene, start: GraspState
) -> None:
    """In-grasp manipulation for x in an image is the one for the axis that is the image of x."""
    hand = cylinder.hand
    made = CommandedTurning(hand, [InGraspManipulation(hand), InGraspManipulation(hand, axis=X)])
    aside = np.array([np.cos(0.4 * np.pi), np.sin(0.4 * np.pi), 0.0])
    action = made.act(told(start, 0.3 * Z, -0.5 * Z, X, 2.0 * aside))
    np.testing.assert_array_equal(made.diagnostics["turner"], [0, 0, 1, 1])
    np.testing.assert_allclose(made.diagnostics["off"], 0.0, atol=1e-6)
    for row, axis in enumerate((Z, -Z, X, aside)):
        alone = InGraspManipulation(hand, axis=axis)
        np.testing.assert_allclose(action[row], alone.act(start[row]), atol=1e-7)


def test_the_nearest_axis_is_taken_and_zero_holds_still(cylinder: Scene, start: GraspState) -> None:
    hand = cylinder.hand
    made = CommandedTurning(hand, [InGraspManipulation(hand), InGraspManipulation(hand, axis=X)])
    action = made.act(told(start, Z + 0.5 * X, 0.0 * Z, Y, -X))
    np.testing.assert_array_equal(made.diagnostics["turner"][[0, 2, 3]], [0, 1, 1])
    np.testing.assert_allclose(
        made.diagnostics["off"], [np.arctan(0.5), 0.0, np.pi / 10, 0.0], atol=1e-6
    )
    np.testing.assert_array_equal(action[1], 0.0)
    assert (np.abs(action[[0, 2, 3]]).max(axis=1) > 1e-4).all()


def test_without_a_command_it_turns_about_its_axis(cylinder: Scene, start: GraspState) -> None:
    hand = cylinder.hand
    for axis, expected in ((None, X), (-Z, -Z)):
        made = CommandedTurning(
            hand, [InGraspManipulation(hand, axis=X), InGraspManipulation(hand)], axis=axis
        )
        alone = InGraspManipulation(hand, axis=expected)
        np.testing.assert_allclose(made.act(start), alone.act(start), atol=1e-7)


def test_turners_are_told_where_a_state_tells_none(
    cylinder: Scene, start: GraspState, still: Callable[..., Any]
) -> None:
    """Some were trained to be; in the image, it is the axis that they know."""
    one = still(cylinder.hand)
    one.axis = X
    CommandedTurning(cylinder.hand, [one], axis=-X).act(start)
    np.testing.assert_allclose(one.asked.goal_angular_velocity, [0.5 * X] * 4, atol=1e-8)


def test_a_turner_begins_anew_when_another_axis_is_told(
    cylinder: Scene, start: GraspState, still: Callable[..., Any]
) -> None:
    one = still(cylinder.hand)
    one.axis = Z
    forgot: list[Any] = []
    one.reset = lambda seed=None, mask=None: forgot.append(mask)
    made = CommandedTurning(cylinder.hand, [one])
    made.act(told(start, Z, Z, Z, Z))
    made.act(told(start, Z, 0.2 * Z, 0.0 * Z, Z + X))
    assert not forgot
    made.act(told(start, Z, -Z, Z, -Z))
    np.testing.assert_array_equal(forgot, [[False, True, False, True]])


def test_it_turns_as_it_is_told(cylinder: Scene) -> None:
    """Gaits about z, one way and the other, and again the other way round."""
    made = CommandedTurning(cylinder.hand, [CoordinatedGait(cylinder.hand)])
    with BatchSimulator(cylinder, 2, seed=0, threads=1) as sim:
        for spins in ((Z, -Z), (-Z, Z)):
            began = sim.read().object_quaternion
            for _ in range(60):
                state = told(sim.read(), *spins)
                sim.write(state.q_target + made.act(state))
                sim.step()
            came = sim.read().object_quaternion
            assert began is not None and came is not None
            turned = rotation_vector(multiply(came, inverse(began)))[:, 2]
            assert (turned * np.array(spins)[:, 2] > 0.15).all()


def test_by_name(cylinder: Scene) -> None:
    made = controllers.make("commanded:igm,coordinated", cylinder.hand, axis=(0.0, 0.0, -1.0))
    assert isinstance(made, CommandedTurning)
    assert [type(one) for one in made.turners] == [InGraspManipulation, CoordinatedGait]
    with pytest.raises(InvalidInput, match="expected commanded:NAME,..."):
        controllers.make("commanded", cylinder.hand)
    with pytest.raises(UnknownName, match="unknown controller 'nobody'"):
        controllers.make("commanded:igm,nobody", cylinder.hand)
    with pytest.raises(InvalidInput, match="got ',igm'; expected controllers"):
        controllers.make("commanded:,igm", cylinder.hand)


def test_what_it_refuses(cylinder: Scene) -> None:
    hand = cylinder.hand
    with pytest.raises(InvalidInput, match="got no turners"):
        CommandedTurning(hand, [])
    with pytest.raises(InvalidInput, match="GoalGait does not turn about one axis"):
        CommandedTurning(hand, [GoalGait(hand)])
    with pytest.raises(InvalidInput, match="turner 1 has a control_period of 0.02 s; .*0.05"):
        CommandedTurning(
            hand, [InGraspManipulation(hand), InGraspManipulation(hand, control_period=0.02)]
        )
