"""Trials: the protocol, and rotation by hand-computed numbers."""

from __future__ import annotations

import numpy as np
import pytest

from dexctl.controller import Controller
from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.sim import BatchSimulator, Scene, SceneConfig, Sensing, Simulation, run
from dexctl.sim.trial import rotation_about
from dexctl.state import Floats, GraspState
from dexctl.validation import unit_axis


class Hold(Controller):
    """Leaves the set-points where they are."""

    def reset(self, seed=None, mask=None) -> None:
        pass

    def act(self, state: GraspState) -> Floats:
        self._diagnostics = {"force": state.contact_force.sum(-1), "name": "hold", "one": 1.0}
        return np.zeros_like(state.q)


def about(axis: int, angle: float) -> np.ndarray:
    quaternion = np.zeros(4)
    quaternion[0], quaternion[1 + axis] = np.cos(angle / 2), np.sin(angle / 2)
    return quaternion


def test_rotation_unwraps_and_ignores_tilt() -> None:
    turning = np.array([about(2, 0.5 * k) for k in range(40)])
    np.testing.assert_allclose(rotation_about(turning), 0.5 * np.arange(40), atol=1e-9)
    np.testing.assert_allclose(rotation_about(-turning), 0.5 * np.arange(40), atol=1e-9)
    tilting = np.array([about(0, 0.1 * k) for k in range(10)])
    np.testing.assert_allclose(rotation_about(tilting), 0.0, atol=1e-12)


def test_rotation_stands_still_after_the_drop() -> None:
    quaternion = np.array([about(2, -0.3 * k) for k in range(6)])[:, None].repeat(2, axis=1)
    held = np.ones((6, 2), bool)
    held[3:, 1] = False
    angle = rotation_about(quaternion, held=held)
    np.testing.assert_allclose(angle[:, 0], -0.3 * np.arange(6), atol=1e-9)
    np.testing.assert_allclose(angle[:, 1], [0, -0.3, -0.6, -0.6, -0.6, -0.6], atol=1e-9)


@pytest.mark.parametrize("count", [None, 3])
def test_a_held_object(count: int | None) -> None:
    scene = Scene.build("dex5", "cube")
    sim, controller = BatchSimulator(scene, count), Hold(scene.hand)
    seen: list[float] = []
    trace = run(controller, sim, 1.0, observers=[lambda s: seen.append(float(np.max(s.time)))])
    batch = () if count is None else (count,)
    np.testing.assert_allclose(trace.time, 0.05 * np.arange(21))
    np.testing.assert_allclose(seen, trace.time)
    assert trace.q.shape == (21, *batch, 15)
    assert trace.contact_normal.shape == (21, *batch, 5, 3)
    assert trace.held.shape == trace.rotation.shape == trace.other_contact.shape == (21, *batch)
    assert not np.any(trace.dropped)
    np.testing.assert_allclose(trace.time_held, 1.0)
    assert np.abs(trace.final_rotation).max() < 0.1
    names = {"force"} if count else {"force", "one"}
    assert set(trace.diagnostics) == names
    np.testing.assert_allclose(trace.diagnostics["force"], trace.contact_force[:-1].sum(-1))
    assert trace.act_seconds.shape == (20,)


def test_a_dropped_object() -> None:
    scene = Scene.build("dex5", "cylinder", "down")
    sim = BatchSimulator(scene, 2)
    sim.set_parameters(friction=np.array([0.0, 1.0]))
    trace = run(Hold(scene.hand), sim, 1.0)
    np.testing.assert_array_equal(trace.dropped, [True, False])
    # free fall of 0.05 m takes 0.1 s; fingers without friction hold it back a little
    assert 0.05 <= trace.time_held[0] <= 0.5
    assert trace.time_held[1] == pytest.approx(1.0)
    away = np.linalg.norm(trace.object_position - trace.object_position[0], axis=-1)
    np.testing.assert_array_equal(trace.held[:, 0], np.logical_and.accumulate(away[:, 0] <= 0.05))
    last = int(trace.held[:, 0].sum()) - 1
    assert (trace.rotation[last:, 0] == trace.rotation[last, 0]).all()


