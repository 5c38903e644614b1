"""Controllers by name."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import EntryPoint
from typing import Any

import numpy as np
import pytest

import dexctl
from dexctl import controllers
from dexctl.controllers import table


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


ENTRIES = [controllers.entry(name) for name in controllers.names()]
NAMES = [each.name for each in ENTRIES if each.module.startswith("dexctl")]
OWN = [each.name for each in ENTRIES if each.module.startswith("dexctl") and not each.keyword]


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
        return
    assert about_z.config == plain.config
    if name == "switch":
        assert other.config.axis == (0.0, -1.0, 0.0)
        return
    inner = {"igm": lambda config: config, "goal": lambda config: config.gait.in_grasp}
    grasp = inner.get(name, lambda config: config.in_grasp)
    before, after = grasp(plain.config), grasp(other.config)
    assert after.twist == pytest.approx((0.0, 0.0, 0.0, 0.0, -before.twist[5], 0.0))


# -- controllers of other packages --------------------------------------------------------------


class Bare(dexctl.Controller):
    """A plug-in without settings, which turns about z as every controller does by default."""

    made = 0

    def __init__(self, hand: dexctl.HandModel, *, control_period: float = 0.05) -> None:
        super().__init__(hand, control_period=control_period)
        Bare.made += 1

    def reset(self, seed: Any = None, mask: Any = None) -> None:
        pass

    def act(self, state: dexctl.GraspState) -> Any:
        return np.zeros_like(state.q)


class WithOtherConfig(Bare):
    """Its settings know no axis of ours."""

    def __init__(self, hand: dexctl.HandModel, *, control_period: float = 0.05) -> None:
        super().__init__(hand, control_period=control_period)
        self.config = {"speed": 1.0}


class Turned(Bare):
    def __init__(self, hand: dexctl.HandModel, *, axis: Any = (0, 0, 1), **options: Any) -> None:
        super().__init__(hand, **options)
        self.axis = axis


def anything(hand: dexctl.HandModel, **options: Any) -> dexctl.Controller:
    """A plug-in's function that says nothing of what it takes."""
    return Turned(hand, **options)


@pytest.fixture
def plugged(
    monkeypatch: pytest.MonkeyPatch, registered: Callable[..., None]
) -> Callable[[Any], None]:
    """Registers an object as the controller "plugged"."""

    def plug(kind: Any) -> None:
        registered(EntryPoint("plugged", f"{__name__}:_plugged", controllers.GROUP))
        holder = type("Holder", (), {"_plugged": staticmethod(kind)})
        real = table.import_module
        monkeypatch.setattr(
            table, "import_module", lambda name: holder if name == __name__ else real(name)
        )

    return plug


@pytest.mark.parametrize("kind", [Bare, WithOtherConfig])
def test_a_plug_in_that_cannot_be_turned(
    plugged: Callable[[Any], None], dex5: dexctl.HandModel, kind: Any
) -> None:
    plugged(kind)
    for axis in (None, (0.0, 0.0, 1.0), (0, 0, 2)):
        assert isinstance(controllers.make("plugged", dex5, axis=axis), kind)
    for axis in ((0.0, 0.0, -1.0), (1.0, 0.0, 0.0)):
        with pytest.raises(dexctl.InvalidInput, match="'plugged' cannot be turned") as error:
            controllers.make("plugged", dex5, axis=axis)
        assert "\n" not in str(error.value)


def test_a_plug_in_that_takes_an_axis_gets_it(
    plugged: Callable[[Any], None], dex5: dexctl.HandModel
) -> None:
    plugged(Turned)
    made: Any = controllers.make("plugged", dex5, axis=(1.0, 0.0, 0.0), control_period=0.1)
    assert made.axis == (1.0, 0.0, 0.0)
    assert made.control_period == 0.1
    made = controllers.make("plugged", dex5)
    assert made.axis == (0, 0, 1)


def test_a_plug_in_that_does_not_say_what_it_takes(
    plugged: Callable[[Any], None], dex5: dexctl.HandModel
) -> None:
    plugged(anything)
    with pytest.raises(dexctl.InvalidInput, match="cannot be turned"):
        controllers.make("plugged", dex5, axis=(1.0, 0.0, 0.0))


@pytest.mark.parametrize("name", [*OWN, "learned"])
@pytest.mark.parametrize("axis", [(0.0, 0.0, 0.0), (1.0, 0.0), (np.nan, 0, 0), 3])
def test_an_axis_that_is_none_is_an_error(name: str, axis: Any, dex5: dexctl.HandModel) -> None:
    with pytest.raises(dexctl.InvalidInput, match="axis is"):
        controllers.make(name, dex5, axis=axis)


def test_a_policy_turns_about_its_axis_and_its_mirror_image(dex5: dexctl.HandModel) -> None:
    for axis in ((0.0, 0.0, 1.0), (0.0, 0.0, -1.0)):
        made: Any = controllers.make("learned", dex5, axis=axis)
        assert made.axis == axis
    with pytest.raises(
        dexctl.InvalidInput, match=r"axis is \(0, -1, 0\); .* trained to turn about"
    ):
        controllers.make("learned", dex5, axis=(0.0, -1.0, 0.0))


@pytest.mark.parametrize("name", OWN)
def test_an_unknown_keyword_gets_the_known_ones(name: str, dex5: dexctl.HandModel) -> None:
    known = {
        "hold": "axis",
        "igm": "grip_force",
        "switch": "pause",
        "gait": "in_grasp",
        "goal": "gait",
    }
    with pytest.raises(
        dexctl.InvalidInput, match=f"grip_froce.*{known.get(name, 'in_grasp')}"
    ) as error:
        controllers.make(name, dex5, grip_froce=1.0)
    assert "\n" not in str(error.value)


def test_an_unknown_keyword_of_a_plug_in(
    plugged: Callable[[Any], None], dex5: dexctl.HandModel
) -> None:
    plugged(Bare)
    with pytest.raises(dexctl.InvalidInput, match="'plugged' .*speed; known: control_period"):
        controllers.make("plugged", dex5, speed=1.0)


@pytest.mark.parametrize("name", ["igm", "switch", "gait", "coordinated"])
def test_settings_and_axis_together(name: str, dex5: dexctl.HandModel) -> None:
    first: Any = controllers.make(name, dex5)
    changed = type(first.config)()
    made: Any = controllers.make(name, dex5, config=changed, axis=(1.0, 0.0, 0.0))
    assert made.config == changed.about((1.0, 0.0, 0.0)) == changed.about((2.0, 0.0, 0.0))
    assert changed.about((0.0, 0.0, 1.0)) == changed


def test_it_is_built_once(plugged: Callable[[Any], None], dex5: dexctl.HandModel) -> None:
    plugged(Turned)
    before = Bare.made
    controllers.make("plugged", dex5, axis=(1.0, 0.0, 0.0))
    assert Bare.made == before + 1


def test_other_packages_add_theirs(plugged: Callable[[Any], None], dex5: dexctl.HandModel) -> None:
    plugged(Bare)
    assert controllers.names() == (*NAMES, "plugged")
    assert controllers.entry("plugged").title == "plugged"
    assert isinstance(controllers.make("plugged", dex5), Bare)


def test_own_names_cannot_be_taken_over(
    registered: Callable[..., None], dex5: dexctl.HandModel
) -> None:
    registered(EntryPoint("igm", "dexctl.controllers:Hold", controllers.GROUP))
    assert isinstance(controllers.make("igm", dex5), dexctl.InGraspManipulation)
