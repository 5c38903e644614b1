"""GoalPursuit: where its goals go, and objects that are turned so."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

from dexctl import CoordinatedGait, GraspState, InvalidInput, UnknownName, controllers
from dexctl.gait import GoalGait, GoalPursuit
from dexctl.rotations import from_rotation_vector, inverse, multiply, rotation_vector
from dexctl.sim import BatchSimulator, Scene

PERIOD = 0.05


@pytest.fixture(scope="module")
def start(cylinder: Scene) -> GraspState:
    with BatchSimulator(cylinder, 2, seed=0, threads=1) as sim:
        return sim.read()


@pytest.fixture
def pursuit(cylinder: Scene, still: Callable[..., Any]) -> GoalPursuit:
    return GoalPursuit(cylinder.hand, reacher=still(cylinder.hand), lookahead=0.5)


def told(state: GraspState, spin: ArrayLike, turned: ArrayLike = (0.0, 0.0, 0.0)) -> GraspState:
    """Told an angular velocity, the objects turned by so much since the start."""
    assert state.object_quaternion is not None
    count = len(state.q)
    turn = from_rotation_vector(np.broadcast_to(turned, (count, 3)).astype(float))
    return replace(
        state,
        object_quaternion=multiply(turn, state.object_quaternion),
        goal_angular_velocity=np.broadcast_to(spin, (count, 3)).astype(float).copy(),
    )


def left(quaternion: np.ndarray | None, start: GraspState) -> np.ndarray:
    """The turn from where the objects began, as rotation vectors ``(N, 3)`` [rad]."""
    assert quaternion is not None and start.object_quaternion is not None
    return rotation_vector(multiply(quaternion, inverse(start.object_quaternion)))


def ahead(pursuit: GoalPursuit, start: GraspState) -> np.ndarray:
    """The goals that were asked for, as rotation vectors from where the objects began."""
    reacher: Any = pursuit.reacher
    assert reacher.asked.goal_angular_velocity is None
    return left(reacher.asked.goal_quaternion, start)


def test_the_goal_goes_ahead_and_waits(pursuit: GoalPursuit, start: GraspState) -> None:
    """0.8 rad/s for 0.05 s are 0.04 rad a step, until 0.5 rad ahead of an object that stays."""
    spin = np.array([0.0, 0.8, 0.0])
    for step in range(1, 20):
        pursuit.act(told(start, spin))
        most = min(0.04 * step, 0.5)
        np.testing.assert_allclose(ahead(pursuit, start), [[0, most, 0]] * 2, atol=1e-9)
        np.testing.assert_allclose(pursuit.diagnostics["ahead"], most, atol=1e-9)
    pursuit.act(told(start, spin, [0.0, 0.3, 0.0]))  # there is room again: it goes on by a step
    np.testing.assert_allclose(ahead(pursuit, start), [[0, 0.54, 0]] * 2, atol=1e-9)


def test_the_goal_is_never_behind(pursuit: GoalPursuit, start: GraspState) -> None:
    pursuit.act(told(start, [0, 0, 0.8]))
    pursuit.act(told(start, [0, 0, 0.8], [0, 0, 2.5]))  # the object ran ahead
    np.testing.assert_allclose(ahead(pursuit, start), [[0, 0, 2.5]] * 2, atol=1e-9)


def test_more_than_a_turn(pursuit: GoalPursuit, start: GraspState) -> None:
    """An object that follows is led round and round: 8 rad in 200 steps of 0.04 rad."""
    for step in range(200):
        pursuit.act(told(start, [0, 0, 0.8], [0, 0, 0.04 * step]))
        np.testing.assert_allclose(pursuit.diagnostics["ahead"], 0.04, atol=1e-9)


def test_tilts_on_the_way_are_made_good(pursuit: GoalPursuit, start: GraspState) -> None:
    """The goal stays on the path, however the object tilts."""
    for step in range(1, 6):
        pursuit.act(
            told(start, [0, 0, 0.8], [0.2, -0.1, 0.0]) if step > 1 else told(start, [0, 0, 0.8])
        )
        np.testing.assert_allclose(ahead(pursuit, start)[:, :2], 0.0, atol=1e-9)


def test_told_another_it_starts_from_where_the_object_is(
    pursuit: GoalPursuit, start: GraspState
) -> None:
    for _ in range(10):
        pursuit.act(told(start, [0, 0, 0.8]))
    pursuit.act(told(start, [0, 0, -0.8]))  # the way back does not begin with the way on
    np.testing.assert_allclose(ahead(pursuit, start), [[0, 0, -0.04]] * 2, atol=1e-9)
    pursuit.reset()
    for _ in range(10):
        pursuit.act(told(start, [0, 0, 0.8]))
    pursuit.act(told(start, [0, 0, 0.4]))  # more slowly: what is ahead stays ahead
    np.testing.assert_allclose(ahead(pursuit, start), [[0, 0, 0.42]] * 2, atol=1e-9)
    pursuit.act(told(start, [0.4, 0, 0]))  # across: from here, tilts of before are not made good
    np.testing.assert_allclose(ahead(pursuit, start), [[0.02, 0, 0]] * 2, atol=1e-9)


def test_a_command_that_changes_all_the_time(pursuit: GoalPursuit, start: GraspState) -> None:
    """As from a joystick: the goal gets ahead all the same."""
    for step in range(12):
        angle = 0.01 * step
        pursuit.act(told(start, [0.0, 0.8 * np.sin(angle), 0.8 * np.cos(angle)]))
    assert (pursuit.diagnostics["ahead"] > 0.45).all()


def test_told_to_stand(pursuit: GoalPursuit, start: GraspState) -> None:
    """The object is kept as it lies, not brought on to where the goal was."""
    for _ in range(5):
        pursuit.act(told(start, [0, 0, 0.8]))
    for turned in (0.1, 0.3):
        pursuit.act(told(start, [0, 0, 0], [0, 0, turned]))
        np.testing.assert_allclose(ahead(pursuit, start), [[0, 0, 0.1]] * 2, atol=1e-9)


def test_each_of_a_batch_by_itself(pursuit: GoalPursuit, start: GraspState) -> None:
    for _ in range(3):
        pursuit.act(told(start, [[0, 0, 0.8], [0.4, 0, 0]]))
    np.testing.assert_allclose(ahead(pursuit, start), [[0, 0, 0.12], [0.06, 0, 0]], atol=1e-9)
    pursuit.reset(mask=[True, False])
    pursuit.act(told(start, [[0, 0, 0.8], [0.4, 0, 0]], [0, 0, 0.0]))
    np.testing.assert_allclose(ahead(pursuit, start), [[0, 0, 0.04], [0.08, 0, 0]], atol=1e-9)


def test_where_nobody_tells(cylinder: Scene, start: GraspState, still: Callable[..., Any]) -> None:
    """By itself about its axis; a state's own goal goes to the other controller."""
    made = GoalPursuit(cylinder.hand, reacher=still(cylinder.hand), axis=(0, -2, 0), speed=0.6)
    made.act(start)
    np.testing.assert_allclose(ahead(made, start), [[0, -0.03, 0]] * 2, atol=1e-9)
    goal = np.tile([0.0, 1.0, 0.0, 0.0], (2, 1))
    made.act(replace(told(start, [0, 0, 1.0]), goal_quaternion=goal))
    asked: Any = made.reacher
    np.testing.assert_array_equal(asked.asked.goal_quaternion, goal)


