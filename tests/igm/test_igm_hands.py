"""In-grasp manipulation on other hands: wrists, other finger counts, unequal fingers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dexctl import GraspState, HandModel
from dexctl.igm import InGraspManipulation, InGraspManipulationConfig
from dexctl.igm.inverse import ContactInverse, solve_symmetric3
from dexctl.rotations import cross

TWIST = (0.0, 0.005, 0.0, 0.0, 0.1, 0.4)
DAMPING = 0.01


def least_squares(hand: HandModel, state: GraspState, velocity: np.ndarray) -> np.ndarray:
    """min |J dq - v|^2 + damping^2 |dq|^2, as one dense problem."""
    jacobian = hand.contact_jacobian(state.q, state.contact_position).reshape(-1, hand.nq)
    stacked = np.vstack([jacobian, DAMPING * np.eye(hand.nq)])
    right = np.concatenate([velocity.ravel(), np.zeros(hand.nq)])
    return np.linalg.lstsq(stacked, right, rcond=None)[0]


def wanted_velocity(state: GraspState) -> np.ndarray:
    assert state.object_position is not None
    lever = state.contact_position - state.object_position
    return np.array(TWIST[:3]) + cross(np.broadcast_to(TWIST[3:], lever.shape), lever)


HANDS = [
    pytest.param((3, 3), True, id="two fingers on a wrist"),
    pytest.param((3, 3, 3), True, id="three fingers on a wrist"),
    pytest.param((2, 4, 3), True, id="unequal fingers on a wrist"),
    pytest.param((3, 3), False, id="two fingers"),
    pytest.param((3, 3, 3), False, id="three fingers"),
    pytest.param((2, 4, 3), False, id="unequal fingers"),
    pytest.param((3, 3, 3, 2, 4, 3, 3), False, id="seven fingers"),
]


@pytest.mark.parametrize(("joints", "wrist"), HANDS)
@pytest.mark.parametrize("batch", [None, 3])
def test_the_inverse_is_damped_least_squares(make_hand, bent, grasp_of, joints, wrist, batch):
    hand = make_hand(joints, wrist=wrist)
    assert (hand.n_fingers, hand.shares_joints) == (len(joints), wrist)
    count = batch or 1
    q = np.stack([bent(hand, seed) for seed in range(count)])
    state = grasp_of(hand, q if batch else q[0])
    config = InGraspManipulationConfig.thesis(
        twist=TWIST, stability_gain=0.0, damping=DAMPING, max_joint_speed=1e3, max_lead=1e3
    )
    change = InGraspManipulation(hand, config, control_period=0.05).act(state)
    for i in range(count):
        one = state[i] if batch else state
        expected = least_squares(hand, one, 0.05 * wanted_velocity(one))
        np.testing.assert_allclose(change[i] if batch else change, expected, atol=1e-9)
        assert np.abs(expected).max() > 1e-3


def test_a_wrist_turns_with_the_fingers(make_hand, bent, grasp_of):
    """A turn about the wrist's own axis is mostly the wrist's, for that is the least motion."""
    hand = make_hand((3, 3, 3), wrist=True)
    state = grasp_of(hand, bent(hand, 0))
    axis = np.array([0.0, 1.0, 1.0]) / np.sqrt(2.0)
    state = replace(state, object_position=np.array([0.0, 0.0, -0.05]))  # on the wrist's axis
    config = InGraspManipulationConfig.thesis(
        twist=(0.0, 0.0, 0.0, *(0.4 * axis)), stability_gain=0.0, damping=1e-6
    )
    change = InGraspManipulation(hand, config, control_period=0.05).act(state)
    wrist = hand.joint_names.index("wrist")
    np.testing.assert_allclose(change[wrist], 0.4 * 0.05, rtol=0.2)
    assert np.abs(np.delete(change, wrist)).max() < 0.5 * abs(change[wrist])


@pytest.mark.parametrize(("joints", "wrist"), HANDS)
def test_all_settings_work_on_such_hands(make_hand, bent, grasp_of, joints, wrist):
    hand = make_hand(joints, wrist=wrist)
    state = grasp_of(hand, np.stack([bent(hand, seed) for seed in range(4)]))
    controller = InGraspManipulation(hand, InGraspManipulationConfig())
    together = controller.act(state)
    assert together.shape == (4, hand.nq) and together.any(axis=-1).all()
    for i in range(4):
        alone = InGraspManipulation(hand, InGraspManipulationConfig()).act(state[i])
        np.testing.assert_allclose(together[i], alone, atol=1e-8)


def test_a_finger_with_fewer_joints_than_it_needs_does_what_it_can(make_hand, bent, grasp_of):
    """Two joints reach a surface of directions: damped least squares, not a singular matrix."""
    hand = make_hand((2, 2, 2))
    state = grasp_of(hand, bent(hand, 0))
    config = InGraspManipulationConfig.thesis(damping=1e-3)
    change = InGraspManipulation(hand, config).act(state)
    assert np.isfinite(change).all() and np.abs(change).max() < 1.0


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_small_symmetric_systems(batch):
    rng = np.random.default_rng(0)
    root = rng.normal(size=(*batch, 4, 3, 3))
    matrix = root @ root.swapaxes(-1, -2) + 1e-3 * np.eye(3)
    right = rng.normal(size=(*batch, 4, 3))
    solved = solve_symmetric3(matrix, right)
    np.testing.assert_allclose((matrix @ solved[..., None])[..., 0], right, atol=1e-6)


def test_every_finger_is_a_system_of_its_own_without_a_wrist(make_hand, bent):
    """Solving finger by finger gives what the stacked system gives."""
    hand = make_hand((2, 4, 3))
    now = hand.configuration(bent(hand, 1))
    jacobian = now.finger_jacobian(now.fingertip_position)
    velocity = np.random.default_rng(1).normal(size=(3, 3))
    change = ContactInverse(hand, DAMPING).solve(jacobian, velocity)
    stacked = now.contact_jacobian(now.fingertip_position).reshape(-1, hand.nq)
    gram = stacked @ stacked.T + DAMPING**2 * np.eye(9)
    expected = stacked.T @ np.linalg.solve(gram, velocity.ravel())
    np.testing.assert_allclose(change, expected, atol=1e-10)


def test_what_suits_a_hand(make_hand):
    """Four fingers or fewer turn more slowly and correct more softly, whoever makes them."""
    few, five = make_hand((3, 3, 3, 3)), make_hand((3, 3, 3, 3, 3))
    assert InGraspManipulation(five).config == InGraspManipulationConfig()
    found = InGraspManipulation(few).config
    assert found == InGraspManipulationConfig.suiting(few)
    assert (found.twist[5], found.stability_gain, found.closing_lead) == (0.25, 0.008, 0.004)
    # single settings change those that suit; settings of one's own are taken as they are
    assert InGraspManipulation(few, grip_force=4.0).config == replace(found, grip_force=4.0)
    own = InGraspManipulationConfig(stability_gain=0.02)
    assert InGraspManipulation(few, own).config == own
