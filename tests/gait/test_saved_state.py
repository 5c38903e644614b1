"""Controllers continue from what `state_dict` gave, to the bit; and refuse what is not theirs."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from dexctl import Controller, HandModel, InvalidInput, Superposition
from dexctl.controllers import Hold
from dexctl.sim import BatchSimulator, Scene

COUNT, BEFORE, AFTER = 3, 25, 15


def through_a_file(value: Any) -> Any:
    """What a file of JSON and npz gives back; fails on anything but data."""
    if isinstance(value, dict):
        assert all(isinstance(name, str) for name in value)
        return {name: through_a_file(part) for name, part in value.items()}
    if isinstance(value, np.ndarray):
        file = io.BytesIO()
        np.save(file, value, allow_pickle=False)
        file.seek(0)
        return np.load(file, allow_pickle=False)
    assert value is None or type(value) in (bool, int, float, str)
    return json.loads(json.dumps(value))


@pytest.fixture(scope="session")
def all_makers(makers) -> dict[str, Callable[[HandModel], Controller]]:
    def superposed(hand: HandModel) -> Controller:
        return Superposition([makers["in-grasp"](hand), makers["switch, profile"](hand)])

    return {**makers, "hold": Hold, "superposed": superposed}


NAMES = (
    "in-grasp", "in-grasp, thesis", "switch, profile", "switch, guarded", "gait, random",
    "gait, coordinated", "gait, goal", "gait, steered", "gait, pursuit", "gait, sequence",
    "gait, commanded", "gait, regulated", "gait, tracked by touch", "gait, planned",
    "tree followed", "hold", "superposed",
)  # fmt: skip


def test_all_of_them_are_tested(all_makers):
    assert set(NAMES) == set(all_makers)


@pytest.mark.parametrize("tracked", [True, False], ids=["tracked", "untracked"])
@pytest.mark.parametrize("name", NAMES)
def test_continues_to_the_bit(all_makers, loop, cube: Scene, name: str, tracked: bool):
    def see(state):
        without = {"object_position": None, "object_quaternion": None}
        fields = {n: getattr(state, n) for n in state.__dataclass_fields__}
        return state if tracked else type(state)(**fields | without)

    controller, again = all_makers[name](cube.hand), all_makers[name](cube.hand)
    if controller.tracks and not tracked:
        pytest.skip("it refuses an object that nothing tracks")
    controller.reset(seed=2**70)
    with BatchSimulator(cube, COUNT, seed=4) as sim:
        loop(controller, sim, BEFORE, see)
        saved = through_a_file(controller.state_dict())
        where = sim.save()
        first = loop(controller, sim, AFTER, see)
        sim.restore(where)
        again.load_state_dict(saved)
        second = loop(again, sim, AFTER, see)
        np.testing.assert_array_equal(first.actions, second.actions)
        # and what was loaded is not changed by use
        sim.restore(where)
        again.reset()
        again.load_state_dict(saved)
        np.testing.assert_array_equal(loop(again, sim, AFTER, see).actions, first.actions)
        # a reset without a seed lets the random streams go on from the same place
        sim.restore(where)
        controller.load_state_dict(saved)
        again.load_state_dict(saved)
        actions = []
        for one in (controller, again):
            sim.restore(where)
            one.reset(mask=np.array([True, False, True]))
            actions.append(loop(one, sim, AFTER, see).actions)
        np.testing.assert_array_equal(*actions)


@pytest.mark.parametrize("name", NAMES)
def test_one_that_has_not_acted_keeps_its_seed(all_makers, loop, cube: Scene, name: str):
    controller, again = all_makers[name](cube.hand), all_makers[name](cube.hand)
    controller.reset(seed=[5, -7])
    again.load_state_dict(through_a_file(controller.state_dict()))
    with BatchSimulator(cube, 2, seed=1) as sim:
        where = sim.save()
        first = loop(controller, sim, AFTER)
        sim.restore(where)
        np.testing.assert_array_equal(loop(again, sim, AFTER).actions, first.actions)


@pytest.fixture(scope="session")
def saved(all_makers, loop, cube: Scene) -> dict[str, dict[str, Any]]:
    """A state of each controller, of three hands."""
    found = {}
    for name, maker in all_makers.items():
        controller = maker(cube.hand)
        with BatchSimulator(cube, COUNT, seed=4) as sim:
            loop(controller, sim, 8)
        found[name] = controller.state_dict()
    return found


def one_line(call: Callable[[], object], match: str) -> None:
    with pytest.raises(InvalidInput, match=match) as error:
        call()
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", NAMES)
def test_refuses_a_state_of_another_controller(all_makers, saved, cube: Scene, name: str):
    controller = all_makers[name](cube.hand)
    own = saved[name]["controller"]
    for other, state in saved.items():
        if state["controller"] != own:
            one_line(lambda state=state: controller.load_state_dict(state), "has controller")
        elif set(state) != set(saved[name]):
            one_line(lambda state=state: controller.load_state_dict(state), "holds .*expected")
        else:
            assert other.split(",")[0] == name.split(",")[0]
    for wrong in (None, [], {}, {"controller": own}, {**saved[name], "more": 1}):
        one_line(lambda wrong=wrong: controller.load_state_dict(wrong), "saved state")


@pytest.mark.parametrize("name", NAMES)
def test_refuses_a_state_of_another_hand(all_makers, saved, cube: Scene, make_other, name: str):
    one_line(lambda: all_makers[name](make_other).load_state_dict(saved[name]), "joints")


@pytest.fixture(scope="session")
def make_other(cube: Scene) -> HandModel:
    """The same hand with one finger less."""
    return HandModel.from_mjcf(cube.hand.path, cube.hand.fingertip_names[:-1])


@pytest.mark.parametrize("name", [name for name in NAMES if name != "hold"])
def test_refuses_a_state_of_another_batch(all_makers, saved, loop, cube: Scene, name: str):
    controller = all_makers[name](cube.hand)
    with BatchSimulator(cube, 2, seed=4) as sim:
        loop(controller, sim, 8)
        one_line(lambda: controller.load_state_dict(saved[name]), "reset")
        controller.reset()
        controller.load_state_dict(saved[name])
        one_line(lambda: loop(controller, sim, 1), "reset")


@pytest.mark.parametrize("name", NAMES)
def test_refuses_what_has_been_tampered_with(all_makers, saved, cube: Scene, name: str):
    """Every part of it: missing, cut short, and of another kind."""
    controller = all_makers[name](cube.hand)
    tampered = list(spoilt(saved[name]))
    for state in tampered:
        controller.reset()
        one_line(lambda state=state: controller.load_state_dict(state), "saved")
    assert tampered


def spoilt(state: dict[str, Any]):
    for name, value in state.items():
        if isinstance(value, str | dict):
            for wrong in (np.zeros(3), [[1.0], [2.0, 3.0]], {"3": None}):
                yield {**state, name: wrong}
        if isinstance(value, dict):
            for part in spoilt(value):
                yield {**state, name: part}
        elif isinstance(value, np.ndarray) and name != "seed":
            for wrong in (None, [[1.0], [2.0, 3.0]], np.zeros(()), np.zeros((1, 2, 5, 1))):
                yield {**state, name: wrong}
            yield {**state, name: value.astype(complex)}
        if not name.isdigit():  # one row of the paths: with fewer, a state is as whole
            yield {other: state[other] for other in state if other != name}


def test_controllers_without_a_state_say_so(dex5: HandModel):
    class Own(Controller):
        def reset(self, seed=None, mask=None):
            pass

        def act(self, state):
            return state.q

    with pytest.raises(NotImplementedError, match="Own does not give its state"):
        Own(dex5).state_dict()
    with pytest.raises(NotImplementedError, match="Own cannot continue"):
        Own(dex5).load_state_dict({})
