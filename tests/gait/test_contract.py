"""What every controller promises: batches, seeds, resets, checkpoints, replays."""

from __future__ import annotations

import copy
import hashlib
import json
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dexctl import Controller
from dexctl.exceptions import InvalidInput
from dexctl.sim import BatchSimulator, Scene

ROOT = Path(__file__).resolve().parents[2]
COUNT, STEPS, SEED = 7, 40, 11


@pytest.fixture(scope="session")
def together(make, loop, cylinder):
    """Seven hands under one controller, for 40 steps."""
    controller = make(cylinder.hand)
    controller.reset(seed=SEED)
    return loop(controller, BatchSimulator(cylinder, COUNT, seed=SEED), STEPS)


def test_it_does_something_to_every_hand(together):
    assert np.any(together.actions, axis=(0, 2)).all()


@pytest.mark.parametrize("row", [0, 3, COUNT - 1])
def test_each_of_a_batch_acts_as_it_would_alone(make, cylinder, together, row):
    """One hand (), and a batch of one, with the seed that belongs to it."""
    single, one = make(cylinder.hand), make(cylinder.hand)
    for controller in (single, one):
        controller.reset(seed=SEED + row)
    for step, (state, action) in enumerate(zip(together.states, together.actions, strict=True)):
        alone = single.act(state[row])
        assert alone.shape == (15,)
        np.testing.assert_allclose(alone, action[row], atol=1e-8)
        if row in (0, COUNT - 1):
            np.testing.assert_allclose(one.act(state[[row]])[0], action[row], atol=1e-8)
        for name, value in single.diagnostics.items():
            expected = together.diagnostics[step][name][row]
            assert np.shape(value) == expected.shape
            np.testing.assert_allclose(value, expected, atol=1e-7, err_msg=name)


def test_a_hand_alone_in_its_own_simulator(make, loop, cylinder, together):
    """The whole loop, not only the controller: small differences have time to grow."""
    for row in (0, 5):
        controller = make(cylinder.hand)
        controller.reset(seed=SEED + row)
        sim = BatchSimulator(cylinder, None, seed=SEED + row, threads=1)
        alone = loop(controller, sim, STEPS)
        for mine, theirs in zip(alone.actions, together.actions, strict=True):
            np.testing.assert_allclose(mine, theirs[row], atol=1e-5)


def test_seeds_may_be_given_one_by_one(make, cylinder, together):
    controller = make(cylinder.hand)
    controller.reset(seed=SEED + np.arange(COUNT))
    for state, action in zip(together.states, together.actions, strict=True):
        np.testing.assert_array_equal(controller.act(state), action)


def test_resetting_some_leaves_the_others_alone(make, cylinder, together):
    chosen = np.zeros(COUNT, bool)
    chosen[[1, 4]] = True
    controller, fresh = make(cylinder.hand), make(cylinder.hand)
    controller.reset(seed=SEED)
    fresh.reset(seed=99)
    for step, (state, action) in enumerate(zip(together.states, together.actions, strict=True)):
        if step == 20:
            controller.reset(seed=99, mask=chosen)
        found = controller.act(state)
        np.testing.assert_allclose(found[~chosen], action[~chosen], atol=1e-12)
        if step < 20:
            np.testing.assert_array_equal(found, action)
        else:
            np.testing.assert_allclose(found[chosen], fresh.act(state)[chosen], atol=1e-12)


def test_reset_starts_all_anew_and_lets_the_batch_change(make, cylinder, together):
    controller = make(cylinder.hand)
    controller.reset(seed=SEED)
    for state in together.states:
        controller.act(state)
    controller.reset(seed=SEED + 2)
    for state, action in zip(together.states, together.actions, strict=True):
        np.testing.assert_allclose(controller.act(state[2:4]), action[2:4], atol=1e-8)
    controller.reset(seed=SEED + 6)
    for state, action in zip(together.states, together.actions, strict=True):
        np.testing.assert_allclose(controller.act(state[6]), action[6], atol=1e-8)


def test_the_same_seed_gives_the_same_bits(make, loop, cylinder, together):
    controller = make(cylinder.hand)
    controller.reset(seed=SEED)
    again = loop(controller, BatchSimulator(cylinder, COUNT, seed=SEED, threads=1), STEPS)
    for mine, first in zip(again.actions, together.actions, strict=True):
        np.testing.assert_array_equal(mine, first)


