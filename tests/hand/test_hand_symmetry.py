"""Symmetries of a hand: which it has, and that what happens turned is what happens, turned."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest

import dexctl
from dexctl import HandModel, controllers
from dexctl.rotations import from_rotation_vector, inverse, multiply, rotate, rotation_vector
from dexctl.sim import BatchSimulator, Scene
from dexctl.state import GraspState
from dexctl.symmetry import symmetries, turned_to


def test_dex5_turns_by_fifths(dex5: HandModel) -> None:
    found = [one for one in symmetries(dex5) if not one.mirrors]
    x = np.array([one.of_vectors(np.array([1.0, 0.0, 0.0])) for one in found])
    fifths = np.sort(np.arctan2(x[:, 1], x[:, 0])) / (2 * np.pi / 5)
    np.testing.assert_allclose(fifths, [-2, -1, 0, 1, 2], atol=1e-6)
    for one in found:
        step = one.fingers[0]
        np.testing.assert_array_equal(one.fingers, (np.arange(5) + step) % 5)
        # finger by finger, its joints in their order
        np.testing.assert_array_equal(one.joints // 3, np.repeat(one.fingers, 3))
        np.testing.assert_array_equal(one.joints % 3, np.tile([0, 1, 2], 5))
        np.testing.assert_array_equal(one.signs, 1.0)
        vector, turn = np.array([0.3, -0.2, 0.5]), one.of_orientations(np.array([1.0, 0, 0, 0]))
        np.testing.assert_allclose(one.of_vectors(vector), rotate(turn, vector), atol=1e-12)
        np.testing.assert_array_equal(one.of_turnings(vector), one.of_vectors(vector))


def test_dex5_is_its_own_mirror_image(dex5: HandModel) -> None:
    """In the xz plane, through its first finger: the others change places, rolls change signs."""
    found = [one for one in symmetries(dex5) if one.mirrors]
    assert len(found) == 5
    (one,) = [one for one in found if one.fingers[0] == 0]
    np.testing.assert_allclose(one.matrix, np.diag([1.0, -1.0, 1.0]), atol=1e-9)
    np.testing.assert_array_equal(one.fingers, [0, 4, 3, 2, 1])
    np.testing.assert_array_equal(one.signs, np.tile([-1.0, 1.0, 1.0], 5))
    # what turns about z or x does so the other way round; about y as before
    np.testing.assert_allclose(one.of_turnings(np.eye(3)), np.diag([-1.0, 1.0, -1.0]), atol=1e-9)
    for other in found:  # the image of a point of the object is the point's image
        turn = from_rotation_vector(np.array([0.4, -0.7, 0.2]))
        point = np.array([0.03, 0.01, -0.02])
        image = rotate(other.of_orientations(turn), point * [1.0, -1.0, 1.0])
        np.testing.assert_allclose(image, other.of_vectors(rotate(turn, point)), atol=1e-12)


def test_joints_without_limits_have_them_too(dex5: HandModel) -> None:
    hand = pickle.loads(pickle.dumps(dex5))
    hand.lower, hand.upper = np.full(15, -np.inf), np.full(15, np.inf)
    for one, other in zip(symmetries(hand), symmetries(dex5), strict=True):
        np.testing.assert_allclose(one.matrix, other.matrix, atol=1e-9)


def test_they_are_found_once_for_a_hand(dex5: HandModel) -> None:
    assert symmetries(dex5) is symmetries(dex5)


def test_what_undoes_it(dex5: HandModel) -> None:
    random = np.random.default_rng(0)
    q, vector = random.normal(size=(4, 15)), random.normal(size=(4, 3))
    quaternion = from_rotation_vector(random.normal(size=(4, 3)))
    for one in symmetries(dex5):
        back = one.inverse
        assert back.mirrors == one.mirrors
        np.testing.assert_array_equal(back.of_joints(one.of_joints(q)), q)
        np.testing.assert_array_equal(back.of_fingers(one.of_fingers(q[:, :5])), q[:, :5])
        np.testing.assert_allclose(back.of_vectors(one.of_vectors(vector)), vector, atol=1e-8)
        np.testing.assert_allclose(back.of_turnings(one.of_turnings(vector)), vector, atol=1e-8)
        same = back.of_orientations(one.of_orientations(quaternion))
        np.testing.assert_allclose(np.abs((same * quaternion).sum(axis=1)), 1.0, atol=1e-8)


def test_which_symmetry_turns_one_axis_to_another(dex5: HandModel) -> None:
    x, z = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
    same = turned_to(dex5, z, z)
    assert same is not None
    assert not same.mirrors
    mirrored = turned_to(dex5, z, -z)
    assert mirrored is not None
    assert mirrored.mirrors
    assert turned_to(dex5, x, -x) is not None
    assert turned_to(dex5, x, np.array([0.0, 1.0, 0.0])) is None  # 18 degrees from the nearest


def test_a_hand_without_has_the_identity() -> None:
    four = Path(__file__).parents[1] / "hands"
    for path in sorted(four.glob("**/*.toml")):
        hand = HandModel.load(path)
        found = symmetries(hand)
        np.testing.assert_array_equal(found[0].matrix, np.eye(3))
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
    """In a mirror image, by a controller that turns the other way round."""
    hand = dexctl.hands.load("dex5")
    every = symmetries(hand)
    for one in (every[1], every[2], every[5], every[6]):
        axis = one.of_turnings(np.array([0.0, 0.0, 1.0]))
        plain, turned = (controllers.make(name, hand, axis=about) for about in ((0, 0, 1), axis))
        for state in states:
            expected = one.of_joints(plain.act(state))
            np.testing.assert_allclose(turned.act(one.of_state(state)), expected, atol=1e-7)


@pytest.mark.parametrize("which", [1, 5, 6])
def test_the_physics_of_a_turned_start_is_the_turned_physics(cube: Scene, which: int) -> None:
    """Hands in the settled grasp, and turned: the same set-points lead to the same, turned."""
    one = symmetries(cube.hand)[which]
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
