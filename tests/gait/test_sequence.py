"""GoalSequence: which turns are made, one after the other, until the goal is reached."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dexctl import GraspState, HandModel, InvalidInput, controllers
from dexctl.gait import GoalGait, GoalSequence
from dexctl.gait.sequence import Leg
from dexctl.rotations import angle_between, from_rotation_vector, multiply
from dexctl.sim import BatchSimulator, Scene
from learning.envs.goals import CUBE

X, Z = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])


def about(axis: np.ndarray, angle: Any) -> np.ndarray:
    return from_rotation_vector(np.asarray(angle, float)[..., None] * axis)


@pytest.fixture(scope="module")
def start(cylinder: Scene) -> GraspState:
    with BatchSimulator(cylinder, 24, seed=0, threads=1) as sim:
        return sim.read()


def make(hand: HandModel, still: Callable[..., Any], **settings: Any) -> GoalSequence:
    """A sequence of two that hold still and say that they turn about z and x."""
    about, across = still(hand), still(hand)
    across.axis = X
    return GoalSequence(hand, about=about, across=across, **settings)


@pytest.fixture
def sequence(cylinder: Scene, still: Callable[..., Any]) -> GoalSequence:
    return make(cylinder.hand, still)


@pytest.mark.parametrize("images", [True, False])
def test_all_orientations_of_a_cube_are_reached(
    cylinder: Scene, start: GraspState, still: Callable[..., Any], images: bool
) -> None:
    """An object that turns as it is told: no leg is missing, none goes on for ever."""
    sequence = make(cylinder.hand, still, images=images)
    upright = start.object_quaternion
    assert upright is not None
    goal = multiply(CUBE, upright)
    assert len(goal) == 24
    now, legs, turned = upright.copy(), [], np.zeros(24)
    for _ in range(600):
        sequence.act(replace(start, object_quaternion=now, goal_quaternion=goal))
        leg = sequence.diagnostics["leg"]
        legs.append(leg)
        in_grasp = np.isin(leg, (Leg.GRASP, Leg.LEVEL))
        spin = sequence.turner.axes[sequence.turner.diagnostics["image"]]
        step = from_rotation_vector(np.where(in_grasp[:, None], 0.0, 0.03 * spin))
        now = multiply(step, now)
        turned += np.where(in_grasp, 0.0, 0.03)
    assert (legs[-1] == Leg.GRASP).all()
    assert (angle_between(now, goal) < sequence.config.most_tilt + 0.2).all()
    # one way each of three turns is three quarters at most, and most are shorter by the images
    assert turned.max() < 3.3 * np.pi
    assert turned.mean() < (3.5 if images else 5.0)
    np.testing.assert_array_equal(np.array(legs)[:, 0], Leg.GRASP)  # it is there at the start
    assert (np.diff(np.array(legs), axis=0) != 0).sum(axis=0).max() <= 5


def test_what_follows_on_each_other_is_turned_as_it_is_or_in_a_mirror(
    cylinder: Scene, start: GraspState, still: Callable[..., Any]
) -> None:
    """Across follows about as in training; a mirror image of the one on the other would not."""
    sequence = make(cylinder.hand, still, images=True)
    rng = np.random.default_rng(3)
    goal = rng.normal(size=(24, 4))
    goal /= np.linalg.norm(goal, axis=1, keepdims=True)
    now, before = start.object_quaternion, np.zeros(24)
    assert now is not None
    seen = set()
    for _ in range(400):
        sequence.act(replace(start, object_quaternion=now, goal_quaternion=goal))
        turning = ~np.isin(sequence.diagnostics["leg"], (Leg.GRASP, Leg.LEVEL))
        image = sequence.turner.diagnostics["image"]
        way = np.where(turning, sequence.turner.ways[image], 0)
        assert (way * before >= 0).all()
        seen |= set(way.tolist())
        before = way
        spin = np.where(turning[:, None], sequence.turner.axes[image], 0.0)
        now = multiply(from_rotation_vector(0.03 * spin), now)
    assert seen == {-1, 0, 1}


def test_each_controller_is_told_its_axis_and_no_goal(
    sequence: GoalSequence, start: GraspState
) -> None:
    assert start.object_quaternion is not None
    turns = multiply(about(X, [1.5] * 24), start.object_quaternion)
    sequence.act(replace(start, goal_quaternion=turns))
    turners: Any = (sequence.about, sequence.across)
    assert (sequence.diagnostics["leg"] == Leg.LAST).all()
    np.testing.assert_allclose(sequence.diagnostics["left"], 1.5, atol=0.05)
    for one in turners:
        np.testing.assert_array_equal(one.asked.goal_angular_velocity, np.tile(0.5 * X, (24, 1)))
        assert one.asked.goal_quaternion is None
    sequence.act(start)  # no goal: it is turned about the axis
    np.testing.assert_array_equal(turners[0].asked.goal_angular_velocity, np.tile(0.5 * Z, (24, 1)))
    one = replace(start[0], goal_quaternion=turns[0])
    sequence.reset()
    assert sequence.act(one).shape == (15,)
    assert sequence.diagnostics["leg"] == Leg.LAST


def test_what_is_a_little_too_far_is_left_to_the_grasp(
    sequence: GoalSequence, start: GraspState
) -> None:
    now = start.object_quaternion
    assert now is not None
    # it turns one way only: what is 0.48 rad back would be nearly a full turn
    sequence.act(replace(start, goal_quaternion=multiply(about(Z, [-0.48] * 24), now)))
    assert (sequence.diagnostics["leg"] == Leg.GRASP).all()


def test_a_tilt_that_is_lost_in_the_grasp_is_turned_back(
    sequence: GoalSequence, start: GraspState
) -> None:
    now = start.object_quaternion
    assert now is not None
    sequence.act(replace(start, goal_quaternion=multiply(about(X, [0.3] * 24), now)))
    assert (sequence.diagnostics["leg"] == Leg.GRASP).all()
    fallen = multiply(about(X, [-0.8] * 24), now)
    goal = multiply(about(X, [0.3] * 24), now)
    sequence.act(replace(start, object_quaternion=fallen, goal_quaternion=goal))
    assert (sequence.diagnostics["leg"] == Leg.ACROSS).all()


def test_an_object_that_is_left_aslant_is_laid_flat_before_it_is_turned(
    sequence: GoalSequence, start: GraspState
) -> None:
    upright = start.object_quaternion
    assert upright is not None
    sequence.act(replace(start, goal_quaternion=upright))
    goal, aslant = multiply(about(Z, [2.0] * 24), upright), multiply(about(X, [0.44] * 24), upright)
    asked = replace(start, goal_quaternion=goal)
    for _ in range(41):
        sequence.act(replace(asked, object_quaternion=aslant))
        assert (sequence.diagnostics["leg"] == Leg.LEVEL).all()
    sequence.act(replace(asked, object_quaternion=aslant))  # two seconds were enough
    assert (sequence.diagnostics["leg"] == Leg.ABOUT).all()
    sequence.reset()
    sequence.act(asked)
    sequence.act(replace(asked, object_quaternion=aslant, goal_quaternion=upright))
    sequence.act(replace(asked, object_quaternion=aslant))
    assert (sequence.diagnostics["leg"] == Leg.LEVEL).all()
    sequence.act(asked)  # it lies flat again
    assert (sequence.diagnostics["leg"] == Leg.ABOUT).all()


def test_it_is_known_by_name(cylinder: Scene) -> None:
    made = controllers.make("sequence:igm,coordinated", cylinder.hand, control_period=0.02)
    assert isinstance(made, GoalSequence)
    assert type(made.across).__name__ == "CoordinatedGait" and made.control_period == 0.02
    np.testing.assert_array_equal(made.turner.axes, [Z, X])  # both turn about z by themselves
    with pytest.raises(InvalidInput, match="expected sequence:ABOUT,ACROSS"):
        controllers.make("sequence", cylinder.hand)
    for wrong in ("goal", ",goal", "goal,", "goal,goal,goal"):
        with pytest.raises(InvalidInput, match=f"got '{wrong}'; expected two controllers"):
            controllers.make(f"sequence:{wrong}", cylinder.hand)


def test_what_it_refuses(
    cylinder: Scene, sequence: GoalSequence, start: GraspState, still: Callable[..., Any]
) -> None:
    hand = cylinder.hand
    with pytest.raises(
        InvalidInput, match=r"across turns about \(0, 0, 1\); expected .* right angles"
    ):
        GoalSequence(hand, about=still(hand), across=still(hand))
    with pytest.raises(InvalidInput, match="GoalGait does not turn about one axis"):
        GoalSequence(hand, across=GoalGait(hand))
    with pytest.raises(InvalidInput, match="most_tilt is 0.8; expected less than lost_tilt, 0.7"):
        GoalSequence(hand, most_tilt=0.8)
    with pytest.raises(InvalidInput, match="about is 'goal'; expected a Controller"):
        GoalSequence(hand, about="goal")  # type: ignore[arg-type]
    with pytest.raises(InvalidInput, match="across has a control_period of 0.02 s; expected 0.05"):
        GoalSequence(hand, across=still(hand, control_period=0.02))
    with pytest.raises(
        InvalidInput, match="no setting 'axis'; known keywords: control_period, speed"
    ):
        GoalSequence(hand, axis=(0, 0, 1))  # type: ignore[call-arg]
    blind = replace(start, goal_quaternion=start.object_quaternion, object_quaternion=None)
    with pytest.raises(InvalidInput, match="a goal and no pose"):
        sequence.act(blind)
