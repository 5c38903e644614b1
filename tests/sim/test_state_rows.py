"""Rows of states that are kept and put back, steps and checks of some environments only."""

from __future__ import annotations

import numpy as np
import pytest

from dexctl.exceptions import InvalidInput, SimulationError
from dexctl.grasp import check_stable
from dexctl.sim import BatchSimulator, GroupedSimulator, Scene, StateRows
from dexctl.state import GraspState


@pytest.fixture(scope="module")
def cube() -> Scene:
    return Scene.build("dex5", "cube", "up")


def drive(sim: BatchSimulator, steps: int) -> None:
    for k in range(steps):
        sim.write(sim.read().q_target + 0.02 * np.sin(0.7 * k + np.arange(sim.hand.nq)))
        sim.step()


def assert_same(a: GraspState, b: GraspState, but: tuple[str, ...] = ()) -> None:
    for name in set(a.__dataclass_fields__) - set(but):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


def test_rows_go_on_as_they_would_have_in_a_batch_of_another_size(cube: Scene) -> None:
    sim = BatchSimulator(cube, 4, seed=3)
    drive(sim, 4)
    kept = sim.rows()
    assert len(kept) == 4 and (kept.physics[0].nbytes + kept.q_target[0].nbytes) < 600
    other = BatchSimulator(cube, 6, seed=9)
    mask = np.array([False, True, False, True, False, False])
    before = other.read()
    other.place(kept.take([2, 0]), mask)
    assert_same(other.read()[~mask], before[~mask])
    placed, there = other.read()[mask], sim.read()[[2, 0]]
    np.testing.assert_array_equal(placed.q, there.q)
    np.testing.assert_array_equal(placed.time, 0.0)
    # touch is felt anew: it is what a single physics step from there begins with
    stepped = BatchSimulator(cube, 2, control_period=0.005, substeps=1)
    stepped.place(kept.take([2, 0]))
    stepped.step()
    for name in ("in_contact", "contact_position", "contact_normal", "contact_force"):
        np.testing.assert_array_equal(getattr(placed, name), getattr(stepped.read(), name))
    drive(sim, 3)
    other.write(np.zeros((6, 15)))
    other.place(kept.take([2, 0]), mask)
    drive(other, 3)
    assert_same(other.read()[mask], sim.read()[[2, 0]], but=("time",))


def test_rows_are_copies_and_add_up(cube: Scene) -> None:
    sim = BatchSimulator(cube, 3, seed=0)
    kept = sim.rows(np.array([True, False, True]))
    first = kept.physics.copy()
    drive(sim, 2)
    np.testing.assert_array_equal(kept.physics, first)
    both = StateRows.concatenate([kept, sim.rows([1])])
    assert len(both) == 3
    np.testing.assert_array_equal(both.take([2]).physics, sim.rows([1]).physics)
    with pytest.raises(InvalidInput, match="0 kinds of scenes; expected one"):
        StateRows.concatenate([])
    with pytest.raises(InvalidInput, match="StateRows of the shapes"):
        StateRows(physics=np.zeros((2, 4)), q_target=np.zeros((3, 4)))
    with pytest.raises(SimulationError, match=r"expected \(1, \d+\) and 15"):
        sim.place(both, np.array([True, False, False]))


def test_a_grasp_may_be_set_in_motion(cube: Scene) -> None:
    sim = BatchSimulator(cube, 2, seed=0)
    drive(sim, 3)
    rows, state = sim.rows(), sim.read()
    assert state.object_position is not None and state.object_quaternion is not None
    qvel = rows.physics[:, 1 + cube.model.nq : 1 + cube.model.nq + cube.model.nv]
    again = BatchSimulator(cube, 2, seed=5)
    again.set_grasp(
        state.q,
        state.q_target,
        state.object_position,
        state.object_quaternion,
        joint_velocity=qvel[:, cube.qvel_columns],
        object_velocity=qvel[:, cube.object_qvel],
    )
    np.testing.assert_allclose(again.rows().physics[:, 1:], rows.physics[:, 1:], atol=1e-15)
    with pytest.raises(InvalidInput, match=r"joint_velocity has shape \(3,\); expected \(2, 15\)"):
        again.set_grasp(
            state.q, state.q_target, state.object_position, state.object_quaternion,
            joint_velocity=np.zeros(3),
        )  # fmt: skip


