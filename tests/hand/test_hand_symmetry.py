"""Symmetries of a hand: which it has, and that what happens turned is what happens, turned."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import dexctl
from dexctl import HandModel, controllers
from dexctl.rotations import inverse, multiply, rotate, rotation_vector
from dexctl.sim import BatchSimulator, Scene
from dexctl.state import GraspState
from dexctl.symmetry import symmetries


def test_dex5_turns_by_fifths(dex5: HandModel) -> None:
    found = symmetries(dex5)
    vectors = np.array([rotation_vector(one.quaternion) for one in found])
    np.testing.assert_allclose(vectors[:, :2], 0.0, atol=1e-6)
    np.testing.assert_allclose(vectors[0], 0.0, atol=1e-9)
    fifths = np.sort(vectors[:, 2]) / (2 * np.pi / 5)
    np.testing.assert_allclose(fifths, [-2, -1, 0, 1, 2], atol=1e-6)
    for one in found:
        step = one.fingers[0]
        np.testing.assert_array_equal(one.fingers, (np.arange(5) + step) % 5)
        # finger by finger, its joints in their order
        np.testing.assert_array_equal(one.joints // 3, np.repeat(one.fingers, 3))
        np.testing.assert_array_equal(one.joints % 3, np.tile([0, 1, 2], 5))
        np.testing.assert_array_equal(one.signs, 1.0)
        vector = np.array([0.3, -0.2, 0.5])
        np.testing.assert_allclose(one.of_vectors(vector), rotate(one.quaternion, vector))


def test_a_hand_without_has_the_identity() -> None:
    four = Path(__file__).parents[1] / "hands"
    for path in sorted(four.glob("**/*.toml")):
        hand = HandModel.load(path)
        found = symmetries(hand)
        np.testing.assert_array_equal(found[0].rotation, np.eye(3))
        q = np.random.default_rng(0).uniform(-0.2, 0.2, (3, hand.nq))
        for one in found:  # whatever it is, it is one
            tips = one.of_points(hand.fingertip_positions(q))
            np.testing.assert_allclose(hand.fingertip_positions(one.of_joints(q)), tips, atol=1e-6)


@pytest.fixture(scope="module")
def cube(dex5: HandModel) -> Scene:
    # in a grasp that is symmetric itself it is a matter of order which finger presses hardest
    return Scene.build(dex5, "cube")


@pytest.fixture(scope="module")
def states(cube: Scene) -> list[GraspState]:
    """Of hands that in-grasp manipulation turns an object with."""
    igm = controllers.make("igm", cube.hand)
    found = []
    with BatchSimulator(cube, 3, seed=0, threads=1) as sim:
        for _ in range(20):
            state = sim.read()
            found.append(state)
            sim.write(state.q_target + igm.act(state))
            sim.step()
    return found


@pytest.mark.parametrize("name", ["igm", "coordinated", "goal"])
def test_a_turned_state_gives_the_turned_action(name: str, states: list[GraspState]) -> None:
    hand = dexctl.hands.load("dex5")
    for one in symmetries(hand)[1:3]:
        plain, turned = (controllers.make(name, hand) for _ in range(2))
        for state in states:
            expected = one.of_joints(plain.act(state))
            np.testing.assert_allclose(turned.act(one.of_state(state)), expected, atol=1e-7)


def test_the_physics_of_a_turned_start_is_the_turned_physics(cube: Scene) -> None:
    """Hands in the settled grasp, and turned: the same set-points lead to the same, turned."""
    one = symmetries(cube.hand)[1]
    change = np.random.default_rng(0).normal(0.0, 0.01, (20, 2, cube.hand.nq))
    with (
        BatchSimulator(cube, 2, seed=0, threads=1) as plain,
        BatchSimulator(cube, 2, seed=0, threads=1) as turned,
    ):
        state = plain.read()
        position, quaternion = state.object_position, state.object_quaternion
        assert position is not None
        assert quaternion is not None
        plain.set_grasp(state.q, state.q_target, position, quaternion)
        turned.set_grasp(
            one.of_joints(state.q),
            one.of_joints(state.q_target),
            one.of_vectors(position),
            one.of_orientations(quaternion),
        )
        for step in change:
            plain.write(plain.read().q_target + step)
            turned.write(turned.read().q_target + one.of_joints(step))
            plain.step()
            turned.step()
        expected, found = one.of_state(plain.read()), turned.read()
    np.testing.assert_allclose(found.q, expected.q, atol=1e-4)
    assert expected.object_quaternion is not None
    assert found.object_quaternion is not None
    np.testing.assert_allclose(found.object_centre(), expected.object_centre(), atol=1e-4)
    off = rotation_vector(multiply(found.object_quaternion, inverse(expected.object_quaternion)))
    assert np.abs(off).max() < 1e-3
    moved = np.abs(expected.q - one.of_joints(state.q)).max()
    assert moved > 0.01  # it is not that nothing happened
