"""In-grasp manipulation: bad settings and bad states."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dexctl import ContactSwitch, CoordinatedGait, InGraspManipulation
from dexctl.exceptions import InvalidInput
from dexctl.igm import InGraspManipulationConfig

POSITIVE = ("grip_force", "damping", "closing_lead", "max_joint_speed", "max_lead", "length")
NOT_NEGATIVE = (
    "stability_gain", "regulariser", "friction", "height_gain", "centring_gain", "tilt_gain",
    "closing_speed",
)  # fmt: skip
BAD = [float("nan"), float("inf"), -1.0, "fast", True, (1.0,)]


@pytest.mark.parametrize("field", [*POSITIVE, *NOT_NEGATIVE, "min_force"])
@pytest.mark.parametrize("value", BAD, ids=repr)
def test_settings_are_checked(dex5, field, value):
    settings: dict[str, Any] = {field: value}
    with pytest.raises(InvalidInput, match=f"^{field} is .*expected"):
        InGraspManipulationConfig(**settings)
    with pytest.raises(InvalidInput, match=f"^{field} is .*expected"):
        InGraspManipulation(dex5, **{field: value})


@pytest.mark.parametrize("field", POSITIVE)
def test_zero_where_it_makes_no_sense(field):
    settings: dict[str, Any] = {field: 0.0}
    with pytest.raises(InvalidInput, match=f"{field} is 0.0"):
        InGraspManipulationConfig(**settings)


def test_a_share_above_one():
    with pytest.raises(InvalidInput, match="min_force is 1.5; expected a number from 0 to 1"):
        InGraspManipulationConfig(min_force=1.5)


@pytest.mark.parametrize(
    "twist",
    [(0.0,) * 5, (0.0,) * 7, 0.4, None, "z", ("a",) * 6, (0, 0, 0, 0, 0, np.nan), (np.inf,) * 6],
    ids=repr,
)
def test_twists_are_six_finite_numbers(twist):
    with pytest.raises(InvalidInput, match="twist is .* expected six finite numbers"):
        InGraspManipulationConfig(twist=twist)


def test_unknown_settings_are_refused(dex5):
    wrong: dict[str, Any] = {"grip": 2.0}
    with pytest.raises(InvalidInput, match="no setting .grip.; known keywords: .*grip_force"):
        InGraspManipulation(dex5, **wrong)


@pytest.mark.parametrize("period", [0.0, -0.05, float("nan"), float("inf")])
def test_control_periods(dex5, period):
    with pytest.raises(InvalidInput, match="control_period is"):
        InGraspManipulation(dex5, control_period=period)


def test_the_thesis_config_adds_nothing():
    config = InGraspManipulationConfig.thesis(grip_force=1.0)
    off = ("regulariser", "min_force", "friction", "closing_speed")
    gains = ("height_gain", "centring_gain", "tilt_gain")
    assert all(getattr(config, name) == 0.0 for name in (*off, *gains))
    assert config.grip_force == 1.0
    # 0.0225 rad a step of 0.05 s: the paper behind chapter 4
    assert np.isclose(config.twist[5] * 0.05, 0.0225)


READ = ["q", "q_target", "object_position", "contact_position", "contact_force"]


@pytest.mark.parametrize("field", READ)
@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("plain", [False, True], ids=["default", "thesis"])
def test_what_is_not_finite_is_refused_by_name_of_environment(
    dex5, grasp_of, posture, field, value, plain
):
    config = InGraspManipulationConfig.thesis() if plain else InGraspManipulationConfig()
    state = grasp_of(dex5, np.tile(posture, (4, 1)))
    broken = np.array(getattr(state, field))
    broken[2].flat[0] = value
    controller = InGraspManipulation(dex5, config)
    first = controller.act(state)
    with (
        np.errstate(invalid="ignore"),
        pytest.raises(InvalidInput, match=r"not finite.*\[2[\],]"),
    ):
        controller.act(replace(state, **{field: broken}))
    alone = InGraspManipulation(dex5, config)
    with np.errstate(invalid="ignore"), pytest.raises(InvalidInput, match="not finite"):
        alone.act(replace(state, **{field: broken})[2])
    # and the controller is as good as before
    np.testing.assert_allclose(controller.act(state), first, atol=1e-12)


def test_an_attitude_that_is_not_finite(dex5, grasp_of, posture):
    state = grasp_of(dex5, posture)
    controller = InGraspManipulation(dex5)
    controller.act(state)
    with pytest.raises(InvalidInput, match="not finite"):
        controller.act(replace(state, object_quaternion=np.full(4, np.nan)))


@pytest.mark.parametrize("plain", [False, True], ids=["default", "thesis"])
@pytest.mark.parametrize("batch", [(), (2,)])
def test_rows_of_fingers_out_of_touch_are_not_read(dex5, grasp_of, posture, plain, batch):
    config = InGraspManipulationConfig.thesis() if plain else InGraspManipulationConfig()
    state = grasp_of(dex5, np.broadcast_to(posture, (*batch, 15)).copy())
    touch = np.broadcast_to([True, False, True, True, False], (*batch, 5)).copy()
    zero = replace(state, in_contact=touch)
    fields = ("contact_position", "contact_normal", "contact_force")
    broken = {name: np.array(getattr(state, name)) for name in fields}
    for array in broken.values():
        array[~touch] = np.nan
    expected = InGraspManipulation(dex5, config).act(zero)
    np.testing.assert_array_equal(
        InGraspManipulation(dex5, config).act(replace(zero, **broken)), expected
    )


def test_a_state_of_another_hand(dex5, make_hand, bent, grasp_of):
    hand = make_hand((3, 3))
    state = grasp_of(hand, bent(hand, 0))
    with pytest.raises(InvalidInput, match="6 joints and 2 fingers; the hand has 15 joints and 5"):
        InGraspManipulation(dex5).act(state)


def test_a_state_that_is_none(dex5):
    for controller in (InGraspManipulation(dex5), ContactSwitch(dex5), CoordinatedGait(dex5)):
        for state in (None, {}):
            with pytest.raises(InvalidInput, match="state is .*; expected a GraspState"):
                controller.act(state)  # type: ignore[arg-type]


def test_keywords_are_told_once(dex5):
    wrong: dict[str, Any] = {"foo": 1}
    with pytest.raises(InvalidInput) as caught:
        ContactSwitch(dex5, **wrong)
    told = str(caught.value).partition("known keywords: ")[2].split(", ")
    assert "axis" in told and len(told) == len(set(told))
