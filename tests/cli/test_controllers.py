"""Controllers by name."""

from __future__ import annotations

from importlib.metadata import EntryPoint
from typing import Any

import numpy as np
import pytest

import dexctl
from dexctl import controllers


def state_of(hand: dexctl.HandModel, batch: tuple[int, ...] = ()) -> dexctl.GraspState:
    m = hand.n_fingers
    return dexctl.GraspState(
        q=np.zeros((*batch, hand.nq)),
        q_target=np.full((*batch, hand.nq), 0.1),
        in_contact=np.zeros((*batch, m), bool),
        contact_position=np.zeros((*batch, m, 3)),
        contact_normal=np.zeros((*batch, m, 3)),
        contact_force=np.zeros((*batch, m)),
    )


OWN = [name for name in controllers.names() if controllers.entry(name).module.startswith("dexctl")]


@pytest.mark.parametrize("name", OWN)
def test_each_name_makes_its_controller(name: str, dex5: dexctl.HandModel) -> None:
    controller = controllers.make(name, dex5, control_period=0.02)
    assert isinstance(controller, dexctl.Controller)
    assert type(controller).__name__ == controllers.entry(name).attribute
    assert controller.control_period == 0.02
    assert controller.hand is dex5


def test_options_reach_the_controller(dex5: dexctl.HandModel) -> None:
    controller = controllers.make("igm", dex5, grip_force=1.5)
    assert isinstance(controller, dexctl.InGraspManipulation)
    assert controller.config.grip_force == 1.5


@pytest.mark.parametrize("batch", [(), (3,)])
def test_hold_keeps_the_set_points(dex5: dexctl.HandModel, batch: tuple[int, ...]) -> None:
    hold = controllers.make("hold", dex5)
    hold.reset(seed=1)
    change = hold.act(state_of(dex5, batch))
    assert change.shape == (*batch, 15)
    assert not change.any()


def test_an_unknown_name_gets_the_known_ones(dex5: dexctl.HandModel) -> None:
    with pytest.raises(dexctl.UnknownName, match="'walk'; known: igm, switch, gait, coordinated"):
        controllers.make("walk", dex5)


def test_a_bad_option_is_named(dex5: dexctl.HandModel) -> None:
    with pytest.raises(dexctl.InvalidInput, match="grip_force is -1"):
        controllers.make("igm", dex5, grip_force=-1)


@pytest.mark.parametrize("name", OWN)
def test_an_axis_turns_them_with_the_same_speed(name: str, dex5: dexctl.HandModel) -> None:
    plain: Any = controllers.make(name, dex5)
    about_z: Any = controllers.make(name, dex5, axis=(0.0, 0.0, 1.0))
    other: Any = controllers.make(name, dex5, axis=(0.0, -1.0, 0.0))
    if name == "hold":
        assert not hasattr(other, "config")
        return
    assert about_z.config == plain.config
    if name == "switch":
        assert other.config.axis == (0.0, -1.0, 0.0)
        return
    grasp = {"igm": lambda config: config}.get(name, lambda config: config.in_grasp)
    before, after = grasp(plain.config), grasp(other.config)
    assert after.twist == pytest.approx((0.0, 0.0, 0.0, 0.0, -before.twist[5], 0.0))


def test_other_packages_add_theirs(dex5: dexctl.HandModel, monkeypatch: pytest.MonkeyPatch) -> None:
    points = [
        EntryPoint("in_place", "dexctl.controllers:Hold", controllers.GROUP),
        EntryPoint("igm", "dexctl.controllers:Hold", controllers.GROUP),  # taken
    ]
    monkeypatch.setattr(controllers, "entry_points", lambda group: points)
    controllers._known.cache_clear()
    try:
        assert controllers.names() == (*OWN, "in_place")
        assert controllers.entry("in_place").title == "in place"
        assert isinstance(controllers.make("in_place", dex5), controllers.Hold)
        assert isinstance(controllers.make("igm", dex5), dexctl.InGraspManipulation)
    finally:
        controllers._known.cache_clear()
