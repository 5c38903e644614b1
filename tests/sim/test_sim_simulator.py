"""BatchSimulator: one against many, replays, limits, parameters, divergence, groups."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dexctl.exceptions import InvalidInput, SimulationError, UnknownName
from dexctl.plant import Plant
from dexctl.rotations import inverse, multiply, rotation_vector
from dexctl.sim import BatchSimulator, GroupedSimulator, Scene
from dexctl.sim.physics_state import PhysicsLayout
from dexctl.state import GraspState


@pytest.fixture(scope="module")
def cube() -> Scene:
    return Scene.build("dex5", "cube", "up")


def drive(sim: BatchSimulator | GroupedSimulator, steps: int, first: int = 0) -> None:
    """Wiggle the set-points in a way that depends on the step only."""
    for k in range(first, first + steps):
        wiggle = 0.02 * np.sin(0.7 * k + np.arange(sim.hand.nq))
        sim.write(sim.read().q_target + wiggle)
        sim.step()


def assert_same(a: GraspState, b: GraspState) -> None:
    for name in a.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


def test_each_of_a_batch_is_a_single_hand_with_its_seed(cube: Scene) -> None:
    batch = BatchSimulator(cube, 3, seed=7)
    singles = [BatchSimulator(cube, None, seed=7 + i, threads=1) for i in range(3)]
    assert isinstance(batch, Plant)
    assert singles[0].read().batch_shape == ()
    assert singles[0].time.shape == singles[0].other_contact.shape == ()
    assert singles[0].object_angular_velocity.shape == (3,)
    for first in (0, 5):
        for i, single in enumerate(singles):
            assert_same(single.read(), batch.read()[i])
        for sim in (batch, *singles):
            drive(sim, 5, first)
    assert not np.array_equal(batch.read().q[0], batch.read().q[1])


def test_the_grasp_holds_and_state_is_consistent(cube: Scene) -> None:
    sim = BatchSimulator(cube, 8, seed=0)
    start = sim.read()
    assert start.in_contact.all()
    np.testing.assert_allclose(np.linalg.norm(start.contact_normal, axis=-1), 1.0, atol=1e-12)
    inward = cube.grasp_centre - start.contact_position
    assert (np.einsum("nmk,nmk->nm", inward, start.contact_normal) > 0).all()
    before = start.object_quaternion
    drive(sim, 1)
    assert before is not None
    after = sim.read().object_quaternion
    assert after is not None
    turn = rotation_vector(multiply(after, inverse(before))) / 0.05
    np.testing.assert_allclose(sim.object_angular_velocity, turn, atol=1e-12)
    drive(sim, 19)
    state = sim.read()
    np.testing.assert_allclose(state.time, 1.0)
    np.testing.assert_allclose(state.age, 0.005)
    assert state.object_position is not None
    assert np.linalg.norm(state.object_position - sim.start_position, axis=1).max() < 0.02
    assert not sim.other_contact.any()


def test_restore_replays_bit_for_bit(cube: Scene) -> None:
    sim = BatchSimulator(cube, 4, seed=3)
    drive(sim, 3)
    saved = sim.save()
    drive(sim, 6, 3)
    sim.reset(mask=np.array([True, False, False, True]))  # draws random numbers
    drive(sim, 3, 9)
    first, velocity = sim.read(), sim.object_angular_velocity
    other = BatchSimulator(cube, 4, seed=99, threads=1)
    other.set_parameters(friction=0.3)
    for again in (sim, other):
        again.restore(saved)
        drive(again, 6, 3)
        again.reset(mask=np.array([True, False, False, True]))
        drive(again, 3, 9)
        assert_same(again.read(), first)
        np.testing.assert_array_equal(again.object_angular_velocity, velocity)
    with pytest.raises(SimulationError, match=r"\(4, .*this simulator has \(2, "):
        BatchSimulator(cube, 2).restore(saved)


def test_reset_of_some_leaves_the_others(cube: Scene) -> None:
    sim = BatchSimulator(cube, 3, seed=0)
    drive(sim, 4)
    before = sim.read()
    sim.reset(seed=50, mask=np.array([False, True, False]))
    after = sim.read()
    assert_same(after[0], before[0])
    assert_same(after[2], before[2])
    assert_same(after[1], BatchSimulator(cube, None, seed=51).read())
    with pytest.raises(InvalidInput, match=r"mask has shape \(2,\)"):
        sim.reset(mask=np.array([True, False]))


def test_write_returns_what_is_sent(cube: Scene) -> None:
    sim = BatchSimulator(cube, None)
    sent = sim.write(np.full(15, 9.0))
    np.testing.assert_allclose(sent, sim.hand.upper)
    np.testing.assert_array_equal(sim.read().q_target, sent)
    with pytest.raises(InvalidInput, match=r"q_target has shape \(14,\); expected \(15,\)"):
        sim.write(np.zeros(14))
    bad = np.zeros(15)
    bad[4] = np.nan
    with pytest.raises(InvalidInput, match=r"q_target is nan at \[4\]"):
        sim.write(bad)


def test_an_object_on_the_palm_is_other_contact_and_weighs_what_it_should() -> None:
    scene = Scene.build("dex5", "sphere", "up", object_mass=0.2, object_size=0.06)
    sim = BatchSimulator(scene, 2)
    wide_open = np.tile(scene.open_q, (2, 1))
    lying = np.tile([0.0, 0.0, -0.014 + 0.03], (2, 1))  # the palm's top is at -0.014 m
    upright = np.tile([1.0, 0.0, 0.0, 0.0], (2, 1))
    sim.set_grasp(wide_open, wide_open, lying, upright)
    np.testing.assert_array_equal(sim.start_position, lying)
    for _ in range(30):
        sim.step()
    np.testing.assert_allclose(sim.other_contact, 0.2 * 9.81, rtol=0.05)
    assert not sim.read().in_contact.any()
    with pytest.raises(InvalidInput, match="expected 1"):
        sim.set_grasp(wide_open, wide_open, lying, 2 * upright)


def test_an_object_is_placed_at_rest_and_nothing_else_changes(cube: Scene) -> None:
    """Of two groups of two, the first of each is placed; the other goes on as if nothing was."""
    groups = [(cube, 2), (cube, 2)]
    sim, witness = (GroupedSimulator(groups, threads=1, seed=3) for _ in range(2))
    drive(sim, 3)
    drive(witness, 3)
    placed = np.array([True, False, True, False])
    before = sim.read()
    assert before.object_position is not None
    position = before.object_position + np.array([0.0, 0.0, 0.3])
    turned = np.tile([0.5, 0.5, 0.5, 0.5], (4, 1))
    sim.place_object(position, turned, placed)
    after = sim.read()
    for name in set(before.__dataclass_fields__) - {"object_position", "object_quaternion"}:
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name), err_msg=name)
    np.testing.assert_array_equal(after.object_position[placed], position[placed])  # type: ignore[index]
    np.testing.assert_array_equal(after.object_quaternion[placed], turned[placed])  # type: ignore[index]
    assert not sim.object_angular_velocity[placed].any()
    drive(sim, 1, 3)
    drive(witness, 1, 3)
    now, other = sim.read(), witness.read()
    assert_same(now[~placed], other[~placed])
    # ten steps of 5 ms from rest: g h^2 (1 + 2 + ... + 10)
    fallen = position[placed] - now.object_position[placed]  # type: ignore[index]
    np.testing.assert_allclose(fallen, np.tile([0.0, 0.0, 9.81 * 0.005**2 * 55], (2, 1)), atol=1e-6)
    with pytest.raises(InvalidInput, match="object_quaternion has norms"):
        sim.place_object(position, 2 * turned)


def test_parameters_of_each_environment(cube: Scene) -> None:
    sim = BatchSimulator(cube, 3, seed=0)
    plain = BatchSimulator(cube, 3, seed=0)
    saved = sim.save()
    sim.set_parameters(friction=np.array([1.0, 0.01, 1.0]), object_mass=np.array([0.1, 0.1, 0.3]))
    for _ in range(10):
        sim.step()
        plain.step()
    assert_same(sim.read()[0], plain.read()[0])
    height, usual = sim.read().object_position, plain.read().object_position
    assert height is not None
    assert usual is not None
    assert height[1, 2] < usual[1, 2] - 0.03  # it slips out
    assert height[2, 2] < usual[2, 2] - 1e-4  # it hangs lower
    np.testing.assert_allclose(sim.friction, [1.0, 0.01, 1.0])
    np.testing.assert_allclose(plain.friction, 1.0)
    sim.restore(saved)
    assert sim.parameters == {}
    with pytest.raises(UnknownName, match="unknown parameter 'colour'; known: friction"):
        sim.set_parameters(colour=1.0)
    with pytest.raises(InvalidInput, match=r"kp is -1.0; expected finite numbers > 0"):
        sim.set_parameters(kp=np.array([1.0, -1.0, 2.0]))
    with pytest.raises(InvalidInput, match=r"kp has shape \(2,\); expected \(\) or \(3,\)"):
        sim.set_parameters(kp=np.ones(2))


def test_divergence_is_seen_and_stays_where_it_is(
    cube: Scene,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)  # where MuJoCo by itself writes a log file
    healthy = BatchSimulator(cube, 4, seed=0, threads=2)
    sim = BatchSimulator(cube, 4, seed=0, threads=2)
    drive(sim, 2)
    drive(healthy, 2)
    sim.set_parameters(kv=0.15)
    broken = sim._parameters.models[1]  # its servos push away from their set-points
    broken.actuator_forcelimited[:] = 0
    broken.actuator_biasprm[:, 1] = 1e14
    last = sim.read()[1]
    drive(sim, 5, 2)
    drive(healthy, 5, 2)
    np.testing.assert_array_equal(sim.diverged, [False, True, False, False])
    np.testing.assert_allclose(sim.time, [0.35, 0.1, 0.35, 0.35])
    state = sim.read()
    np.testing.assert_array_equal(state.q[1], last.q)
    assert not state.in_contact[1].any()
    for i in (0, 2, 3):
        assert_same(state[i], healthy.read()[i])
    assert not any(tmp_path.iterdir()) and "unstable" not in capfd.readouterr().err
    sim.reset(mask=sim.diverged)
    assert not sim.diverged.any()


def test_an_object_that_falls_for_long_has_not_broken_down(cube: Scene) -> None:
    """100 m in 4.5 s, at 44 m/s."""
    sim = BatchSimulator(cube, 1, threads=1)
    state = sim.read()
    assert state.object_position is not None
    assert state.object_quaternion is not None
    beside = state.object_position + np.array([1.0, 0.0, 0.0])
    sim.set_grasp(state.q, state.q_target, beside, state.object_quaternion)
    for _ in range(90):
        sim.step()
    fallen = sim.read().object_position
    assert fallen is not None
    assert fallen[0, 2] - beside[0, 2] == pytest.approx(-0.5 * 9.81 * 4.5**2, rel=0.01)
    assert not sim.diverged.any()


@pytest.mark.parametrize(
    ("column", "value"),
    [("position", np.nan), ("qvel", np.inf), ("qvel", 1e6), ("time", 0.0)],
)
def test_what_is_no_simulation_any_more(cube: Scene, column: str, value: float) -> None:
    """NaN, speeds that nothing has, and time that fell back: MuJoCo resets itself silently."""
    layout, expected = PhysicsLayout(cube), np.full(2, 0.5)
    after = np.tile(layout.state(cube.settled.qpos), (2, 1))
    after[:, 0] = expected
    where = {"position": layout.position, "qvel": layout.qvel, "time": slice(0, 1)}[column]
    after[1, where] = value
    np.testing.assert_array_equal(layout.broken(after, expected, 0.005, 9.81), [False, True])


def test_groups_are_their_simulators_side_by_side(cube: Scene) -> None:
    sphere = Scene.build("dex5", "sphere", "up")
    both = GroupedSimulator([(cube, 2), (sphere, 3)], seed=10)
    parts = [BatchSimulator(cube, 2, seed=10), BatchSimulator(sphere, 3, seed=12)]
    assert both.objects == ("cube", "cube", "sphere", "sphere", "sphere")
    saved = both.save()
    for sim in (both, *parts):
        drive(sim, 4)
    state = both.read()
    assert_same(state[:2], parts[0].read())
    assert_same(state[2:], parts[1].read())
    assert both.start_position.shape == (5, 3)
    both.restore(saved)
    drive(both, 4)
    assert_same(both.read(), state)
    both.set_parameters(friction=np.linspace(0.5, 1, 5), kp=3.0)
    np.testing.assert_allclose(both.groups[1].parameters["friction"], [0.75, 0.875, 1.0])
    both.reset(seed=10, mask=np.array([False, False, False, True, False]))
    assert_same(both.read()[3], BatchSimulator(sphere, None, seed=13).read())
    with pytest.raises(InvalidInput, match="no groups"):
        GroupedSimulator([])


def test_bad_numbers_and_a_closed_simulator(cube: Scene) -> None:
    wrong: list[tuple[str, Any]] = [
        ("num_envs", 0),
        ("num_envs", 2.5),
        ("substeps", 0),
        ("threads", 0),
        ("control_period", np.nan),
        ("disturbance", -0.1),
        ("touch_threshold", -1.0),
    ]
    for name, value in wrong:
        with pytest.raises(InvalidInput, match=f"{name} is {value}"):
            BatchSimulator(cube, **{name: value})
    with BatchSimulator(cube, 2) as sim:
        sim.step()
    with pytest.raises(SimulationError, match="closed"):
        sim.step()


def test_control_rate_changes_only_what_it_must(cube: Scene) -> None:
    fast = BatchSimulator(cube, None, control_period=0.025, substeps=5, disturbance=0.0)
    slow = BatchSimulator(cube, None, control_period=0.05, substeps=10, disturbance=0.0)
    for _ in range(20):
        fast.step()
        fast.step()
        slow.step()
    assert fast.time == pytest.approx(float(slow.time))
    np.testing.assert_allclose(fast.read().q, slow.read().q, atol=1e-5)


def test_a_push_accelerates_a_free_object(cube: Scene) -> None:
    """F = m a on an object above the hand, against one that only falls."""
    sim = BatchSimulator(cube, 3, seed=0, threads=1)
    state = sim.read()
    assert state.object_position is not None
    assert state.object_quaternion is not None
    above = state.object_position + np.array([0.0, 0.0, 0.5])
    sim.set_grasp(state.q, state.q_target, above, state.object_quaternion)
    force = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, -0.2, 0.05]])
    sim.push(force)
    saved = sim.save()
    for _ in range(2):
        sim.step()
    moved = sim.read().object_position
    assert moved is not None
    expected = 0.5 * (force / cube.object_mass) * 0.1**2
    # semi-implicit steps of 5 ms go one step's part further than the continuous motion
    np.testing.assert_allclose(moved[1:] - moved[:1], expected[1:] * (1 + 0.005 / 0.1), atol=1e-6)
    sim.restore(saved)
    for _ in range(2):
        sim.step()
    np.testing.assert_array_equal(sim.read().object_position, moved)
    sim.reset()
    before = BatchSimulator(cube, 3, seed=5, threads=1)
    sim.reset(seed=5)  # a reset ends the push
    drive(sim, 2)
    drive(before, 2)
    assert_same(sim.read(), before.read())
    with pytest.raises(InvalidInput, match="force has shape"):
        sim.push([0.0, 0.0, 1.0])
