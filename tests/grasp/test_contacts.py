"""Contact frames, the grasp map in its three models, the stacked hand Jacobian."""

from __future__ import annotations

import numpy as np
import pytest

import dexctl
from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.grasp import grasp_map, hand_jacobian, tangent_basis


def unit(rng, *shape):
    v = rng.normal(size=(*shape, 3))
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def test_tangent_basis_is_a_right_handed_frame():
    normals = np.vstack([unit(np.random.default_rng(0), 50), np.eye(3), -np.eye(3)])
    basis = tangent_basis(normals)
    product = np.swapaxes(basis, -1, -2) @ basis
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), product.shape), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(basis), 1, atol=1e-14)
    np.testing.assert_array_equal(basis[..., 2], normals)


def test_one_contact_by_hand():
    # p - o = (1, 2, 3): a force along x has the torque (0, 3, -2), and so on.
    g = grasp_map([[2.0, 2, 3]], [1.0, 0, 0])
    expected = [
        [1, 0, 0], [0, 1, 0], [0, 0, 1],
        [0, -3, 2], [3, 0, -1], [-2, 1, 0],
    ]  # fmt: skip
    np.testing.assert_array_equal(g, expected)


def test_wrench_and_twist_are_dual():
    rng = np.random.default_rng(1)
    position, force = rng.normal(size=(4, 3)), rng.normal(size=(4, 3))
    origin, twist = rng.normal(size=3), rng.normal(size=6)
    g = grasp_map(position, origin)
    wrench = np.concatenate([force.sum(0), np.cross(position - origin, force).sum(0)])
    np.testing.assert_allclose(g @ force.ravel(), wrench, atol=1e-14)
    velocity = twist[:3] + np.cross(twist[3:], position - origin)
    np.testing.assert_allclose(g.T @ twist, velocity.ravel(), atol=1e-14)


def test_models_agree_with_each_other():
    rng = np.random.default_rng(2)
    position, normal, origin = rng.normal(size=(5, 4, 3)), unit(rng, 5, 4), rng.normal(size=(5, 3))
    hard = grasp_map(position, origin)
    soft = grasp_map(position, origin, normal=normal, model="soft")
    plain = grasp_map(position, origin, normal=normal, model="frictionless")
    assert hard.shape == (5, 6, 12) and soft.shape == (5, 6, 16) and plain.shape == (5, 6, 4)
    by_finger = soft.reshape(5, 6, 4, 4)
    np.testing.assert_array_equal(by_finger[..., :3].reshape(5, 6, 12), hard)
    np.testing.assert_array_equal(by_finger[:, :3, :, 3], 0)
    np.testing.assert_array_equal(np.swapaxes(by_finger[:, 3:, :, 3], 1, 2), normal)
    blocks = hard.reshape(5, 6, 4, 3)
    np.testing.assert_allclose(plain, np.einsum("nimc,nmc->nim", blocks, normal), atol=1e-14)


def test_masked_fingers_are_zero_and_never_read():
    rng = np.random.default_rng(3)
    position, normal = rng.normal(size=(3, 3)), unit(rng, 3)
    whole = grasp_map(position, np.zeros(3), normal=normal, model="soft")
    position[1], normal[1] = np.nan, np.nan
    masked = grasp_map(position, np.zeros(3), [True, False, True], normal, "soft")
    np.testing.assert_array_equal(masked[:, 4:8], 0)
    np.testing.assert_array_equal(
        np.delete(masked, range(4, 8), 1), np.delete(whole, range(4, 8), 1)
    )


def test_hand_jacobian_stacks_and_masks():
    hand = dexctl.hands.load("dex5")
    q = 0.5 * (hand.lower + hand.upper)
    position = hand.fingertip_positions(q)
    touch = np.array([True, False, True, True, True])
    position[1] = np.nan
    stacked = hand_jacobian(hand, q, position, touch)
    assert stacked.shape == (15, hand.nq)
    np.testing.assert_array_equal(stacked[3:6], 0)
    np.testing.assert_array_equal(
        hand_jacobian(hand, q[None], position[None], touch[None])[0], stacked
    )
    step = 1e-6
    for joint in range(hand.nq):
        change = np.zeros(hand.nq)
        change[joint] = step
        moved = hand.fingertip_positions(q + change) - hand.fingertip_positions(q - change)
        found = stacked[:, joint].reshape(5, 3)[touch]
        np.testing.assert_allclose(found, moved[touch] / (2 * step), atol=1e-8)


def test_bad_arguments_are_named():
    position = np.zeros((2, 3))
    with pytest.raises(UnknownName, match="frictionless, hard, soft"):
        grasp_map(position, np.zeros(3), model="sticky")
    with pytest.raises(InvalidInput, match="normal"):
        grasp_map(position, np.zeros(3), model="soft")
    with pytest.raises(InvalidInput, match="contact_position has shape"):
        grasp_map(np.zeros(3), np.zeros(3))
    with pytest.raises(InvalidInput, match="finite"):
        grasp_map(position * np.nan, np.zeros(3))
    with pytest.raises(InvalidInput, match="origin"):
        grasp_map(position, np.zeros(4))
    with pytest.raises(InvalidInput, match="in_contact"):
        grasp_map(position, np.zeros(3), [True])
