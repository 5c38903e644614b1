"""ContactSwitch: both kinds, by itself on the simulated hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dexctl import ContactSwitch, GraspState
from dexctl.exceptions import InvalidInput
from dexctl.grasp import is_force_closure
from dexctl.sim import BatchSimulator, Scene
from dexctl.sim.trial import Trace, run
from dexctl.switch import ContactSwitchConfig, GuardedSwitchConfig, Phase, SwitchProfile


@pytest.fixture(scope="module")
def cylinder() -> Scene:
    return Scene.build("dex5", "cylinder", "down")


@pytest.fixture(scope="module")
def settled(cylinder: Scene) -> GraspState:
    return BatchSimulator(cylinder, 6).read()


def trace(scene: Scene, seconds: float, rate: float = 20.0, **changes) -> Trace:
    sim = BatchSimulator(scene, 4, control_period=1 / rate, substeps=round(200 / rate))
    controller = ContactSwitch(scene.hand, control_period=1 / rate, **changes)
    controller.reset(seed=3)
    return run(controller, sim, seconds)


def starts(found: Trace, phase: Phase) -> np.ndarray:
    """(step, environment) of every time that ``phase`` began."""
    phases = found.diagnostics["phase"]
    return np.argwhere((phases[1:] == phase) & (phases[:-1] != phase)) + np.array([1, 0])


@pytest.mark.parametrize("path", ["jacobian", "planned"])
def test_guarded_switches_go_round_and_end_with_touch(cylinder, path):
    found = trace(cylinder, 6.0, kind="guarded", switch=GuardedSwitchConfig(path=path))
    assert len(starts(found, Phase.LOAD)) >= 8
    finger = found.diagnostics["finger"]
    used = {f for f in np.unique(finger).tolist() if f >= 0}
    assert len(used) >= 3  # at random
    for step, env in starts(found, Phase.LOAD):
        f = finger[step, env]
        if found.diagnostics["phase"][step - 1, env] == Phase.PLACE:
            assert found.in_contact[step, env, f]
            assert found.contact_force[step, env, f] >= 0.05


def test_a_guarded_switch_lifts_only_where_the_others_hold(cylinder):
    found = trace(cylinder, 6.0, kind="guarded")
    lifts = starts(found, Phase.LIFT)
    assert len(lifts) >= 8
    for step, env in lifts:
        others = found.in_contact[step, env].copy()
        others[found.diagnostics["finger"][step, env]] = False
        assert is_force_closure(
            found.contact_position[step, env],
            found.contact_normal[step, env],
            others,
            found.object_position[step, env],
            0.8,
        )


def test_no_switch_where_the_others_would_not_hold(cylinder):
    found = trace(cylinder, 2.0, kind="guarded", friction=1e-6)
    assert not found.diagnostics["phase"].any() and not np.diff(found.q_target, axis=0).any()


@pytest.mark.parametrize("kind", ["profile", "guarded"])
def test_the_other_fingers_get_exactly_nothing(cylinder, kind):
    found = trace(cylinder, 3.0, kind=kind)
    sent = np.diff(found.q_target, axis=0)
    finger = found.diagnostics["finger"]
    moves = cylinder.hand.moves
    # the guarded switch names the finger after its last command; the profile before it
    for f in range(5):
        mine = finger == f
        others = ~moves[f]
        assert np.abs(sent[mine][:, others]).max(initial=0.0) < 1e-15
        assert np.abs(sent[mine][:, moves[f]]).max(initial=0.0) > 0.0 or not mine.any()


def test_pauses_between_guarded_switches(cylinder):
    found = trace(cylinder, 6.0, kind="guarded", pause=0.5)
    phases = found.diagnostics["phase"]
    for env in range(4):
        idle = phases[:, env] == Phase.IDLE
        ends = np.flatnonzero(idle[1:] & ~idle[:-1]) + 1
        begins = np.flatnonzero(~idle[1:] & idle[:-1]) + 1
        for end in ends:
            later = begins[begins > end]
            if len(later):
                assert (later[0] - end) * 0.05 >= 0.5 - 0.05 - 1e-9


def test_a_guarded_switch_needs_four_in_touch(cylinder, settled):
    controller = ContactSwitch(cylinder.hand, kind="guarded")
    touch = np.ones((6, 5), bool)
    touch[:3, :2] = False
    controller.act(replace(settled, in_contact=touch))
    phase = controller.diagnostics["phase"]
    assert not phase[:3].any() and (phase[3:] == Phase.UNLOAD).all()


def test_closure_lost_while_unloading_is_noticed(cylinder, settled):
    """Three others touch when it begins to unload, but two when it is about to lift."""
    controller = ContactSwitch(cylinder.hand, kind="guarded", pause=10.0)
    controller.act(settled)
    fingers = controller.diagnostics["finger"]
    touch = np.zeros((6, 5), bool)
    for row, finger in enumerate(fingers):
        touch[row, [finger, (finger + 1) % 5, (finger + 2) % 5]] = True
    lost = replace(settled, in_contact=touch, contact_force=np.full((6, 5), 0.1))
    seen = set()
    for _ in range(30):
        controller.act(lost)
        seen |= set(controller.diagnostics["phase"].tolist())
    assert seen == {Phase.UNLOAD, Phase.LOAD, Phase.IDLE}


def test_the_profile_kind_is_the_thesis_profile(cylinder, settled):
    controller = ContactSwitch(cylinder.hand, duration=0.8, speed=(0.2, 0.3))
    profile = SwitchProfile(cylinder.hand, duration=0.8, speed=(0.2, 0.3))
    controller.reset(seed=5)
    profile.reset(seed=5)
    for _ in range(40):
        profile.begin(settled)
        finger = profile.finger
        np.testing.assert_array_equal(controller.act(settled), profile.act(settled))
        np.testing.assert_array_equal(controller.diagnostics["finger"], finger)


@pytest.mark.parametrize("kind", ["profile", "guarded"])
def test_the_length_of_the_axis_does_not_matter(cylinder, settled, kind):
    actions = []
    for axis in ((0.0, 0.0, 1.0), (0.0, 0.0, 7.0)):
        controller = ContactSwitch(cylinder.hand, kind=kind, axis=axis)
        actions.append([controller.act(settled) for _ in range(12)])
    np.testing.assert_allclose(*actions, atol=1e-12)


@pytest.mark.parametrize("kind", ["profile", "guarded"])
def test_an_untracked_object_will_do(cylinder, kind):
    sim = BatchSimulator(cylinder, 2)
    controller = ContactSwitch(cylinder.hand, kind=kind)
    controller.reset(seed=0)
    switched = 0
    for _ in range(60):
        state = replace(sim.read(), object_position=None, object_quaternion=None)
        sim.write(state.q_target + controller.act(state))
        sim.step()
        switched += int((controller.diagnostics["finger"] >= 0).sum())
    assert switched > 60
    away = np.asarray(sim.read().object_position) - sim.start_position
    assert (np.linalg.norm(away, axis=-1) < 0.05).all()


def test_seeds_choose_the_fingers(cylinder, settled):
    def fingers(seed: int) -> list[int]:
        controller = ContactSwitch(cylinder.hand, kind="guarded")
        controller.reset(seed=seed)
        controller.act(settled)
        return controller.diagnostics["finger"].tolist()

    assert fingers(0) == fingers(0)
    assert fingers(1)[:-1] == fingers(0)[1:]  # environment i has the stream of seed + i
    assert len({tuple(fingers(seed)) for seed in range(0, 60, 10)}) > 1


# -- settings -----------------------------------------------------------------------------------

BAD = [np.nan, np.inf, -1.0, "much", None, True]


@pytest.mark.parametrize(
    "field", ["duration", "friction", "hold_force", "stability_gain", "swing", "pause"]
)
@pytest.mark.parametrize("value", BAD, ids=repr)
def test_settings_are_checked(dex5, field, value):
    with pytest.raises(InvalidInput, match=f"^{field} is .*expected"):
        ContactSwitchConfig(**{field: value})
    with pytest.raises(InvalidInput, match=f"^{field} is .*expected"):
        ContactSwitch(dex5, **{field: value})


@pytest.mark.parametrize("kind", ["fixed", "", None, 1], ids=repr)
def test_unknown_kinds_list_the_known_ones(kind):
    with pytest.raises(InvalidInput, match="expected one of profile, guarded"):
        ContactSwitchConfig(kind=kind)


@pytest.mark.parametrize(
    "axis", [(0.0, 0.0, 0.0), (0.0, 1.0), (np.nan, 0.0, 1.0), None, 1.0], ids=repr
)
def test_axes_are_checked(axis):
    with pytest.raises(InvalidInput, match="^axis is .*three finite numbers, not all zero"):
        ContactSwitchConfig(axis=axis)


@pytest.mark.parametrize("speed", [(0.4, 0.1), (-0.1, 0.4), (0.1,), (np.nan, 0.4)], ids=repr)
def test_speeds_are_checked(dex5, speed):
    with pytest.raises(InvalidInput, match="^speed "):
        ContactSwitch(dex5, speed=speed)


@pytest.mark.parametrize("kind", ["profile", "guarded"])
def test_another_batch_shape_needs_a_reset(cylinder, settled, kind):
    controller = ContactSwitch(cylinder.hand, kind=kind)
    controller.act(settled)
    with pytest.raises(InvalidInput, match="batch shape"):
        controller.act(settled[:2])
    controller.reset()
    assert controller.act(settled[:2]).shape == (2, 15)
    controller.reset()
    assert controller.act(settled[0]).shape == (15,)


@pytest.mark.parametrize("kind", ["profile", "guarded"])
def test_seeds_are_integers_one_for_each(cylinder, settled, kind):
    controller = ContactSwitch(cylinder.hand, kind=kind)
    for seed in ([1, 2], 0.5, "one"):
        controller.reset(seed=seed)
        with pytest.raises(InvalidInput, match="seed is"):
            controller.act(settled)
    controller.reset(seed=[5, 4, 3, 2, 1, 0])
    assert controller.act(settled).shape == (6, 15)
