"""In-grasp manipulation on the simulated hand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dexctl import InGraspManipulation
from dexctl.igm import InGraspManipulationConfig
from dexctl.sim import BatchSimulator, Scene
from dexctl.sim.trial import Trace, run

TURN = (0.0, 0.0, 0.0, 0.0, 0.0, 0.3)


@pytest.fixture(scope="module")
def cylinder() -> Scene:
    return Scene.build("dex5", "cylinder", "down")


def trace(scene: Scene, seconds: float, rate: float = 20.0, **changes) -> Trace:
    sim = BatchSimulator(scene, 4, control_period=1 / rate, substeps=round(200 / rate))
    controller = InGraspManipulation(scene.hand, control_period=1 / rate, **changes)
    return run(controller, sim, seconds)


def height_of(sim: BatchSimulator) -> np.ndarray:
    return np.asarray(sim.read().object_position)[:, 2]


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_turns_the_object_the_way_it_is_asked_to(cylinder, direction):
    found = trace(cylinder, 2.0, twist=tuple(direction * np.array(TURN)))
    assert not found.dropped.any()
    assert (direction * found.final_rotation > 0.35).all()


def test_a_change_of_control_rate_does_not_change_the_motion(cylinder):
    slow, fast = (trace(cylinder, 3.0, rate, twist=TURN) for rate in (20.0, 40.0))
    assert slow.held.all() and fast.held.all()
    np.testing.assert_allclose(fast.final_rotation, slow.final_rotation, rtol=0.08)
    half = slow.rotation[30], fast.rotation[60]
    np.testing.assert_allclose(half[1], half[0], rtol=0.06)


def test_presses_with_the_wanted_force(cylinder):
    """Standing still, the strongest finger settles at the grip force."""
    found = trace(cylinder, 4.0, twist=(0.0,) * 6, grip_force=2.5)
    strongest = found.contact_force[-20:].max(axis=-1).mean(axis=0)
    np.testing.assert_allclose(strongest, 2.5, rtol=0.1)
    assert (found.contact_force[-20:].min(axis=-1) > 0.5 * 2.5 * 0.9).all()


def test_holds_where_touch_counts_from_one_newton_on():
    """Fingers that were asked for less fell out of touch, and the cylinder after them."""
    scene = Scene.build("dex5", "cylinder", "up")
    sim = BatchSimulator(scene, 2, seed=500, touch_threshold=1.0)
    found = run(InGraspManipulation(scene.hand), sim, 30.0)
    assert found.held.all()
    assert (found.final_rotation > 1.5).all()


def test_a_finger_whose_touch_is_not_felt_does_not_push_the_object_away(cylinder):
    """It closes in, is stopped by the object, and presses no harder than its lead says."""
    sim = BatchSimulator(cylinder, 2)
    sim.reset(0)
    start = sim.start_position
    controller = InGraspManipulation(cylinder.hand, twist=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    force = np.zeros(2)
    for _ in range(100):
        state = sim.read()
        force = np.asarray(state.contact_force)[:, 1]
        blind = np.array(state.in_contact)
        blind[:, 1] = False
        sim.write(state.q_target + controller.act(replace(state, in_contact=blind)))
        sim.step()
    assert (force > 0.2).all() and (force < 2.0).all()
    moved = np.asarray(sim.read().object_position) - start
    assert (np.linalg.norm(moved, axis=-1) < 0.003).all()


def test_regulation_brings_a_lifted_object_back(cylinder):
    """The reference is the first state; from then on something else moved the object up."""
    hand = cylinder.hand
    heights = []
    for gain in (1.0, 0.0):
        sim = BatchSimulator(cylinder, 4)
        sim.reset(0)
        back: dict[str, Any] = {"height_gain": gain, "centring_gain": gain, "tilt_gain": gain}
        controller = InGraspManipulation(hand, twist=(0, 0, 0, 0, 0, 0), **back)
        controller.act(sim.read())
        up = InGraspManipulation(hand, twist=(0.0, 0.0, 0.02, 0.0, 0.0, 0.0))
        run(up, sim, 0.5)
        raised = height_of(sim)
        run(controller, sim, 3.0)
        height = height_of(sim)
        assert (raised - sim.start_position[:, 2] > 0.003).all()
        heights.append(np.abs(height - sim.start_position[:, 2]))
    assert (heights[0] < 0.5 * heights[1]).all()


def test_the_thesis_controller_turns_the_object_too(cylinder):
    sim = BatchSimulator(cylinder, 4)
    found = run(InGraspManipulation(cylinder.hand, InGraspManipulationConfig.thesis()), sim, 2.0)
    assert (found.rotation[-1] > 0.2).all()
