"""Simulation: all that a SceneConfig says takes effect, one against many, replays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from dexctl.exceptions import InvalidInput, SimulationError, UnknownName
from dexctl.limits import HandLimits
from dexctl.plant import Plant
from dexctl.sim import GraspStates, Push, SceneConfig, Sensing, Simulation
from dexctl.state import GraspState

PLAIN = SceneConfig(object=("cylinder",), threads=1)
EVERYTHING = SceneConfig(
    object=("cylinder",),
    threads=1,
    stiffness=2.5,
    damping=0.2,
    sensing=Sensing(
        joint_noise=0.01,
        position_noise=1e-3,
        normal_noise=0.02,
        force_noise=0.1,
        force_noise_share=0.05,
        sensor_latency=0.1,
    ),
    push=Push(push_force=0.3, push_seconds=0.15),
    limits=HandLimits(speed_limit=0.6, torque_limit=0.4, action_latency=0.075),
)


def drive(sim: Simulation, steps: int, first: int = 0) -> list[GraspState]:
    """Wiggle the set-points in a way that depends on the step only; what is sensed, what is."""
    found = []
    for k in range(first, first + steps):
        sim.write(sim.read().q_target + 0.02 * np.sin(0.7 * k + np.arange(sim.hand.nq)))
        sim.step()
        found += [sim.read(), sim.state]
    return found


def assert_same(first: list[GraspState], again: list[GraspState], rows: slice | int = ...) -> None:  # type: ignore[assignment]
    for a, b in zip(first, again, strict=True):
        for name, value in a.arrays().items():
            other = getattr(b, name)
            if value is None:  # no goal is given
                assert other is None
                continue
            np.testing.assert_array_equal(value, other[rows], err_msg=name)


@pytest.fixture
def starts(tmp_path: Path, at_rest: Callable[..., GraspStates]) -> SceneConfig:
    """Everything, from a file with two states."""
    with Simulation(PLAIN, 2) as sim:
        drive(sim, 3)
        path = tmp_path / "starts.npz"
        at_rest(sim.hand, sim.state, ["cylinder"] * 2).save(path)
    return replace(EVERYTHING, initial_states=path)


def test_each_of_a_batch_is_a_single_one_with_its_seed(starts: SceneConfig) -> None:
    with Simulation(starts, 3, seed=7) as batch:
        assert isinstance(batch, Plant)
        together = drive(batch, 6)
        for i in range(3):
            with Simulation(starts, 1, seed=7 + i) as single:
                assert_same(drive(single, 6), together, slice(i, i + 1))


def test_save_and_restore_to_the_same_bits(starts: SceneConfig) -> None:
    with Simulation(starts, 2, seed=3) as sim, Simulation(starts, 2, seed=50) as other:
        drive(sim, 4)
        sim.step()  # nobody has looked at what this one came to
        saved = sim.save()
        chosen, runs = np.array([True, False]), []
        for one in (sim, sim, other):
            one.restore(saved)
            found = drive(one, 3, 4)
            one.reset(mask=chosen)
            runs.append([*found, one.read(), *drive(one, 3, 7)])
        assert_same(runs[0], runs[1])
        assert_same(runs[0], runs[2])


def test_states_saved_by_others_are_refused() -> None:
    with (
        Simulation(PLAIN, 2) as sim,
        Simulation(PLAIN, 1) as smaller,
        Simulation(replace(PLAIN, limits=HandLimits.real()), 2) as limited,
    ):
        for other in (smaller, limited):
            with pytest.raises(SimulationError, match="the saved state"):
                other.restore(sim.save())
        with pytest.raises(SimulationError, match="the saved state"):
            sim.restore(limited.save())


def test_seeds_say_it_all(starts: SceneConfig) -> None:
    with Simulation(starts, 2, seed=1) as sim, Simulation(starts, 2, seed=2) as other:
        first, different = drive(sim, 2), drive(other, 2)
        assert np.abs(first[0].q - different[0].q).max() > 1e-4
        other.reset(seed=1)
        assert_same(first, drive(other, 2))
        other.reset(seed=[1, 2])
        assert_same(first, drive(other, 2))


def test_reset_of_some_leaves_the_others(starts: SceneConfig) -> None:
    with (
        Simulation(starts, 2, seed=1) as sim,
        Simulation(starts, 2, seed=1) as undisturbed,
        Simulation(starts, 1, seed=40) as fresh,
    ):
        drive(sim, 3)
        drive(undisturbed, 3)
        sim.reset(seed=[40, 0], mask=np.array([True, False]))
        assert_same([fresh.read(), fresh.state], [sim.read(), sim.state], slice(0, 1))
        assert np.asarray(sim.state.time).tolist() == pytest.approx([0.0, 0.15])
        assert_same([one[1:] for one in drive(sim, 3, 3)], drive(undisturbed, 3, 3), slice(1, 2))


def test_steps_that_nobody_looks_at_are_sensed_all_the_same() -> None:
    config = replace(PLAIN, sensing=Sensing(joint_noise=0.01, sensor_latency=0.1))
    with Simulation(config, 1) as sim, Simulation(config, 1) as unseen:
        for _ in range(4):
            sim.step()
            sim.read()
            unseen.step()
        assert_same([sim.read()], [unseen.read()])


def test_a_plain_one_senses_the_truth() -> None:
    with Simulation(PLAIN, 2) as sim:
        for seen, truth in zip(*[iter(drive(sim, 2))] * 2, strict=True):
            assert seen is truth


def test_the_limits_stand_in_front() -> None:
    """0.6 rad/s at 20 Hz are 0.03 rad a step, that arrive a step later."""
    limits = HandLimits(speed_limit=0.6, action_latency=0.05)
    with Simulation(replace(PLAIN, limits=limits), 1) as sim:
        start = sim.state.q_target
        for k in range(1, 4):
            sent = sim.write(start - 0.3)
            assert sent == pytest.approx(start - 0.03 * k)
            sim.step()
            assert sim.state.q_target == pytest.approx(sent)
            assert sim.sim.read().q_target == pytest.approx(start - 0.03 * (k - 1))


def test_pushes_change_their_direction() -> None:
    forces = []
    with Simulation(replace(PLAIN, push=Push(push_force=0.5, push_seconds=0.1)), 3) as sim:
        push = sim.sim.push
        sim.sim.push = lambda force: (forces.append(np.array(force)), push(force))[1]
        for _ in range(6):
            sim.step()
    np.testing.assert_allclose(np.linalg.norm(forces, axis=-1), 0.5)
    held = [np.array_equal(a, b) for a, b in pairwise(forces)]
    assert held == [True, False, True, False, True]
    assert np.abs(forces[0][0] - forces[0][1]).max() > 0.01


def test_servos_as_asked() -> None:
    with Simulation(replace(PLAIN, stiffness=1.5, damping=0.3), 1) as sim:
        model = sim.sim.groups[0]._parameters.models[0]
        np.testing.assert_allclose(model.actuator_gainprm[:, 0], 1.5)
        np.testing.assert_allclose(model.actuator_biasprm[:, 2], -0.3)


def test_it_starts_from_the_states_of_the_file(starts: SceneConfig) -> None:
    assert starts.initial_states is not None
    given = GraspStates.load(starts.initial_states)
    with Simulation(replace(starts.undisturbed(), initial_states=starts.initial_states), 4) as sim:
        drawn = [int(np.abs(given.q - q).max(axis=1).argmin()) for q in sim.state.q]
        np.testing.assert_allclose(sim.state.q, given.q[drawn])
        assert sim.state.object_position is not None
        np.testing.assert_allclose(sim.state.object_position, given.object_position[drawn])
        assert np.std(sim.state.q_target - given.q_target[drawn]) == pytest.approx(0.02, rel=0.4)
        assert set(drawn) == {0, 1}


def test_other_starts_from_now_on(starts: SceneConfig) -> None:
    assert starts.initial_states is not None
    given = GraspStates.load(starts.initial_states)
    with Simulation(replace(PLAIN, disturbance=0.0), 4) as sim:
        settled = sim.state.q
        sim.start_from(replace(given, weight=np.array([1e-9, 1.0])))
        sim.reset(mask=np.array([True, True, False, False]))
        np.testing.assert_allclose(sim.state.q[:2], given.q[[1, 1]])
        np.testing.assert_array_equal(sim.state.q[2:], settled[2:])
        sim.start_from(None)
        sim.reset()
        np.testing.assert_array_equal(sim.state.q, settled)


def test_gravity_in_part(starts: SceneConfig) -> None:
    with Simulation(PLAIN, 2) as sim:
        sim.scale_gravity(0.25)
        gravity = sim.sim.read().gravity
        assert gravity is not None
        np.testing.assert_allclose(gravity, [[0.0, 0.0, -0.25 * 9.81]] * 2)
        with pytest.raises(InvalidInput, match="share is nan"):
            sim.scale_gravity(np.nan)


def test_the_objects_own_velocity_is_that_of_its_poses() -> None:
    with Simulation(replace(PLAIN, control_period=0.002, substeps=1), 2) as sim:
        for _ in range(60):
            sim.write(sim.read().q_target + 0.0015 * np.sin(np.arange(sim.hand.nq)))
            sim.step()
        before = sim.state.object_position
        sim.step()
        velocity, after = sim.sim.object_velocity, sim.state.object_position
        assert before is not None
        assert after is not None
        assert np.abs(velocity).max() > 1e-3
        np.testing.assert_allclose(velocity[:, :3], (after - before) / 0.002, atol=1e-8)
        np.testing.assert_allclose(velocity[:, 3:], sim.sim.object_angular_velocity, atol=1e-5)


def test_given_grasps_begin_at_rest(starts: SceneConfig) -> None:
    assert starts.initial_states is not None
    given = GraspStates.load(starts.initial_states)
    with Simulation(starts, 3, seed=1) as sim:
        drive(sim, 2)
        before = sim.state
        sim.place(given, [1, 0, 1], np.array([True, True, False]))
        np.testing.assert_array_equal(sim.state.q[:2], given.q[[1, 0]])
        np.testing.assert_array_equal(sim.state.q_target[:2], given.q_target[[1, 0]])
        np.testing.assert_array_equal(sim.state.q[2], before.q[2])
        assert np.asarray(sim.state.time).tolist() == pytest.approx([0.0, 0.0, 0.1])
        other = replace(given, object=np.array(["cylinder", "cube"]))
        with pytest.raises(InvalidInput, match="state 1 is of the object 'cube'; env"):
            sim.place(other, [0, 0, 1])


def test_several_objects_share_out_the_environments() -> None:
    with Simulation(SceneConfig(object=("cube", "sphere"), threads=1), 3) as sim:
        assert sim.objects == ("cube", "cube", "sphere")
        assert len(drive(sim, 1)[0].q) == 3


@pytest.mark.parametrize(
    ("settings", "error", "said"),
    [
        ({"hand": "claw"}, UnknownName, "unknown hand 'claw'; known: dex5"),
        ({"object": ("ball",)}, UnknownName, "unknown object 'ball'; known: cube, sphere"),
        ({"object": ()}, InvalidInput, r"object is \(\); expected a name"),
        ({"object_size": 0.0}, InvalidInput, "object_size is 0.0"),
        ({"object_mass": -1.0}, InvalidInput, "object_mass is -1.0"),
        ({"gravity": "left"}, UnknownName, "unknown gravity 'left'; known: up, down"),
        ({"gravity": (0.0, 1.0)}, InvalidInput, r"gravity is \(0.0, 1.0\); expected 3 finite"),
        ({"gravity": (0.0, 0.0, np.nan)}, InvalidInput, "gravity is .*; expected 3 finite numbers"),
        ({"stiffness": 0.0}, InvalidInput, "stiffness is 0.0"),
        ({"damping": np.inf}, InvalidInput, "damping is inf"),
        ({"control_period": 0.0}, InvalidInput, "control_period is 0.0"),
        ({"substeps": 0}, InvalidInput, "substeps is 0; expected a whole number from 1 on"),
        ({"disturbance": -0.1}, InvalidInput, "disturbance is -0.1"),
        ({"threads": 0}, InvalidInput, "threads is 0"),
        ({"initial_states": Path("nowhere.npz")}, InvalidInput, "'nowhere.npz' cannot be read"),
    ],
)
def test_bad_settings(settings: dict[str, object], error: type[Exception], said: str) -> None:
    with pytest.raises(error, match=said):
        Simulation(SceneConfig(**settings), 2)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("num_envs", "seed", "said"),
    [
        (1, 0, "num_envs is 1; expected at least 2, one for each of cube, sphere"),
        (2.0, 0, "num_envs is 2.0; expected a whole number"),
        (True, 0, "num_envs is True"),
        (2, 0.5, "seed is 0.5; expected an integer, or 2 of them"),
        (2, [1, 2, 3], r"seed is \[1, 2, 3\]"),
    ],
)
def test_bad_numbers_of_environments(num_envs: object, seed: object, said: str) -> None:
    with pytest.raises(InvalidInput, match=said):
        Simulation(SceneConfig(object=("cube", "sphere")), num_envs, seed)  # type: ignore[arg-type]


def test_the_scene_has_the_parameters_of_its_configuration() -> None:
    config = SceneConfig(
        object=("cylinder",), object_friction=0.5, stiffness=2.0, damping=0.1, threads=1
    )
    with Simulation(config, 2) as simulation:
        np.testing.assert_allclose(simulation.sim.friction, 0.5)
        np.testing.assert_allclose(simulation.sim.groups[0].scene.stiffness, 2.0)
        assert simulation.state.in_contact.all()  # it settled with them
