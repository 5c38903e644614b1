"""FlatTurns: plans that are carried out end where they say."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import ArrayLike

from dexctl.gait.flat_turns import FlatTurns, Plan
from dexctl.rotations import (
    angle_between,
    from_rotation_vector,
    inverse,
    multiply,
    rotate,
    shortest,
    twist_angle,
)
from dexctl.state import Floats
from learning.envs.goals import CUBE

Z = np.array([0.0, 0.0, 1.0])
AZIMUTH = np.radians(np.arange(0, 360, 72))
ACROSS = np.stack([np.cos(AZIMUTH), np.sin(AZIMUTH), 0 * AZIMUTH], axis=1)
NONE = np.array([1.0, 0.0, 0.0, 0.0])


def about(axis: Floats, angle: ArrayLike) -> Floats:
    return from_rotation_vector(np.asarray(angle, float)[..., None] * axis)


def turns(count: int = 5, way: int = 1, faces: int = 4) -> FlatTurns:
    return FlatTurns(Z, ACROSS[:count], np.full(count, way), faces)


def carried_out(one: FlatTurns, plan: Plan, now: Floats, goal: Floats) -> tuple[Floats, Floats]:
    """Where a plan ends if every turn is made as it says, and how far it turned in all [rad]."""
    face, _, _ = one.lies(now)
    way = plan.way
    first = plan.first >= 0
    k = np.maximum(plan.first, 0)
    ready = np.where(first, one.yaw_left(now, face, plan.ready, way), 0.0)
    now = multiply(about(Z, way * ready), now)
    left = np.where(first, one.across_left(now, plan.face, k), 0.0) % (2.0 * np.pi)
    now = multiply(about(one.across[k], left), now)
    reached, tilt, _ = one.lies(now)
    np.testing.assert_array_equal(reached, plan.face)
    assert tilt.max() < 1e-6  # square, or the turn across would have left a tilt
    yaw = one.yaw_left(now, plan.face, plan.yaw, way)
    now = multiply(about(Z, way * yaw), now)
    u = one.across[np.maximum(plan.last, 0)]
    rest = multiply(goal, inverse(now))
    last = shortest(twist_angle(rest, u))
    last = np.where(plan.last >= 0, last, 0.0)
    assert last.min() > -1e-9
    assert last.max() <= one.step + 1e-9
    return multiply(about(u, last), now), ready + left + yaw + last


@pytest.mark.parametrize(("count", "way"), [(1, 1), (5, 1), (5, -1)])
def test_the_24_orientations_of_a_cube_are_come_to_flat(count: int, way: int) -> None:
    one = turns(count, way)
    assert len(one.directions) == 6
    now = np.tile(NONE, (24, 1))
    plan = one.plan(now, CUBE, np.zeros(len(now), int), 0.45, 0.5, 0.2)
    end, turned = carried_out(one, plan, now, CUBE)
    # a last turn that is not quite square may be nearer than one that is, for the grasp to end
    assert angle_between(end, CUBE).max() < (1e-6 if count == 1 else 0.45)
    assert turned.max() < 3.3 * np.pi


def test_most_orientations_are_come_to_but_for_what_the_grasp_makes_good() -> None:
    rng = np.random.default_rng(0)
    goal = rng.normal(size=(400, 4))
    goal /= np.linalg.norm(goal, axis=1, keepdims=True)
    yaw = about(Z, rng.uniform(-np.pi, np.pi, 400))
    now = multiply(yaw, CUBE[rng.integers(24, size=400)])
    found = {}
    for count in (1, 5):
        one = turns(count)
        plan = one.plan(now, goal, np.zeros(len(now), int), 0.45, 0.5, 0.2)
        end, _ = carried_out(one, plan, now, goal)
        found[count] = np.mean(angle_between(end, goal) < 0.65)
        lying, _, _ = one.lies(end)
        assert lying.shape == (400,)
    assert found[5] > 0.99
    assert found[1] > 0.75


def test_a_turn_that_went_a_little_too_far_is_not_made_once_more() -> None:
    """One way only, what is 0.4 rad back is left to the grasp; square to an axis it is not."""
    one = turns(1)
    now = about(Z, np.array([0.4, 0.4]))
    goal = np.stack([NONE, about(ACROSS[0], np.array(0.8))])
    plan = one.plan(now, goal, np.zeros(len(now), int), 0.45, 0.5, 0.2)
    np.testing.assert_allclose(plan.cost[0], 0.2)
    assert plan.last[0] == plan.first[0] == -1
    assert plan.cost[1] > 1.5  # it turns on by a quarter, at least


def test_what_is_left_across_and_about() -> None:
    one = turns()
    now = np.stack([NONE, about(ACROSS[0], np.array(0.4)), about(Z, np.array(0.3))])
    face, tilt, yaw = one.lies(now)
    np.testing.assert_allclose(rotate(now, one.directions[face])[0], Z)
    np.testing.assert_allclose(tilt, [0.0, 0.4, 0.0], atol=1e-7)
    np.testing.assert_allclose(yaw, [0.0, 0.0, 0.3], atol=1e-7)
    np.testing.assert_allclose(
        one.across_left(now, face, np.zeros(3, int)), [0, -0.4, 0], atol=1e-7
    )
    for way, left in ((1, 2 * np.pi - 0.4), (-1, 0.4)):
        one_way = one.yaw_left(now[2:], face[2:], np.array([-0.1]), np.array([way]))
        np.testing.assert_allclose(one_way, left)
    over = one.yaw_left(now[2:], face[2:], np.array([0.2]), np.array([1]))
    np.testing.assert_allclose(over, -0.1)  # a little too far is not nearly a turn left


def test_from_an_edge_it_goes_to_the_flat_position_that_is_next_on_its_way() -> None:
    one = turns()
    now = about(ACROSS[0], np.array([0.6, 1.2]))
    face, k = one.back(now, np.ones(2, int))
    np.testing.assert_array_equal(k, 0)
    left = one.across_left(now, face, k)
    np.testing.assert_allclose(left, np.pi / 2 - np.array([0.6, 1.2]))


def test_an_object_with_one_flat_position_is_turned_about_the_axis_only() -> None:
    one = turns(faces=1)
    np.testing.assert_allclose(one.directions, [Z])
    now, goal = NONE[None], about(Z, np.array([1.0]))
    plan = one.plan(now, goal, np.zeros(len(now), int), 0.45, 0.5, 0.2)
    assert plan.first[0] == plan.last[0] == -1
    np.testing.assert_allclose(plan.yaw, 1.0)
