"""In which directions fingers push: unit, within the cone, towards the centre."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dexctl.igm import push_directions

LEVER = arrays(float, (4, 3), elements=st.floats(-0.125, 0.125, width=32))
RAW = arrays(float, (4, 3), elements=st.floats(-1, 1, width=32))


def unit(vectors: np.ndarray) -> np.ndarray:
    size = np.linalg.norm(vectors, axis=-1, keepdims=True)
    assume((size > 1e-3).all())
    return vectors / size


@given(raw=RAW, lever=LEVER, friction=st.floats(1e-3, 2.0))
def test_unit_and_within_the_cone(raw, lever, friction):
    normal = unit(raw)
    aside = lever - np.sum(lever * normal, axis=-1, keepdims=True) * normal
    # a contact that faces the centre to the last micrometre has no side to lean to
    assume((np.linalg.norm(aside, axis=-1) > 1e-6).all())
    push = push_directions(normal, lever, friction)
    np.testing.assert_allclose(np.linalg.norm(push, axis=-1), 1.0, atol=1e-9)
    cosine = np.sum(push * normal, axis=-1)
    assert (cosine >= 1.0 / np.sqrt(1.0 + friction**2) - 1e-9).all()
    # it leans to the centre's side, in the plane of the normal and the centre
    assert (np.sum(push * -aside, axis=-1) >= -1e-12).all()
    across = np.cross(normal, aside)
    np.testing.assert_allclose(np.sum(push * across, axis=-1), 0.0, atol=1e-9)


@given(raw=RAW, lever=LEVER)
def test_no_friction_is_along_the_normal(raw, lever):
    normal = unit(raw)
    np.testing.assert_array_equal(push_directions(normal, lever, 0.0), normal)


@given(lever=LEVER, friction=st.floats(0.0, 2.0))
def test_rows_out_of_touch_stay_zero(lever, friction):
    assert not push_directions(np.zeros((4, 3)), lever, friction).any()


def test_through_the_centre_where_the_cone_allows():
    """A finger above the centre of a block's side: the centre is 45 degrees down."""
    normal = np.array([[-1.0, 0.0, 0.0]])
    lever = np.array([[0.03, 0.0, 0.03]])
    diagonal = np.array([[-1.0, 0.0, -1.0]]) / np.sqrt(2.0)
    np.testing.assert_allclose(push_directions(normal, lever, 1.5), diagonal, atol=1e-12)
    edge = np.array([[-1.0, 0.0, -0.5]]) / np.sqrt(1.25)
    np.testing.assert_allclose(push_directions(normal, lever, 0.5), edge, atol=1e-12)


def test_a_centre_straight_ahead_or_behind_the_surface():
    normal = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
    lever = np.array([[0.0, 0.0, -0.05], [0.01, 0.0, 0.05]])
    push = push_directions(normal, lever, 0.5)
    np.testing.assert_allclose(push[0], [0.0, 0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(push[1], np.array([-0.5, 0.0, 1.0]) / np.sqrt(1.25), atol=1e-12)


@pytest.mark.parametrize("batch", [(), (3,)])
def test_batches(batch):
    rng = np.random.default_rng(0)
    normal = rng.normal(size=(*batch, 5, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    lever = rng.normal(size=(*batch, 5, 3)) * 0.05
    push = push_directions(normal, lever, 0.3)
    for index in np.ndindex(*batch):
        np.testing.assert_array_equal(
            push[index], push_directions(normal[index], lever[index], 0.3)
        )
