"""In-grasp manipulation: what it commands, against the equations of thesis chapter 4."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexctl import GraspState, HandModel, InGraspManipulation
from dexctl.enclosing import enclosing_centre
from dexctl.grasp import grasp_map, stability_forces
from dexctl.igm import InGraspManipulationConfig, Share, push_directions

PERIOD = 0.05
STILL = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
TURN = (0.01, -0.02, 0.005, 0.1, -0.2, 0.4)
# no damping to speak of, no limit in the way: the equations as they stand
EXACT: dict[str, Any] = {"damping": 1e-7, "max_joint_speed": 1e3, "max_lead": 1e3}


def wiggled(posture: np.ndarray, seed: int, batch: tuple[int, ...] = ()) -> np.ndarray:
    noise = np.random.default_rng(seed).uniform(-0.1, 0.1, (*batch, len(posture)))
    return posture + noise


def tip_motion(hand: HandModel, state: GraspState, change: np.ndarray) -> np.ndarray:
    """J dq: how far the contact points go, ``(..., m, 3)`` [m]."""
    jacobian = hand.contact_jacobian(state.q, state.contact_position)
    return np.einsum("...ijk,...k->...ij", jacobian, change)


def joints_of(hand: HandModel, finger: int) -> np.ndarray:
    return np.flatnonzero(hand.moves[finger])


@pytest.mark.parametrize("seed", range(4))
def test_rotation_moves_the_contacts_with_the_object(dex5, grasp_of, posture, seed):
    """Eq. dqrot: J dq = G^T do."""
    state = grasp_of(dex5, wiggled(posture, seed))
    config = InGraspManipulationConfig.thesis(twist=TURN, stability_gain=0.0, **EXACT)
    change = InGraspManipulation(dex5, config, control_period=PERIOD).act(state)
    G = grasp_map(state.contact_position, state.object_position)
    wanted = (G.T @ (np.array(TURN) * PERIOD)).reshape(5, 3)
    np.testing.assert_allclose(tip_motion(dex5, state, change), wanted, atol=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_stability_presses_by_the_force_error(dex5, grasp_of, posture, seed):
    """Eq. dqstab: J dq = alpha (c* - c) n over the control period."""
    state = grasp_of(dex5, wiggled(posture, seed))
    force = np.array([0.5, 2.0, 1.0, 0.0, 3.0])
    state = replace(state, contact_force=force)
    config = InGraspManipulationConfig.thesis(twist=STILL, **EXACT)
    controller = InGraspManipulation(dex5, config, control_period=PERIOD)
    change = controller.act(state)
    best = stability_forces(
        state.contact_position, state.contact_normal, state.in_contact, state.object_position
    )
    np.testing.assert_allclose(
        controller.diagnostics["desired_force"], config.grip_force * best.forces, atol=1e-9
    )
    np.testing.assert_allclose(controller.diagnostics["residual"], best.residual, atol=1e-9)
    press = config.stability_gain * PERIOD * (config.grip_force * best.forces - force)
    wanted = press[:, None] * state.contact_normal
    np.testing.assert_allclose(tip_motion(dex5, state, change), wanted, atol=1e-12)


def test_numbers_by_hand(dex5, grasp_of, posture):
    """Five fingers evenly round the axis: 1.5 N too little, so each goes 1.875 mm inwards."""
    state = grasp_of(dex5, posture)
    controller = InGraspManipulation(
        dex5,
        twist=(0.0, 0.0, 0.0, 0.0, 0.0, 0.4),
        grip_force=2.5,
        stability_gain=0.025,
        friction=0.0,
        control_period=PERIOD,
        **EXACT,
    )
    moved = tip_motion(dex5, state, controller.act(state))
    np.testing.assert_allclose(controller.diagnostics["desired_force"], 2.5, rtol=1e-6)
    normal = state.contact_normal
    inwards = np.sum(moved * normal, axis=-1)
    np.testing.assert_allclose(inwards, 0.05 * 0.025 * 1.5, rtol=1e-6)
    radius = np.linalg.norm(state.contact_position[:, :2], axis=-1)
    sideways = np.sum(moved * np.cross([0, 0, 1], -normal), axis=-1)
    np.testing.assert_allclose(sideways, 0.05 * 0.4 * radius, rtol=1e-6)
    np.testing.assert_allclose(moved[:, 2], 0.0, atol=1e-9)


def test_the_two_parts_add_up(dex5, grasp_of, posture):
    state = grasp_of(dex5, wiggled(posture, 1))
    config = InGraspManipulationConfig.thesis(twist=TURN, **EXACT)
    parts = [
        InGraspManipulation(dex5, replace(config, **change)).act(state)
        for change in ({"twist": STILL}, {"stability_gain": 0.0})
    ]
    np.testing.assert_allclose(
        InGraspManipulation(dex5, config).act(state), sum(parts), rtol=1e-9, atol=1e-14
    )


@pytest.mark.parametrize("batch", [(), (3,)])
@given(touch=st.lists(st.booleans(), min_size=5, max_size=5))
def test_fingers_out_of_touch_get_exactly_nothing(dex5, grasp_of, posture, batch, touch):
    state = grasp_of(dex5, wiggled(posture, 2, batch))
    shown = np.broadcast_to(touch, (*batch, 5)).copy()
    state = replace(state, in_contact=shown)
    change = InGraspManipulation(dex5, InGraspManipulationConfig.thesis()).act(state)
    for finger, touches in enumerate(touch):
        own = change[..., joints_of(dex5, finger)]
        assert own.any() if touches else not own.any()


def test_released_fingers_get_exactly_nothing(dex5, grasp_of, posture):
    """Not even to close in: they belong to another controller."""
    state = grasp_of(dex5, posture)
    state = replace(state, in_contact=np.array([True, True, True, True, False]))
    released = np.array([False, True, False, False, True])
    change = InGraspManipulation(dex5, closing_speed=0.1).command(state, Share(released=released))
    for finger in range(5):
        assert change[joints_of(dex5, finger)].any() == (not released[finger])


def test_the_limits_of_a_shared_grip(dex5, grasp_of, posture):
    state = grasp_of(dex5, wiggled(posture, 3))
    controller = InGraspManipulation(dex5)
    share = np.array([1.0, 1.0, 0.25, 1.0, 1.0])
    controller.command(state, Share(max_force=share))
    force = controller.diagnostics["desired_force"]
    assert force[2] <= 0.25 * controller.config.grip_force + 1e-12
    assert np.isclose(force.max(), controller.config.grip_force)


def test_a_yielding_finger_goes_back_to_where_it_is(dex5, grasp_of, posture):
    """At rate r the set-point's lead shrinks by exp(-r dt), at whatever control rate."""
    settings = {**EXACT, "twist": STILL, "stability_gain": 0.0}
    state = grasp_of(dex5, posture)
    lead = np.zeros(15)
    lead[3:6] = [0.02, -0.03, 0.01]
    rate = np.array([0.0, 8.0, 0.0, 0.0, 0.0])
    left = []
    for period in (0.05, 0.025):
        controller = InGraspManipulation(dex5, control_period=period, **settings)
        target = state.q + lead
        for _ in range(round(0.05 / period)):
            now = replace(state, q_target=target)
            target = target + controller.command(now, Share(yielding=rate))
        left.append((target - state.q)[3:6])
    np.testing.assert_allclose(left[0], np.exp(-8.0 * 0.05) * lead[3:6], rtol=1e-6)
    np.testing.assert_allclose(left[1], left[0], rtol=1e-6)


