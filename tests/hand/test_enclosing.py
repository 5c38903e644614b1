"""The smallest ball around points: by hand, and against a slow search for it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexctl.enclosing import enclosing_centre


@pytest.mark.parametrize(
    ("points", "centre"),
    [
        ([[1.0, 2.0, 3.0]], [1, 2, 3]),
        ([[0, 0, 0], [2, 0, 0]], [1, 0, 0]),
        ([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [1, 0, 0]),  # on a line
        ([[-1, 0, 0], [1, 0, 0], [0, 0.5, 0]], [0, 0, 0]),  # obtuse: the long side
        ([[-1, 0, 0], [1, 0, 0], [0, 2, 0]], [0, 0.75, 0]),  # acute: the circle through all
        ([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], [0, 0, 0]),  # a tetrahedron
        # three fingers against a thumb: between them, where the mean is near the fingers
        ([[0.04, -0.02, 0], [0.04, 0, 0], [0.04, 0.02, 0], [-0.04, 0, 0]], [0.0025, 0, 0]),
        ([[5.0, 5, 5]] * 4, [5, 5, 5]),
    ],
)
def test_by_hand(points: list[list[float]], centre: list[float]) -> None:
    np.testing.assert_allclose(enclosing_centre(np.array(points, float)), centre, atol=1e-8)


def test_only_those_that_count() -> None:
    points = np.array([[0.0, 0, 0], [2, 0, 0], [9, 9, 9], [4, 0, 0]])
    rows = [[1, 1, 0, 0], [0, 1, 0, 1], [0, 0, 1, 0], [0, 0, 0, 0]]
    found = enclosing_centre(np.tile(points, (4, 1, 1)), np.array(rows, bool))
    np.testing.assert_allclose(found[:3], [[1, 0, 0], [3, 0, 0], [9, 9, 9]], atol=1e-8)
    np.testing.assert_allclose(found[3], points.mean(axis=0))  # none of them: the mean


@given(st.integers(0, 2**32 - 1), st.integers(1, 8), st.integers(-6, 3))
def test_no_smaller_ball_holds_them(seed: int, count: int, power: int) -> None:
    rng = np.random.default_rng(seed)
    points = 10.0**power * (rng.normal(size=(count, 3)) + rng.normal(size=3))
    centre = enclosing_centre(points)
    radius = np.linalg.norm(points - centre, axis=1).max()
    # the centre of the smallest ball is a mixture of the points that are farthest from it
    slow = points.mean(axis=0)  # Badoiu and Clarkson: a step towards the farthest, ever smaller
    for k in range(2, 400):
        slow = slow + (points[np.linalg.norm(points - slow, axis=1).argmax()] - slow) / k
    assert radius <= np.linalg.norm(points - slow, axis=1).max() * (1 + 1e-6)


def test_many_points_have_the_middle_of_their_box() -> None:
    points = np.random.default_rng(0).normal(size=(2, 9, 3))
    middle = (points.min(axis=1) + points.max(axis=1)) / 2
    np.testing.assert_allclose(enclosing_centre(points), middle)


def test_a_batch_is_its_rows() -> None:
    points = np.random.default_rng(0).normal(size=(3, 2, 5, 3))
    found = enclosing_centre(points)
    np.testing.assert_allclose(found[2, 1], enclosing_centre(points[2, 1]))
