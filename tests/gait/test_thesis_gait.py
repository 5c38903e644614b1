"""FingerGaiting: the thesis gait, psi_FG = psi_IGM + psi_CS."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dexctl import FingerGaiting, GraspState
from dexctl.exceptions import InvalidInput
from dexctl.gait import FingerGaitingConfig
from dexctl.igm import InGraspManipulation, InGraspManipulationConfig
from dexctl.sim import BatchSimulator
from dexctl.switch import SwitchProfile


@pytest.fixture(scope="module")
def settled(cylinder) -> GraspState:
    return BatchSimulator(cylinder, 6).read()


def test_it_is_the_superposition_of_its_parts(cylinder, settled):
    """In-grasp manipulation of the fingers that stay, plus the profile of the one that goes."""
    gait = FingerGaiting(cylinder.hand)
    profile = SwitchProfile(cylinder.hand)
    gait.reset(seed=4)
    profile.reset(seed=4)
    held = InGraspManipulation(cylinder.hand, InGraspManipulationConfig.thesis())
    for _ in range(25):
        profile.begin(settled)
        switching, finger = profile.switching, profile.finger
        expected = held.act(settled.without(switching)) + profile.act(settled)
        np.testing.assert_allclose(gait.act(settled), expected, atol=1e-12)
        np.testing.assert_array_equal(gait.diagnostics["finger"], finger)


def test_fingers_switch_at_random_and_one_after_the_other(cylinder, settled):
    gait = FingerGaiting(cylinder.hand, duration=0.5)
    gait.reset(seed=0)
    fingers = []
    for _ in range(200):
        gait.act(settled)
        fingers.append(gait.diagnostics["finger"].copy())
    fingers = np.array(fingers)
    assert (fingers >= 0).all()  # the next one starts as soon as the last is done
    switches = fingers.reshape(20, 10, 6)
    assert (switches == switches[:, :1]).all()  # each takes 0.5 s
    counts = np.bincount(switches[:, 0].ravel(), minlength=5)
    assert counts.min() > 10  # of 120, 24 each on average


def test_it_turns_the_object_somewhat(cylinder, loop):
    sim = BatchSimulator(cylinder, 4)
    found = loop(FingerGaiting(cylinder.hand), sim, 20)
    assert np.isfinite(found.actions).all()
    assert (sim.object_angular_velocity[:, 2] > 0).any()


def test_an_untracked_object_will_do(cylinder, settled):
    gait = FingerGaiting(cylinder.hand)
    unseen = replace(settled, object_position=None, object_quaternion=None)
    for _ in range(3):
        assert np.isfinite(gait.act(unseen)).all()


def test_without_a_rotation_it_switches_about_the_vertical(cylinder, settled):
    still = InGraspManipulationConfig.thesis(twist=(0, 0, 0, 0, 0, 0))
    action = FingerGaiting(cylinder.hand, in_grasp=still).act(settled)
    assert action.any()


def test_nothing_in_touch(cylinder, settled):
    gait = FingerGaiting(cylinder.hand)
    action = gait.act(replace(settled, in_contact=np.zeros((6, 5), bool)))
    assert not action.any() and (gait.diagnostics["finger"] == -1).all()


def test_switches_take_as_long_at_any_control_rate(cylinder, settled):
    """And the finger ends where it would have ended."""
    ends = []
    for period in (0.05, 0.025):
        gait = FingerGaiting(cylinder.hand, duration=1.0, control_period=period)
        gait.reset(seed=1)
        moved = np.zeros((6, 15))
        for _ in range(round(1.0 / period)):
            gait.act(settled)
            moved += gait.diagnostics["switch_action"]
        ends.append(moved)
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-9)
    assert np.abs(ends[0]).max() > 0.04  # the roll joint stays where it was taken


@pytest.mark.parametrize("duration", [0.0, -1.0, np.nan, np.inf, 0.01])
def test_durations_are_checked(dex5, duration):
    with pytest.raises(InvalidInput, match="^duration is"):
        FingerGaiting(dex5, duration=duration)


@pytest.mark.parametrize("speed", [(0.4, 0.1), (-0.1, 0.4), (0.1,), (np.nan, 0.4)], ids=repr)
def test_speeds_are_checked(dex5, speed):
    with pytest.raises(InvalidInput, match="^speed "):
        FingerGaiting(dex5, FingerGaitingConfig(speed=speed))


def test_another_batch_shape_needs_a_reset(cylinder, settled):
    gait = FingerGaiting(cylinder.hand)
    gait.act(settled)
    with pytest.raises(InvalidInput, match="batch shape"):
        gait.act(settled[:2])
    gait.reset()
    assert gait.act(settled[:2]).shape == (2, 15)


@pytest.mark.parametrize("field", ["q", "object_position", "contact_position", "contact_force"])
def test_states_that_are_not_finite_are_refused(cylinder, settled, field):
    gait = FingerGaiting(cylinder.hand)
    gait.act(settled)
    broken = np.array(getattr(settled, field))
    broken[1] = np.nan
    with np.errstate(invalid="ignore"), pytest.raises(InvalidInput, match=r"not finite.*\[1"):
        gait.act(replace(settled, **{field: broken}))