def test_a_yielding_finger_that_still_presses_goes_back_further(dex5, grasp_of, posture):
    """With its set-point where it is already, a finger held by dry friction still presses."""
    state = grasp_of(dex5, posture)
    assert state.contact_force[1] > 0.5
    rate, share = np.array([0.0, 8.0, 0.0, 0.0, 0.0]), np.array([1.0, 0.0, 1.0, 1.0, 1.0])
    settings = {**EXACT, "twist": STILL, "friction": 0.0}
    controller = InGraspManipulation(dex5, **settings)
    change = controller.command(replace(state, q_target=state.q), Share(None, share, None, rate))
    jacobian = dex5.contact_jacobian(state.q, state.contact_position)[1]
    speed = jacobian @ change @ state.contact_normal[1] / 0.05
    wanted = -controller.config.stability_gain * state.contact_force[1]
    np.testing.assert_allclose(speed, wanted, rtol=1e-6)


@pytest.mark.parametrize("damping", [0.005, 0.02])
def test_damping_bounds_the_motion_of_a_straight_finger(dex5, grasp_of, posture, damping):
    """Damped least squares never answers more than |dp| / (2 damping)."""
    q = posture.copy()
    q[:3] = 0.0  # straight up: the tip cannot go along the finger
    state = grasp_of(dex5, q)
    twist = (0.0, 0.0, 0.1, 0.0, 0.0, 0.0)
    config = InGraspManipulationConfig.thesis(
        twist=twist, stability_gain=0.0, damping=damping, max_joint_speed=1e3, max_lead=1e3
    )
    change = InGraspManipulation(dex5, config, control_period=PERIOD).act(state)
    assert np.linalg.norm(change[:3]) <= 0.1 * PERIOD / (2 * damping) + 1e-12
    assert np.isfinite(change).all()


def test_speed_limit_scales_the_whole_hand(dex5, grasp_of, posture):
    state = grasp_of(dex5, wiggled(posture, 4))
    fast = (0.0, 0.0, 0.0, 0.0, 0.0, 30.0)
    free = InGraspManipulation(dex5, twist=fast, max_joint_speed=1e3, max_lead=1e3).act(state)
    slow = InGraspManipulation(dex5, twist=fast, max_joint_speed=0.5, max_lead=1e3).act(state)
    assert np.isclose(np.abs(slow).max(), 0.5 * PERIOD)
    np.testing.assert_allclose(slow, free * np.abs(slow).max() / np.abs(free).max(), rtol=1e-9)