@pytest.mark.parametrize("kind", [pytest.param("deepcopy", marks=pytest.mark.slow), "pickle"])
def test_a_checkpoint_continues_to_the_bit(make, loop, cylinder, kind):
    """Simulator saved and restored, controller copied in the middle of what it does."""
    controller = make(cylinder.hand)
    controller.reset(seed=3)
    sim = BatchSimulator(cylinder, 3, seed=3)
    loop(controller, sim, 17)
    saved = sim.save()
    twin = (
        copy.deepcopy(controller) if kind == "deepcopy" else pickle.loads(pickle.dumps(controller))
    )
    first = loop(controller, sim, 40)
    sim.restore(saved)
    second = loop(twin, sim, 40)
    for one, other in zip(first.actions, second.actions, strict=True):
        np.testing.assert_array_equal(one, other)
    for name in ("q", "object_position", "contact_force"):
        last = (getattr(run.states[-1], name) for run in (first, second))
        np.testing.assert_array_equal(*last)


def test_acting_changes_nothing_of_the_state(make, cylinder, together):
    controller = make(cylinder.hand)
    state = copy.deepcopy(together.states[5])
    for _ in range(3):
        controller.act(state)
    for name in state.__dataclass_fields__:
        before = getattr(together.states[5], name)
        np.testing.assert_array_equal(getattr(state, name), before, err_msg=name)


def test_diagnostics_are_of_the_last_act_and_cannot_be_changed(make, cylinder, together):
    controller = make(cylinder.hand)
    controller.act(together.states[0])
    found = controller.diagnostics
    assert all(np.shape(value)[:1] == (COUNT,) for value in found.values())
    with pytest.raises(TypeError):
        found["finger"] = 0


def test_a_state_of_another_hand(make, cylinder, together):
    state = together.states[0][0]
    q = np.zeros(16)
    other = type(state)(
        q=q,
        q_target=q,
        in_contact=np.zeros(4, bool),
        contact_position=np.zeros((4, 3)),
        contact_normal=np.zeros((4, 3)),
        contact_force=np.zeros(4),
    )
    with pytest.raises(InvalidInput, match="16 joints and 4 fingers; the hand has 15 joints and 5"):
        make(cylinder.hand).act(other)


@pytest.mark.parametrize("period", [0.0, -0.05, float("nan"), float("inf")])
def test_control_periods(make, cylinder, period):
    with pytest.raises(InvalidInput, match="control_period is"):
        make(cylinder.hand, control_period=period)


def test_fingers_out_of_touch_are_not_read(make, cylinder, together):
    """Their rows may hold anything, for as long as a switch takes."""
    state = together.states[0]
    touch = np.ones((COUNT, 5), bool)
    touch[:, 2] = False
    actions = []
    for fill in (0.0, np.nan):
        rows = {}
        for name in ("contact_position", "contact_normal", "contact_force"):
            rows[name] = np.array(getattr(state, name))
            rows[name][:, 2] = fill
        lost = type(state)(
            **{n: getattr(state, n) for n in state.__dataclass_fields__}
            | {"in_contact": touch, **rows}
        )
        controller = make(cylinder.hand)
        controller.reset(seed=0)
        controller.act(lost)
        actions.append(np.array([controller.act(lost) for _ in range(50)]))
    np.testing.assert_array_equal(*actions)


# -- another process ----------------------------------------------------------------------------


def fingerprints(makers: dict[str, Callable[..., Controller]], scene: Scene) -> dict[str, str]:
    """A hash over all bits that each controller sends in 40 steps with three hands."""
    found = {}
    for name, maker in makers.items():
        sim, controller = BatchSimulator(scene, 3, seed=5), maker(scene.hand)
        controller.reset(seed=5)
        digest = hashlib.sha256()
        for _ in range(40):
            state = sim.read()
            sim.write(state.q_target + controller.act(state))
            digest.update(sim.read().q_target.tobytes())
            sim.step()
        found[name] = digest.hexdigest()
    return found


SCRIPT = """
import importlib.util, json, sys

def load(path):
    spec = importlib.util.spec_from_file_location("loaded_" + path.split("/")[-1][:-3], path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module

from dexctl.sim import Scene
conftest, contract = map(load, sys.argv[1:])
scene = Scene.build("dex5", "cylinder", "down")
print(json.dumps(contract.fingerprints(conftest.CONTROLLERS, scene)))
"""


def test_another_process_gives_the_same_bits(makers, cylinder):
    """All controllers at once: a process takes longer to start than they take."""
    files = [str(Path(__file__).with_name("conftest.py")), __file__]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, *files],
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1]) == fingerprints(makers, cylinder)
