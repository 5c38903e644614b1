"""A finger belongs to one part of a gait at a time: the parts' inner product is zero."""

from __future__ import annotations

import numpy as np
import pytest

from dexctl import Controller, FingerGaiting
from dexctl.gait import CoordinatedGait
from dexctl.igm import InGraspManipulationConfig
from dexctl.sim import BatchSimulator
from dexctl.switch import GuardedSwitchConfig, Phase

CLOSING = InGraspManipulationConfig(twist=(0.0, 0.0, 0.0, 0.0, 0.0, 0.35), closing_speed=0.05)
GAITS = {
    "thesis": lambda hand: FingerGaiting(hand, duration=0.6),
    "thesis, closing in": lambda hand: FingerGaiting(hand, duration=0.6, in_grasp=CLOSING),
    "coordinated": lambda hand: CoordinatedGait(hand, least_travel=0.0),
    "coordinated, closing in": lambda hand: CoordinatedGait(
        hand, least_travel=0.0, in_grasp=CLOSING
    ),
    "coordinated, planned": lambda hand: CoordinatedGait(
        hand, least_travel=0.0, switch=GuardedSwitchConfig(path="planned")
    ),
    "coordinated, far": lambda hand: CoordinatedGait(
        hand, least_travel=0.0, switch=GuardedSwitchConfig(far_distance=1e-3)
    ),
}


@pytest.fixture(params=GAITS, scope="module")
def gait(request: pytest.FixtureRequest, cylinder) -> Controller:
    return GAITS[request.param](cylinder.hand)


@pytest.fixture(scope="module")
def found(gait, loop, cylinder):
    gait.reset(seed=2)
    return loop(gait, BatchSimulator(cylinder, 4, seed=2), 160)


def test_their_inner_product_is_zero(found, gait):
    """Exactly, joint by joint: no joint gets motion from both."""
    held, moved = found.of("in_grasp_action"), found.of("switch_action")
    assert not (held * moved).any()
    assert not np.einsum("tni,tni->tn", held, moved).any()
    assert held.any(axis=(0, 2)).all() and moved.any(axis=(0, 2)).all()


def test_the_action_is_their_sum(found):
    total = found.of("in_grasp_action") + found.of("switch_action")
    np.testing.assert_array_equal(np.array(found.actions), total)


def test_each_moves_its_own_fingers_only(found, gait):
    moves, finger = gait.hand.moves, found.of("finger")
    held, moved = found.of("in_grasp_action"), found.of("switch_action")
    if isinstance(gait, CoordinatedGait):
        phase = found.of("phase")
        switching = (phase >= Phase.LIFT) & (phase <= Phase.PLACE)
    else:
        switching = finger >= 0
    assert len(np.unique(finger[switching])) >= 3
    for f in range(gait.hand.n_fingers):
        mine = switching & (finger == f)
        assert not held[mine][:, moves[f]].any()
        assert not moved[~mine][:, moves[f]].any()
        assert not moved[mine][:, ~moves[f]].any()


# the thesis gait has no phases to pass a finger on at
@pytest.mark.parametrize(
    "gait", [name for name in GAITS if "coordinated" in name], indirect=True, scope="module"
)
def test_it_passes_on_at_lift_and_at_touch(found, gait):
    phases = found.of("phase")
    finger = found.of("finger")
    handed = 0
    for before, after in zip(range(len(phases) - 1), range(1, len(phases)), strict=True):
        for env in range(phases.shape[1]):
            one, two = phases[before, env], phases[after, env]
            f = finger[before, env]
            if one == Phase.UNLOAD and two in (Phase.LIFT, Phase.CARRY):
                force = found.states[after].contact_force[env, f]
                assert force < 0.2 or not found.states[after].in_contact[env, f]
            if one == Phase.PLACE and two == Phase.LOAD:
                assert found.states[after].in_contact[env, f]
                assert found.states[after].contact_force[env, f] >= 0.05
                handed += 1
            allowed = {
                Phase.IDLE: {Phase.UNLOAD},
                Phase.UNLOAD: {Phase.LIFT, Phase.CARRY, Phase.LOAD},
                Phase.LIFT: {Phase.CARRY},
                Phase.CARRY: {Phase.PLACE},
                Phase.PLACE: {Phase.LOAD, Phase.IDLE},
                Phase.LOAD: {Phase.IDLE},
            }
            assert two == one or two in allowed[Phase(one)]
    assert handed >= 8
