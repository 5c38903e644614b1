"""A simulated hand with the limits of the real one: late, slow, weak, and nothing else."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

import dexctl
import dexctl.controllers
from dexctl.exceptions import InvalidInput
from dexctl.plant import Plant
from dexctl.sim import AsReal, BatchSimulator, Scene, run


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene.build("dex5", "cylinder")


@pytest.fixture
def sim(scene: Scene) -> Iterator[BatchSimulator]:
    with BatchSimulator(scene, 2, threads=1, disturbance=0.0) as simulator:
        yield simulator


def test_it_is_a_plant(sim: BatchSimulator) -> None:
    assert isinstance(AsReal(sim), Plant)


def test_set_points_come_slowly_and_late(sim: BatchSimulator) -> None:
    """0.6 rad/s at 20 Hz are 0.03 rad a step; 0.1 s are two steps."""
    real = AsReal(sim, latency=0.1)
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
    real = AsReal(sim, latency=0.075)
    assert real.latency == 0.075
    start = sim.read().q_target
    for k in range(1, 6):
        wanted = start.copy()
        wanted[:, 0] += 0.5  # 0.03 rad a step is what the speed limit leaves
        real.write(wanted)
        real.step()
        applied = sim.read().q_target[:, 0] - start[:, 0]
        assert applied == pytest.approx(0.03 * (k - 1.5) if k > 1 else 0.0)


def test_limits_may_be_left_out(sim: BatchSimulator, scene: Scene) -> None:
    real = AsReal(sim, speed=None, torque=None, latency=0.0, stiffness=scene.stiffness)
    state = sim.read()
    assert real.write(state.q_target - 0.3) == pytest.approx(scene.hand.clip(state.q_target - 0.3))


def test_a_trial_of_a_controller_that_sees_the_limits(sim: BatchSimulator) -> None:
    controller = dexctl.controllers.make("igm", sim.hand)
    sim.reset(0)
    controller.reset(0)
    trace = run(controller, sim, 1.0, plant=AsReal(sim, speed=0.1))
    speed = np.abs(np.diff(trace.q_target, axis=0)) / sim.control_period
    assert speed.max() == pytest.approx(0.1)  # it asks for 0.15 rad/s here
    assert trace.held.all()
    assert (trace.rotation[-1] > 0.1).all()


def test_torque_bounds_the_lead(sim: BatchSimulator, scene: Scene) -> None:
    real = AsReal(sim, speed=1000.0, latency=0.0, torque=0.1, stiffness=scene.stiffness)
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
        real = AsReal(behind, speed=1e6, latency=0.0)
        for i in range(5):
            goal = bare.read().q_target + 0.01 * np.sin(i + np.arange(15))
            bare.write(goal)
            real.write(goal)
            bare.step()
            real.step()
        assert (bare.read().q == behind.read().q).all()


def test_restart_forgets_what_is_on_its_way(sim: BatchSimulator) -> None:
    real = AsReal(sim)
    real.write(sim.read().q_target + 0.03)
    real.step()
    sim.reset(0)
    real.restart()
    before = sim.read().q_target
    real.step()
    assert (sim.read().q_target == before).all()


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"speed": 0.0}, "speed is 0.0; expected rad/s above 0"),
        ({"latency": np.nan}, "latency is nan; expected 0 to 10 s"),
        ({"torque": -1.0}, "torque is -1.0"),
        ({"stiffness": [1.0, 2.0]}, "stiffness is .* one or \\(15,\\)"),
    ],
)
def test_bad_settings(sim: BatchSimulator, settings: dict[str, float], text: str) -> None:
    with pytest.raises(InvalidInput, match=text):
        AsReal(sim, **settings)


def test_bad_set_points(sim: BatchSimulator) -> None:
    real = AsReal(sim)
    with pytest.raises(InvalidInput, match="q_target has shape \\(15,\\); expected \\(2, 15\\)"):
        real.write(np.zeros(15))
    with pytest.raises(InvalidInput, match="all finite"):
        real.write(np.full((2, 15), np.nan))
