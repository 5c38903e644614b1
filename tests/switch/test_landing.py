"""Geometry about the axis of rotation: heights, angles, landings, the way round."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexctl.switch.landing import azimuth, landing_at, round_the_axis, split, turned, unit_across

Z = np.array([0.0, 0.0, 1.0])
TILTED = np.array([1.0, -2.0, 2.0]) / 3.0
AXES = pytest.mark.parametrize("axis", [Z, -Z, TILTED], ids=["up", "down", "tilted"])
ANGLE = st.floats(-3.0, 3.0)


def frame(axis: np.ndarray) -> np.ndarray:
    """A unit vector across ``axis``."""
    return unit_across(np.array([0.3, 0.9, -0.2]), axis)


def test_split_by_hand():
    height, across = split(np.array([[1.0, 2.0, 3.0]]), Z)
    assert height.tolist() == [3.0] and across.tolist() == [[1.0, 2.0, 0.0]]


@AXES
def test_split_adds_up(axis):
    vectors = np.random.default_rng(0).normal(size=(7, 3))
    height, across = split(vectors, axis)
    np.testing.assert_allclose(across @ axis, 0.0, atol=1e-12)
    np.testing.assert_allclose(height[:, None] * axis + across, vectors, atol=1e-12)


def test_unit_across():
    np.testing.assert_allclose(unit_across(np.array([3.0, 4.0, 9.0]), Z), [0.6, 0.8, 0.0])
    assert not unit_across(Z, Z).any()  # nothing across: no direction, and no NaN


@AXES
@given(angle=ANGLE)
def test_turning_and_measuring_are_inverse(axis, angle):
    start = frame(axis)
    end = turned(start, angle, axis)
    assert np.isclose(np.linalg.norm(end), 1.0) and np.isclose(end @ axis, 0.0)
    assert np.isclose(azimuth(start, end, axis), angle)


def test_turned_by_hand():
    np.testing.assert_allclose(turned(np.array([1.0, 0, 0]), np.pi / 2, Z), [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(turned(np.array([1.0, 0, 0]), np.pi / 2, -Z), [0, -1, 0], atol=1e-12)
    batch = turned(np.array([[1.0, 0, 0], [0, 1.0, 0]]), np.array([np.pi / 2, np.pi]), Z)
    np.testing.assert_allclose(batch, [[0, 1, 0], [0, -1, 0]], atol=1e-12)


def test_landing_is_at_the_centres_height_from_outside():
    landing = landing_at(np.array([[0.1, 0.0, 0.2]]), np.array([[0.0, 1.0, 0.0]]), np.array([0.06]))
    np.testing.assert_allclose(landing.tip, [[0.1, 0.06, 0.2]])
    np.testing.assert_allclose(landing.normal, [[0.0, -1.0, 0.0]])


@AXES
@given(
    angle=ANGLE,
    radii=st.tuples(st.floats(0.02, 0.1), st.floats(0.02, 0.1)),
    heights=st.tuples(st.floats(-0.05, 0.05), st.floats(-0.05, 0.05)),
    least=st.floats(0.0, 0.12),
)
def test_the_way_round_gets_there_and_stays_outside(axis, angle, radii, heights, least):
    origin = np.array([0.01, -0.02, 0.13])
    start = frame(axis)
    tip = origin + radii[0] * start + heights[0] * axis
    goal = origin + radii[1] * turned(start, angle, axis) + heights[1] * axis
    way = [tip]
    for _ in range(30):
        following = round_the_axis(way[-1][None], goal[None], origin[None], axis, np.array([least]))
        way.append(following[0])
        if np.linalg.norm(way[-1] - goal) < 1e-9:
            break
    np.testing.assert_allclose(way[-1], goal, atol=1e-9)
    assert len(way) - 1 <= np.ceil(abs(angle) / 0.25) + 1
    _, across = split(np.array(way) - origin, axis)
    radius = np.linalg.norm(across, axis=-1)
    assert radius.min() >= min(radii) - 1e-9
    assert (radius[1:-1] >= max(*radii, least) - 1e-9).all()
    steps = azimuth(across[:-1], across[1:], axis)
    assert (np.abs(steps) <= 0.25 + 1e-9).all()
    assert np.isclose(steps.sum(), angle, atol=1e-6)


def test_goals_of_a_batch_are_each_their_own():
    rng = np.random.default_rng(1)
    tip, goal = rng.normal(size=(2, 6, 3)) * 0.05
    origin = rng.normal(size=(6, 3)) * 0.01
    least = rng.uniform(0.0, 0.1, 6)
    together = round_the_axis(tip, goal, origin, TILTED, least)
    for i in range(6):
        one = slice(i, i + 1)
        alone = round_the_axis(tip[one], goal[one], origin[one], TILTED, least[one])
        np.testing.assert_allclose(together[one], alone, atol=1e-15)