def test_trials_may_end_when_nothing_is_held_any_more() -> None:
    scene = Scene.build("dex5", "cylinder", "down")
    sim = BatchSimulator(scene, 2)

    def ended(*friction: float) -> float:
        sim.reset(seed=0)
        sim.set_parameters(friction=np.array(friction))
        trace = run(Hold(scene.hand), sim, 1.0, until_dropped=True)
        assert len(trace.act_seconds) == len(trace.time) - 1
        assert trace.held[-2].any()
        return float(trace.time[-1])

    assert ended(0.0, 0.0) <= 0.5
    assert ended(0.0, 1.0) == pytest.approx(1.0)


def test_what_does_not_fit() -> None:
    scene = Scene.build("dex5", "cube")
    sim = BatchSimulator(scene)
    with pytest.raises(InvalidInput, match=r"control_period is 0.02 s and the simulator's 0.05"):
        run(Hold(scene.hand, control_period=0.02), sim, 1.0)
    with pytest.raises(InvalidInput, match="seconds is 0.01"):
        run(Hold(scene.hand), sim, 0.01)


def test_rotation_about_another_axis() -> None:
    half = np.linspace(0.0, 7.25, 30)
    turning = np.zeros((30, 4))
    turning[:, 0], turning[:, 1] = np.cos(half), np.sin(half)
    np.testing.assert_allclose(rotation_about(turning, (1.0, 0.0, 0.0)), 2 * half, atol=1e-9)
    np.testing.assert_allclose(rotation_about(turning, (-1.0, 0.0, 0.0)), -2 * half, atol=1e-9)
    np.testing.assert_allclose(rotation_about(turning[:10]), 0.0, atol=1e-12)


class Spin:
    """A plant that turns its object about x, 0.08 rad in each step."""

    def __init__(self, scene: Scene) -> None:
        self.hand, self.control_period = scene.hand, 0.05
        self.batch_shape, self.diverged, self.other_contact = (), np.array(False), np.array(0.0)
        self.steps = 0

    def read(self) -> GraspState:
        vectors = np.zeros((5, 3))
        return GraspState(
            q=np.zeros(15), q_target=np.zeros(15), in_contact=np.ones(5, bool),
            contact_force=np.ones(5), contact_position=vectors, contact_normal=vectors,
            object_position=np.zeros(3), object_quaternion=about(0, 0.08 * self.steps),
        )  # fmt: skip

    def write(self, q_target: Floats) -> Floats:
        return q_target

    def step(self) -> None:
        self.steps += 1


@pytest.mark.parametrize(
    ("axis", "turned"),
    [("x", 1.6), ("-x", -1.6), ("-z", 0.0), ((2.0, 0.0, 0.0), 1.6)],
)
def test_a_trace_counts_about_the_axis_of_its_run(axis, turned: float) -> None:
    """1.6 rad about x; that is nothing about z."""
    scene = Scene.build("dex5", "cube")
    trace = run(Hold(scene.hand), Spin(scene), 1.0, axis=axis)  # type: ignore[arg-type]
    assert trace.final_rotation == pytest.approx(turned, abs=1e-9)
    np.testing.assert_allclose(trace.axis, unit_axis(axis))


def test_the_trace_is_the_truth_of_a_simulation_that_senses_badly() -> None:
    config = SceneConfig(
        object=("cylinder",), sensing=Sensing(joint_noise=0.1, sensor_latency=0.1), threads=1
    )
    seen: list[GraspState] = []

    class Looking(Hold):
        def act(self, state: GraspState) -> Floats:
            seen.append(state)
            return super().act(state)

    with Simulation(config, 2) as sim:
        trace = run(Looking(sim.hand), sim, 0.2)
    assert np.abs(seen[0].q - trace.q[0]).max() > 0.05
    np.testing.assert_array_equal(seen[2].q_target, trace.q_target[2])
    assert trace.held.all()
    assert np.abs(np.diff(trace.q, axis=0)).max() < 0.05


@pytest.mark.parametrize("axis", ["w", "zz"])
def test_an_axis_that_is_none(axis: str) -> None:
    scene = Scene.build("dex5", "cube")
    with pytest.raises(UnknownName, match=f"unknown axis '{axis}'; known: x, y, z, -x"):
        run(Hold(scene.hand), Spin(scene), 1.0, axis=axis)  # type: ignore[arg-type]
