"""Macro: a twist and at most one switch; references that are given instead of found."""

from __future__ import annotations

import numpy as np
import pytest

from dexctl import CoordinatedGait, InGraspManipulation
from dexctl.exceptions import InvalidInput
from dexctl.gait import Macro, MacroConfig
from dexctl.sim import BatchSimulator, Scene
from dexctl.sim.trial import rotation_about
from dexctl.switch.landing import landing_at, split, turned, unit_across

Z = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def cylinder() -> Scene:
    return Scene.build("dex5", "cylinder", "up")


def test_turns_with_its_twist_and_moves_the_finger_it_is_told(cylinder: Scene) -> None:
    sim = BatchSimulator(cylinder, 3, seed=0, disturbance=0.0)
    start = sim.read()
    assert start.object_position is not None and start.object_quaternion is not None
    twist = np.zeros((3, 6))
    twist[:, 5] = [0.3, -0.3, 0.0]
    finger = np.array([-1, -1, 2])
    tip = sim.hand.fingertip_positions(start.q)[:, 2]
    flat = split(tip - start.object_position, Z)[1]
    radius = np.linalg.norm(flat, axis=-1)
    landing = landing_at(start.object_position, turned(unit_across(flat, Z), -0.3, Z), radius)
    macro = Macro(sim.hand)
    macro.begin(start, twist, finger, landing)
    assert macro.busy.tolist() == [False, False, True]
    lifted = False
    for _ in range(40):
        state = sim.read()
        sim.write(state.q_target + macro.act(state))
        sim.step()
        lifted |= not sim.read().in_contact[2, 2]
    end = sim.read()
    assert end.object_quaternion is not None
    turn = rotation_about(np.stack([start.object_quaternion, end.object_quaternion]))[1]
    assert 0.3 < turn[0] < 0.9 and -0.9 < turn[1] < -0.3 and abs(turn[2]) < 0.1
    assert lifted and not macro.busy.any() and end.in_contact[2].all()
    moved = sim.hand.fingertip_positions(end.q)[2, 2] - tip[2]
    assert moved == pytest.approx(landing.tip[2] - tip[2], abs=0.008)


def test_one_hand_is_a_batch_of_one(cylinder: Scene) -> None:
    sim = BatchSimulator(cylinder, 2, seed=0)
    one, many = Macro(sim.hand), Macro(sim.hand)
    state = sim.read()
    np.testing.assert_array_equal(one.act(state[0]), many.act(state)[0])
    assert one.diagnostics["finger"] == -1


def test_what_macros_refuse(cylinder: Scene) -> None:
    state = BatchSimulator(cylinder, 2, seed=0).read()
    macro = Macro(cylinder.hand)
    with pytest.raises(InvalidInput, match=r"\(6,\) and \(2,\); expected \(2, 6\)"):
        macro.begin(state, np.zeros(6))
    with pytest.raises(InvalidInput, match=r"finger is \[0, 5\]; expected -1 or 0 to 4"):
        macro.begin(state, np.zeros((2, 6)), [0, 5])
    with pytest.raises(InvalidInput, match="friction"):
        MacroConfig(friction=-1.0)


def test_a_given_reference_is_the_one_of_that_reset(cylinder: Scene) -> None:
    """Controllers reset at the root and given its pose later act alike."""
    sim = BatchSimulator(cylinder, 2, seed=0)
    root = sim.read()
    assert root.object_position is not None and root.object_quaternion is not None
    for _ in range(10):
        sim.write(root.q_target + 0.02)
        sim.step()
    later = sim.read()
    for make in (InGraspManipulation, lambda hand: CoordinatedGait(hand, least_travel=9.0)):
        found, given, fresh = (make(sim.hand) for _ in range(3))
        found.reset()
        found.act(root)
        given.reset()
        if isinstance(given, CoordinatedGait):
            given.refer_to(root)
        else:
            given.refer_to(root.object_position, root.object_quaternion)
        np.testing.assert_allclose(given.act(later), found.act(later), atol=1e-12)
        assert np.abs(fresh.act(later) - given.act(later)).max() > 1e-4
    with pytest.raises(InvalidInput, match=r"shapes \(2, 3\) and \(4,\)"):
        InGraspManipulation(sim.hand).refer_to(root.object_position, np.zeros(4))
