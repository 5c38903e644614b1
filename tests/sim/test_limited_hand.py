"""A simulated hand with the limits of the real one: late, slow, weak, and nothing else."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

import dexctl
import dexctl.controllers
from dexctl.exceptions import InvalidInput
from dexctl.limits import HandLimits
from dexctl.plant import Plant
from dexctl.sim import BatchSimulator, LimitedHand, Scene, run


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene.build("dex5", "cylinder")


@pytest.fixture
def sim(scene: Scene) -> Iterator[BatchSimulator]:
    with BatchSimulator(scene, 2, threads=1, disturbance=0.0) as simulator:
        yield simulator


def test_it_is_a_plant(sim: BatchSimulator) -> None:
    assert isinstance(LimitedHand(sim, HandLimits.real()), Plant)


def test_set_points_come_slowly_and_late(sim: BatchSimulator) -> None:
    """0.6 rad/s at 20 Hz are 0.03 rad a step; 0.1 s are two steps."""
    real = LimitedHand(sim, HandLimits(speed_limit=0.6, action_latency=0.1))
    start = sim.read().q_target
    for k in range(1, 5):
        wanted = start.copy()
        wanted[:, 0] += 0.5
        assert real.write(wanted)[:, 0] == pytest.approx(start[:, 0] + 0.03 * k)
        assert real.write(wanted)[:, 0] == pytest.approx(start[:, 0] + 0.03 * k)  # writes replace
        assert real.read().q_target[:, 0] == pytest.approx(start[:, 0] + 0.03 * k)
        real.step()
        applied = sim.read().q_target[:, 0] - start[:, 0]
        assert applied == pytest.approx(0.03 * max(k - 2, 0))


def test_latency_between_control_periods_mixes_the_set_points_about_it(sim: BatchSimulator) -> None:
    """0.075 s are one and a half periods: a ramp comes by just that much later."""
    real = LimitedHand(sim, HandLimits(speed_limit=0.6, action_latency=0.075))
    start = sim.read().q_target
    for k in range(1, 6):
        wanted = start.copy()
        wanted[:, 0] += 0.5  # 0.03 rad a step is what the speed limit leaves
        real.write(wanted)
        real.step()
        applied = sim.read().q_target[:, 0] - start[:, 0]
        assert applied == pytest.approx(0.03 * (k - 1.5) if k > 1 else 0.0)


def test_limits_may_be_left_out(sim: BatchSimulator, scene: Scene) -> None:
    real = LimitedHand(sim, HandLimits(), scene.stiffness)
    state = sim.read()
    assert real.write(state.q_target - 0.3) == pytest.approx(scene.hand.clip(state.q_target - 0.3))


def test_a_trial_of_a_controller_that_sees_the_limits(sim: BatchSimulator) -> None:
    controller = dexctl.controllers.make("igm", sim.hand)
    sim.reset(0)
    controller.reset(0)
    trace = run(controller, sim, 1.0, plant=LimitedHand(sim, HandLimits(speed_limit=0.1)))
    speed = np.abs(np.diff(trace.q_target, axis=0)) / sim.control_period
    assert speed.max() == pytest.approx(0.1)  # it asks for 0.15 rad/s here
    assert trace.held.all()
    assert (trace.rotation[-1] > 0.1).all()


def test_torque_bounds_the_lead(sim: BatchSimulator, scene: Scene) -> None:
    real = LimitedHand(sim, HandLimits(torque_limit=0.1), scene.stiffness)
    state = sim.read()
    sent = real.write(state.q + 0.2)
    # kp is 3 N m/rad: 0.1 N m is a lead of 1/30 rad
    inside = sent < np.broadcast_to(scene.upper, sent.shape) - 1e-9
    assert (sent - state.q)[inside] == pytest.approx(0.1 / 3.0)


def test_without_limits_it_changes_nothing(scene: Scene) -> None:
    with (
        BatchSimulator(scene, 2, threads=1, seed=4) as bare,
        BatchSimulator(scene, 2, threads=1, seed=4) as behind,
    ):
        real = LimitedHand(behind, HandLimits(speed_limit=1e6))
        for i in range(5):
            goal = bare.read().q_target + 0.01 * np.sin(i + np.arange(15))
            bare.write(goal)
            real.write(goal)
            bare.step()
            real.step()
        assert (bare.read().q == behind.read().q).all()


def test_restart_forgets_what_is_on_its_way(sim: BatchSimulator) -> None:
    real = LimitedHand(sim, HandLimits.real())
    real.write(sim.read().q_target + 0.03)
    real.step()
    sim.reset(0)
    real.restart()
    before = sim.read().q_target
    real.step()
    assert (sim.read().q_target == before).all()


def test_the_hand_of_the_thesis() -> None:
    assert HandLimits.real() == HandLimits(speed_limit=0.6, torque_limit=0.5, action_latency=0.05)
    assert HandLimits.real() and not HandLimits()


def test_what_is_on_its_way_is_saved(sim: BatchSimulator) -> None:
    real = LimitedHand(sim, HandLimits(speed_limit=0.6, action_latency=0.075))
    for k in range(3):
        real.write(sim.read().q_target + 0.01 * k)
        real.step()
    saved, below = real.save(), sim.save()
    ends = []
    for _ in range(2):
        sim.restore(below)
        real.restore(saved)
        for _ in range(3):
            real.write(real.read().q_target + 0.01)
            real.step()
        ends.append((real.read().q_target, sim.read().q_target, sim.read().q))
    for first, again in zip(*ends, strict=True):
        np.testing.assert_array_equal(first, again)


def test_restart_of_some_leaves_the_others(sim: BatchSimulator) -> None:
    real = LimitedHand(sim, HandLimits.real())
    real.write(sim.read().q_target + 0.03)
    sent = real.read().q_target
    real.restart(np.array([True, False]))
    np.testing.assert_array_equal(real.read().q_target[0], sim.read().q_target[0])
    np.testing.assert_array_equal(real.read().q_target[1], sent[1])


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"speed_limit": 0.0}, "speed_limit is 0.0; expected a finite number above 0"),
        ({"action_latency": np.nan}, "action_latency is nan; expected a finite number, 0 or more"),
        ({"action_latency": 11.0}, "action_latency is 11.0; expected 0 to 10 s"),
        ({"torque_limit": -1.0}, "torque_limit is -1.0"),
    ],
)
def test_bad_limits(settings: dict[str, float], said: str) -> None:
    with pytest.raises(InvalidInput, match=said):
        HandLimits(**settings)


def test_bad_stiffness(sim: BatchSimulator) -> None:
    with pytest.raises(InvalidInput, match="stiffness is .* one or \\(15,\\)"):
        LimitedHand(sim, HandLimits.real(), [1.0, 2.0])


def test_bad_set_points(sim: BatchSimulator) -> None:
    real = LimitedHand(sim, HandLimits.real())
    with pytest.raises(InvalidInput, match="q_target has shape \\(15,\\); expected \\(2, 15\\)"):
        real.write(np.zeros(15))
    with pytest.raises(InvalidInput, match="all finite"):
        real.write(np.full((2, 15), np.nan))
