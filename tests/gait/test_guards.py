"""What controllers refuse, and what a wrist and unread rows must not change."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dexctl import ContactSwitch, FingerGaiting, GraspState, HandModel, InGraspManipulation
from dexctl.exceptions import InvalidInput
from dexctl.gait import CoordinatedGait, FingerGaitingConfig
from dexctl.igm import InGraspManipulationConfig, Share
from dexctl.sim import BatchSimulator
from dexctl.switch import ContactSwitchConfig, GuardedSwitchConfig, Phase


@pytest.fixture(scope="module")
def settled(cylinder) -> GraspState:
    return BatchSimulator(cylinder, 3).read()


@pytest.fixture(scope="module")
def wrist_hand(tmp_path_factory: pytest.TempPathFactory) -> HandModel:
    mass = '<inertial pos="0 0 0" mass="0.01" diaginertia="1e-5 1e-5 1e-5"/>'
    fingers = ""
    for i in range(4):
        x, y = np.cos(np.pi * i / 2), np.sin(np.pi * i / 2)
        flex = f'axis="{-y} {x} 0"/>{mass}'
        fingers += (
            f'<body pos="{0.055 * x} {0.055 * y} 0"><joint name="roll{i}" axis="{x} {y} 0"/>{mass}'
            f'<body pos="0 0 .02"><joint name="mid{i}" {flex}'
            f'<body pos="0 0 .075"><joint name="end{i}" {flex}'
            f'<body name="tip{i}" pos="0 0 .075">{mass}</body></body></body></body>'
        )
    path: Path = tmp_path_factory.mktemp("wrist") / "wrist.xml"
    path.write_text(
        '<mujoco><compiler angle="radian" autolimits="true"/><default><joint range="-2 2"/>'
        f'</default><worldbody><body><joint name="wrist" axis="0 0 1"/>{mass}{fingers}</body>'
        "</worldbody></mujoco>"
    )
    return HandModel.from_mjcf(path, [f"tip{i}" for i in range(4)])


@pytest.fixture
def on_wrist(wrist_hand: HandModel) -> GraspState:
    q = np.array([[0.0, *np.tile([0.0, 0.4, -0.8], 4)]])
    tips = wrist_hand.fingertip_positions(q)
    normal = -tips * np.array([1.0, 1.0, 0.0])
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return GraspState(
        q=q,
        q_target=q + 0.05,
        in_contact=np.ones((1, 4), bool),
        contact_position=tips + 0.014 * normal,
        contact_normal=normal,
        contact_force=np.ones((1, 4)),
        object_position=np.array([[0.0, 0.0, tips[0, 0, 2]]]),
    )


@pytest.mark.parametrize("thesis", [False, True])
def test_a_resting_finger_does_not_make_up_for_the_wrist(wrist_hand, on_wrist, thesis):
    plain = InGraspManipulationConfig(closing_speed=0.0)
    config = InGraspManipulationConfig.thesis() if thesis else plain
    lost = replace(on_wrist, in_contact=np.array([[True, True, True, False]]))
    change = InGraspManipulation(wrist_hand, config).act(lost)
    assert change[0, 0] and not change[0, -3:].any()
    released = Share(released=np.array([[False, False, False, True]]))
    change = InGraspManipulation(wrist_hand).command(on_wrist, released)
    assert change[0, 0] and not change[0, -3:].any()


def test_the_wrist_holds_still_while_a_finger_unloads(wrist_hand, on_wrist):
    controller = ContactSwitch(wrist_hand, kind="guarded")
    change = controller.act(on_wrist)
    assert controller.diagnostics["phase"].tolist() == [Phase.UNLOAD]
    assert change.any() and change[0, 0] == 0.0


@pytest.mark.parametrize("gait", [CoordinatedGait, FingerGaiting])
def test_parts_stay_apart_on_a_wrist(wrist_hand, on_wrist, gait):
    controller = gait(wrist_hand)
    light = replace(on_wrist, contact_force=np.full((1, 4), 0.1))
    for _ in range(30):
        controller.act(light)
        held = controller.diagnostics["in_grasp_action"]
        assert not (held * controller.diagnostics["switch_action"]).any()


def test_a_reset_forgets_the_path_of_a_swing(cylinder, loop):
    """The next switch may be of another finger."""
    switch = GuardedSwitchConfig(far_distance=1e-3)
    controller = CoordinatedGait(cylinder.hand, least_travel=0.0, switch=switch)
    sim = BatchSimulator(cylinder, 2)
    loop(controller, sim, 12)
    assert (controller.diagnostics["phase"] == Phase.CARRY).any()
    both = np.ones(2, bool)
    controller.reset(mask=both)
    sim.reset(seed=0, mask=both)
    again = loop(controller, sim, 60)
    fresh = CoordinatedGait(cylinder.hand, least_travel=0.0, switch=switch)
    sim.reset(seed=0)
    expected = loop(fresh, sim, 60)
    np.testing.assert_array_equal(again.actions, expected.actions)


@pytest.mark.parametrize("engine", ["auto", "plain"])
def test_normals_that_are_not_numbers(dex5, settled, engine):
    broken = settled.contact_normal.copy()
    broken[1, 0] = np.nan
    with (
        np.errstate(invalid="ignore"),
        pytest.raises(InvalidInput, match=r"not finite in environments \[1\]"),
    ):
        InGraspManipulation(dex5, engine=engine).act(replace(settled, contact_normal=broken))


FIELDS = ("q", "object_position", "contact_position", "contact_normal", "contact_force")


@pytest.mark.parametrize("kind", ["profile", "guarded"])
@pytest.mark.parametrize("field", FIELDS)
def test_contact_switching_refuses_what_is_not_finite(dex5, settled, kind, field):
    controller = ContactSwitch(dex5, kind=kind)
    controller.act(settled)
    broken = np.array(getattr(settled, field))
    broken[1] = np.nan
    with pytest.raises(InvalidInput, match=r"not finite in environments \[1\]"):
        controller.act(replace(settled, **{field: broken}))


def test_a_finger_that_loads_out_of_touch_reads_nothing(dex5, settled):
    controller = ContactSwitch(dex5, kind="guarded")
    controller.act(settled)
    touch = np.ones((3, 5), bool)
    for row, f in enumerate(controller.diagnostics["finger"]):
        touch[row, [f, (f + 1) % 5, (f + 2) % 5]] = False  # no closure: it is loaded again
    rows = {}
    for name in ("contact_position", "contact_normal", "contact_force"):
        rows[name] = np.array(getattr(settled, name))
        rows[name][~touch] = np.nan
    seen = set()
    for _ in range(12):
        action = controller.act(replace(settled, in_contact=touch, **rows))
        assert np.isfinite(action).all()
        seen |= set(controller.diagnostics["phase"].tolist())
    assert Phase.LOAD in seen


MASKS = [np.ones(2, bool), np.ones(4, bool), "abc", [1, 2, 0], np.ones((3, 1), bool)]


@pytest.mark.parametrize("mask", MASKS, ids=str)
def test_masks_are_bools_one_for_each(make, cylinder, settled, mask):
    controller: Callable = make(cylinder.hand)
    controller.act(settled)
    with pytest.raises(InvalidInput, match="mask has shape|batch shape"):
        controller.reset(mask=mask)


@pytest.mark.parametrize("period", ["fast", None, (0.05,)], ids=repr)
def test_control_periods_are_numbers(make, cylinder, period):
    with pytest.raises(InvalidInput, match="control_period is"):
        make(cylinder.hand, control_period=period)


def test_one_leading_dimension_at_most(make, cylinder, settled):
    with pytest.raises(InvalidInput, match=r"batch shape \(1, 3\); expected \(\) or \(N,\)"):
        make(cylinder.hand).act(settled[None])


def test_settings_of_the_wrong_kind(dex5):
    for axis in (10**400, 1j, np.ones(3) + 0j, {}):
        with pytest.raises(InvalidInput, match="^axis is .*; expected three finite numbers"):
            FingerGaiting(dex5, axis=axis)  # type: ignore[arg-type]
    with pytest.raises(InvalidInput, match="^axis is"):
        ContactSwitchConfig(axis=("a", "b", "c"))  # type: ignore[arg-type]
    with pytest.raises(InvalidInput, match="^switch is 3; expected a GuardedSwitchConfig"):
        ContactSwitchConfig(switch=3)  # type: ignore[arg-type]
    with pytest.raises(InvalidInput, match="^switch is 3; expected a GuardedSwitchConfig"):
        CoordinatedGait(dex5, switch=3)  # type: ignore[arg-type]
    for gait in (FingerGaiting, CoordinatedGait):
        with pytest.raises(InvalidInput, match="^in_grasp is 3; expected an InGrasp|a InGrasp"):
            gait(dex5, in_grasp=3)  # type: ignore[arg-type]
    for duration in ("long", True, None):
        with pytest.raises(InvalidInput, match="^duration is"):
            FingerGaitingConfig(duration=duration)  # type: ignore[arg-type]
    for speed in ("fast", ("a", "b"), None):
        with pytest.raises(InvalidInput, match="^speed is"):
            ContactSwitch(dex5, speed=speed)  # type: ignore[arg-type]
    with pytest.raises(InvalidInput, match="time_limit is 0.2 s; expected more than unload_time"):
        GuardedSwitchConfig(time_limit=0.2)