def test_lead_and_range_are_kept(dex5, grasp_of, posture):
    state = grasp_of(dex5, posture)
    controller = InGraspManipulation(dex5, twist=(0.0, 0.0, 0.0, 0.0, 0.0, 30.0), max_lead=0.02)
    ahead = replace(state, q_target=state.q + 0.019)
    assert np.abs(ahead.q_target + controller.act(ahead) - state.q).max() <= 0.02 + 1e-12
    q = posture.copy()
    q[::3] = dex5.upper[::3] - 1e-3
    at_end = replace(grasp_of(dex5, q))
    for sign in (1.0, -1.0):
        turning = InGraspManipulation(dex5, twist=(0.0, 0.0, 0.0, 0.0, 0.0, sign * 30.0))
        target = q + turning.act(at_end)
        assert (target <= dex5.upper + 1e-12).all() and (target >= dex5.lower - 1e-12).all()


def test_fingers_out_of_touch_close_in_across_the_axis(dex5, grasp_of, posture):
    state = grasp_of(dex5, wiggled(posture, 5))
    touch = np.array([True, True, True, False, True])
    nan = np.where(touch[:, None], 0.0, np.nan)
    state = replace(state, in_contact=touch, contact_position=state.contact_position + nan)
    controller = InGraspManipulation(dex5, closing_speed=0.03, control_period=PERIOD, **EXACT)
    change = controller.act(state)
    tips = dex5.fingertip_positions(state.q)
    moved = np.einsum("ijk,k->ij", dex5.contact_jacobian(state.q, tips), change)[3]
    across = (tips[3] - state.object_position) * [1.0, 1.0, 0.0]
    np.testing.assert_allclose(
        moved, -0.03 * PERIOD * across / np.linalg.norm(across), rtol=1e-6, atol=1e-9
    )


def test_closing_in_ends_where_the_set_points_are_far_enough_ahead(dex5, grasp_of, posture):
    """Half way there it is half as fast; further ahead than twice as far it goes back as fast."""
    state = grasp_of(dex5, wiggled(posture, 5))
    touch = np.array([True, True, True, False, True])
    state = replace(state, in_contact=touch)
    tips = dex5.fingertip_positions(state.q)
    across = (tips[3] - state.object_position) * [1.0, 1.0, 0.0]
    inward = -across / np.linalg.norm(across)
    jacobian = dex5.contact_jacobian(state.q, tips)[3]
    way = np.linalg.pinv(jacobian) @ inward  # joints that take the tip inward
    for ahead, share in ((0.003, 0.5), (0.006, 0.0), (0.009, -0.5), (0.03, -1.0), (-0.01, 1.0)):
        pressed = replace(state, q_target=state.q + ahead * way)
        for engine in ("plain", "auto"):
            controller = InGraspManipulation(
                dex5, closing_speed=0.03, closing_lead=0.006, engine=engine, **EXACT
            )
            moved = (jacobian @ controller.act(pressed)) / controller.control_period
            np.testing.assert_allclose(moved, share * 0.03 * inward, rtol=1e-5, atol=1e-8)


def test_the_middle_of_the_contacts_stands_in_for_an_untracked_object(dex5, grasp_of, posture):
    """The centre of the smallest ball around them; for the thesis's controller, their centroid."""
    state = grasp_of(dex5, wiggled(posture, 6))
    touch = np.array([True, False, True, True, True])
    points = state.contact_position[touch]
    untracked = replace(state, in_contact=touch, object_position=None, object_quaternion=None)
    for config, centre in (
        (InGraspManipulationConfig(), enclosing_centre(points)),
        (InGraspManipulationConfig.thesis(), points.mean(axis=0)),
    ):
        tracked = replace(untracked, object_position=centre)
        actions = [InGraspManipulation(dex5, config).act(one) for one in (untracked, tracked)]
        np.testing.assert_allclose(actions[0], actions[1], atol=1e-12)


def test_nothing_touches_and_nothing_is_tracked(dex5, grasp_of, posture):
    state = grasp_of(dex5, posture)
    lost = replace(
        state, in_contact=np.zeros(5, bool), object_position=None, object_quaternion=None
    )
    controller = InGraspManipulation(dex5)
    assert np.isfinite(controller.act(lost)).all()
    assert controller.diagnostics["held"] == -1
    assert not InGraspManipulation(dex5, InGraspManipulationConfig.thesis()).act(lost).any()


def test_pushes_lean_towards_the_centre(dex5, grasp_of, posture):
    """With friction the stability motion is along `push_directions`, not along the normals."""
    state = grasp_of(dex5, posture)
    off = replace(state, object_position=state.object_position + np.array([0.01, 0.0, 0.005]))
    controller = InGraspManipulation(
        dex5, twist=STILL, height_gain=0.0, centring_gain=0.0, tilt_gain=0.0, **EXACT
    )
    moved = tip_motion(dex5, off, controller.act(off))
    lever = off.contact_position - off.object_position
    push = push_directions(off.contact_normal, lever, controller.config.friction)
    press = np.sum(moved * push, axis=-1)
    assert np.abs(press).min() > 1e-5
    np.testing.assert_allclose(moved, press[:, None] * push, atol=1e-12)