def test_a_step_of_some_is_their_step_of_all(cube: Scene) -> None:
    some, every = BatchSimulator(cube, 4, seed=1), BatchSimulator(cube, 4, seed=1)
    mask = np.array([True, False, False, True])
    before = some.read()
    for _ in range(3):
        for sim, which in ((some, mask), (every, None)):
            sim.write(sim.read().q_target + 0.01)
            sim.step(which)
    target = every.read().q_target
    assert_same(some.read()[mask], every.read()[mask])
    np.testing.assert_array_equal(some.object_angular_velocity[mask],
                                  every.object_angular_velocity[mask])  # fmt: skip
    for name in ("q", "contact_force", "object_position", "time"):
        np.testing.assert_array_equal(
            getattr(some.read(), name)[~mask], getattr(before, name)[~mask]
        )
    np.testing.assert_array_equal(some.read().q_target, target)
    some.step(np.zeros(4, bool))
    np.testing.assert_allclose(some.time, [0.15, 0, 0, 0.15])


def test_groups_step_some_of_theirs(cube: Scene) -> None:
    sim = GroupedSimulator([(cube, 2), (Scene.build("dex5", "sphere", "up"), 2)])
    sim.step(np.array([False, True, True, False]))
    np.testing.assert_array_equal(sim.time, [0, 0.05, 0.05, 0])


def let_go(sim: BatchSimulator, mask: np.ndarray) -> None:
    """Open the hands in ``mask``."""
    state = sim.read()
    assert state.object_position is not None and state.object_quaternion is not None
    target = np.where(mask[:, None], sim.scene.open_q, state.q_target)
    sim.set_grasp(
        np.where(mask[:, None], sim.scene.open_q, state.q), target,
        state.object_position, state.object_quaternion,
    )  # fmt: skip


def test_a_check_stops_early_and_leaves_the_others(cube: Scene) -> None:
    sim = BatchSimulator(cube, 3, seed=0, disturbance=0.0)
    let_go(sim, np.array([False, True, False]))
    full = check_stable(sim, 0.5, max_distance=0.02)
    assert full.stable.tolist() == [True, False, True]
    mask = np.array([False, True, True])
    found = check_stable(sim, 0.5, max_distance=0.02, early=True, mask=mask, restore=False)
    assert found.stable.tolist() == [False, False, True]
    np.testing.assert_allclose(found.held[1:], full.held[1:])
    assert sim.time[0] == 0 and sim.time[2] == pytest.approx(0.5)
    assert sim.time[1] == pytest.approx(full.held[1] + 0.05)
    with pytest.raises(InvalidInput, match="mask has shape"):
        check_stable(sim, 0.5, mask=np.ones(2, bool))


def test_a_grasp_that_lies_on_the_palm_is_not_one_of_fingertips() -> None:
    scene = Scene.build("dex5", "cube", "up")
    sim = BatchSimulator(scene, 2, seed=0, disturbance=0.0)
    state = sim.read()
    assert state.object_position is not None and state.object_quaternion is not None
    position = state.object_position.copy()
    position[1] = (0.0, 0.0, -0.014 + scene.object_width / 2)  # on the palm
    q = np.where([[False], [True]], scene.open_q, state.q)
    sim.set_grasp(q, np.where([[False], [True]], scene.open_q, state.q_target), position,
                  state.object_quaternion)  # fmt: skip
    assert check_stable(sim, 0.2).stable.tolist() == [True, True]
    assert check_stable(sim, 0.2, fingertips_only=True).stable.tolist() == [True, False]
