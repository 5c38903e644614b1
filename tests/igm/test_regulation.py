"""Regulation: the object is pulled back to where the grasp found it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dexctl import GraspState, HandModel, InGraspManipulation
from dexctl.exceptions import InvalidInput
from dexctl.grasp import grasp_map

PERIOD = 0.05
GAINS: dict[str, Any] = {"height_gain": 1.0, "centring_gain": 2.0, "tilt_gain": 3.0}


def regulator(hand: HandModel, axis=(0.0, 0.0, 0.0), **gains: float) -> InGraspManipulation:
    """Regulation alone; the wanted rotation is too slow to see, and only names the axis."""
    still: dict[str, Any] = {**GAINS, **gains}
    return InGraspManipulation(
        hand,
        twist=(0.0, 0.0, 0.0, *(1e-12 * np.array(axis))),
        stability_gain=0.0,
        damping=1e-7,
        max_joint_speed=1e3,
        max_lead=1e3,
        control_period=PERIOD,
        **still,
    )


def object_twist(hand: HandModel, state: GraspState, change: np.ndarray) -> np.ndarray:
    """The rigid motion per second of the contact points under ``change``, ``(6,)``."""
    jacobian = hand.contact_jacobian(state.q, state.contact_position)
    moved = (jacobian @ change).ravel()
    G = grasp_map(state.contact_position, np.asarray(state.object_position))
    twist, *_ = np.linalg.lstsq(G.T, moved, rcond=None)
    np.testing.assert_allclose(G.T @ twist, moved, atol=1e-10)
    return twist / PERIOD


def tilted(angle: float, axis: tuple[float, float, float]) -> np.ndarray:
    return np.array([np.cos(angle / 2), *(np.sin(angle / 2) * np.array(axis))])


def test_nothing_to_do_where_it_was(dex5, grasp_of, posture):
    controller, state = regulator(dex5), grasp_of(dex5, posture)
    for _ in range(2):
        np.testing.assert_allclose(controller.act(state), 0.0, atol=1e-12)


def test_height_and_centring(dex5, grasp_of, posture):
    """Along the axis (z) with one gain, across it with the other; back to where it was."""
    controller, state = regulator(dex5), grasp_of(dex5, posture)
    controller.act(state)
    moved = replace(state, object_position=state.object_position + np.array([0.004, -0.002, 0.003]))
    twist = object_twist(dex5, moved, controller.act(moved))
    np.testing.assert_allclose(twist, [-0.008, 0.004, -0.003, 0, 0, 0], atol=1e-9)


def test_height_is_along_the_axis_of_the_wanted_rotation(dex5, grasp_of, posture):
    controller, state = regulator(dex5, (1.0, 0.0, 0.0)), grasp_of(dex5, posture)
    controller.act(state)
    moved = replace(state, object_position=state.object_position + np.array([0.004, -0.002, 0.003]))
    twist = object_twist(dex5, moved, controller.act(moved))
    np.testing.assert_allclose(twist, [-0.004, 0.004, -0.006, 0, 0, 0], atol=1e-9)


def test_tilt_is_turned_back(dex5, grasp_of, posture):
    controller, state = regulator(dex5), grasp_of(dex5, posture)
    controller.act(state)
    for axis, expected in (
        ((1.0, 0.0, 0.0), [-3 * np.sin(0.1), 0.0, 0.0]),
        ((0.0, 1.0, 0.0), [0.0, -3 * np.sin(0.1), 0.0]),
        ((0.0, 0.0, 1.0), [0.0, 0.0, 0.0]),  # the wanted rotation is no tilt
    ):
        leaning = replace(state, object_quaternion=tilted(0.1, axis))
        twist = object_twist(dex5, leaning, controller.act(leaning))
        np.testing.assert_allclose(twist, [0, 0, 0, *expected], atol=1e-9)


def test_tilt_from_the_first_attitude_whatever_it_was(dex5, grasp_of, posture):
    controller, state = regulator(dex5), grasp_of(dex5, posture)
    first = replace(state, object_quaternion=tilted(0.7, (0.0, 1.0, 0.0)))
    np.testing.assert_allclose(controller.act(first), 0.0, atol=1e-12)
    np.testing.assert_allclose(controller.act(first), 0.0, atol=1e-12)
    twist = object_twist(dex5, state, controller.act(state))
    np.testing.assert_allclose(twist, [0, 0, 0, 0, 3 * np.sin(0.7), 0], atol=1e-9)


def test_an_object_tracked_in_position_only(dex5, grasp_of, posture):
    controller = regulator(dex5)
    state = replace(grasp_of(dex5, posture), object_quaternion=None)
    controller.act(state)
    moved = replace(state, object_position=state.object_position + np.array([0.0, 0.0, 0.003]))
    twist = object_twist(dex5, moved, controller.act(moved))
    np.testing.assert_allclose(twist, [0, 0, -0.003, 0, 0, 0], atol=1e-9)


@pytest.mark.parametrize("gain", GAINS)
def test_each_gain_can_be_switched_off(dex5, grasp_of, posture, gain):
    controller = regulator(dex5, **{gain: 0.0})
    state = grasp_of(dex5, posture)
    controller.act(state)
    moved = replace(
        state,
        object_position=state.object_position + np.array([0.004, 0.0, 0.003]),
        object_quaternion=tilted(0.1, (1.0, 0.0, 0.0)),
    )
    twist = object_twist(dex5, moved, controller.act(moved))
    seen = {"height_gain": twist[2], "centring_gain": twist[0], "tilt_gain": twist[3]}
    for name, value in seen.items():
        assert (abs(value) < 1e-9) == (name == gain)


def test_reset_takes_a_new_reference_where_it_is_asked_to(dex5, grasp_of, posture):
    controller, one = regulator(dex5), grasp_of(dex5, posture)
    state = one[None][[0, 0, 0]]
    controller.act(state)
    moved = replace(state, object_position=state.object_position + np.array([0.0, 0.0, 0.003]))
    controller.reset(mask=np.array([True, False, True]))
    change = controller.act(moved)
    np.testing.assert_allclose(change[[0, 2]], 0.0, atol=1e-12)
    twist = object_twist(dex5, moved[1], change[1])
    np.testing.assert_allclose(twist, [0, 0, -0.003, 0, 0, 0], atol=1e-9)
    back = controller.act(state)  # the references of 0 and 2 are the moved ones now
    twist = object_twist(dex5, state[0], back[0])
    np.testing.assert_allclose(twist, [0, 0, 0.003, 0, 0, 0], atol=1e-9)
    np.testing.assert_allclose(back[1], 0.0, atol=1e-12)
    controller.reset()
    np.testing.assert_allclose(controller.act(moved), 0.0, atol=1e-12)


def test_the_reference_is_a_copy_of_the_position(dex5, grasp_of, posture):
    """A plant may fill the same buffer again."""
    controller, state = regulator(dex5), grasp_of(dex5, posture)
    controller.act(state)
    state.object_position[2] += 0.003
    twist = object_twist(dex5, state, controller.act(state))
    np.testing.assert_allclose(twist, [0, 0, -0.003, 0, 0, 0], atol=1e-9)


def test_another_batch_shape_needs_a_reset(dex5, grasp_of, posture):
    controller, one = regulator(dex5), grasp_of(dex5, posture)
    controller.act(one[None][[0, 0, 0]])
    with pytest.raises(InvalidInput, match=r"call reset\(\) before the batch shape"):
        controller.act(one)
    controller.reset()
    assert controller.act(one).shape == (15,)