def test_after_a_goal_of_the_states_own_it_starts_from_where_the_object_is(
    pursuit: GoalPursuit, start: GraspState
) -> None:
    pursuit.act(told(start, [0, 0, 0.8]))
    goal = np.tile([0.0, 1.0, 0.0, 0.0], (2, 1))
    pursuit.act(replace(told(start, [0, 0, 0.8]), goal_quaternion=goal))
    tilted = told(start, [0, 0, 0.8], [1.0, 0, 0])
    pursuit.act(tilted)
    np.testing.assert_allclose(ahead(pursuit, tilted), [[0, 0, 0.04]] * 2, atol=1e-9)


def test_the_goal_gait_turns_so(cylinder: Scene) -> None:
    """Told 0.1 rad/s for 8 s, either way, it turns 0.8 rad less what it lags behind."""
    made = controllers.make("pursuing:goal", cylinder.hand, control_period=PERIOD)
    assert isinstance(made, GoalPursuit) and isinstance(made.reacher, GoalGait)
    with BatchSimulator(cylinder, 2, seed=0, threads=1) as sim:
        begin = sim.read()
        for _ in range(160):
            state = told(sim.read(), [[0, 0, 0.1], [0, 0, -0.1]])
            sim.write(state.q_target + made.act(state))
            sim.step()
        turned = left(sim.read().object_quaternion, begin)[:, 2] * [1, -1]
    assert (turned > 0.4).all() and (turned < 0.85).all()


def test_what_it_refuses(cylinder: Scene, start: GraspState) -> None:
    hand = cylinder.hand
    with pytest.raises(InvalidInput, match="expected pursuing:NAME"):
        controllers.make("pursuing", hand)
    with pytest.raises(UnknownName, match="unknown controller 'nobody'"):
        controllers.make("pursuing:nobody", hand)
    with pytest.raises(InvalidInput, match="got 'igm', which goes to no goals; expected a contr"):
        controllers.make("pursuing:igm", hand)
    for value in (0.0, -1.0, np.nan, 3.2):
        with pytest.raises(InvalidInput, match="lookahead is"):
            GoalPursuit(hand, reacher=GoalGait(hand), lookahead=value)
    with pytest.raises(InvalidInput, match="speed is 0"):
        GoalPursuit(hand, reacher=GoalGait(hand), speed=0)
    with pytest.raises(InvalidInput, match="axis"):
        GoalPursuit(hand, reacher=GoalGait(hand), axis=(0, 0, 0))
    with pytest.raises(InvalidInput, match="reacher is 'goal'; expected a Controller"):
        GoalPursuit(hand, reacher="goal")  # type: ignore[arg-type]
    blind = replace(told(start, [0, 0, 1.0]), object_quaternion=None)
    with pytest.raises(InvalidInput, match="no orientation of the object; expected a tracked"):
        GoalPursuit(hand, reacher=GoalGait(hand)).act(blind)

    class Deaf(CoordinatedGait):
        goes_to_goals = False

    with pytest.raises(InvalidInput, match="reacher is a Deaf that goes to no goals"):
        GoalPursuit(hand, reacher=Deaf(hand))
