"""ContactOdometry: an object moved by hand-made twists, and one turned without tracking."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dexctl import ContactSwitch, GraspState, HandModel, InGraspManipulation, InvalidInput
from dexctl.gait import CoordinatedGait
from dexctl.grasp.odometry import ContactOdometry
from dexctl.igm import InGraspManipulationConfig
from dexctl.rotations import cross, inverse, multiply, rotation_vector
from dexctl.sim import BatchSimulator, Scene


def _state(hand: HandModel, q: np.ndarray, touch: np.ndarray) -> GraspState:
    tip = hand.fingertip_positions(q)
    return GraspState(
        q=q,
        q_target=q,
        in_contact=touch,
        contact_position=np.where(touch[..., None], tip, np.nan),
        contact_normal=np.where(touch[..., None], [1.0, 0.0, 0.0], np.nan),
        contact_force=np.ones(touch.shape),
    )


def _carried(hand: HandModel, q: np.ndarray, twist: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Joints after the fingertips went with an object's small ``twist`` about ``centre``."""
    tip = hand.fingertip_positions(q)
    wanted = tip + twist[:, None, :3] + cross(twist[:, None, 3:], tip - centre[:, None])
    for _ in range(10):
        now = hand.configuration(q)
        jacobian = now.contact_jacobian(now.fingertip_position).reshape(len(q), -1, hand.nq)
        error = (wanted - now.fingertip_position).reshape(len(q), -1, 1)
        q = q + np.linalg.lstsq(jacobian[0], error[0], rcond=None)[0].T
    return q


def test_it_follows_a_known_twist(dex5: HandModel) -> None:
    q = np.tile([0.0, 0.75, -1.5], 5)[None]
    touch = np.ones((1, 5), bool)
    centre = dex5.fingertip_positions(q).mean(axis=1)
    odometry = ContactOdometry(dex5, 0.05)
    odometry.start(1)
    odometry.place(np.array([True]), centre)
    twist = np.array([[0.0004, -0.0002, 0.0003, 0.002, -0.001, 0.004]])
    odometry.update(_state(dex5, q, touch), dex5.configuration(q), touch)
    q = _carried(dex5, q, twist, centre)
    odometry.update(_state(dex5, q, touch), dex5.configuration(q), touch)
    np.testing.assert_allclose(odometry.position - centre, twist[:, :3], atol=2e-5)
    np.testing.assert_allclose(rotation_vector(odometry.quaternion), twist[:, 3:], atol=5e-5)


def test_two_fingers_say_nothing(dex5: HandModel) -> None:
    q = np.tile([0.0, 0.75, -1.5], 5)[None]
    touch = np.array([[True, True, False, False, False]])
    odometry = ContactOdometry(dex5, 0.05)
    odometry.start(1)
    for step in range(3):
        moved = q + 0.01 * step
        odometry.update(_state(dex5, moved, touch), dex5.configuration(moved), touch)
    np.testing.assert_array_equal(odometry.position, 0.0)


def test_it_goes_on_from_where_tracking_ended(dex5: HandModel) -> None:
    odometry = ContactOdometry(dex5, 0.05)
    odometry.start(2)
    position, quaternion = np.full((2, 3), 0.1), np.tile([0.6, 0.8, 0.0, 0.0], (2, 1))
    odometry.follow(position, quaternion)
    odometry.place(np.array([True, False]), np.zeros((1, 3)))
    np.testing.assert_array_equal(odometry.position, [[0.0] * 3, [0.1] * 3])
    np.testing.assert_array_equal(odometry.quaternion, [[1, 0, 0, 0], [0.6, 0.8, 0, 0]])
    np.testing.assert_array_equal(position, 0.1)  # the caller's array is not written to


def test_a_wrong_place_is_refused_and_nothing_is_lost(dex5: HandModel) -> None:
    odometry = ContactOdometry(dex5, 0.05)
    odometry.start(2)
    first, centre = np.array([True, False]), np.full(3, 0.1)
    odometry.place(first, centre)
    for rows, place, turn, said in (
        (np.array([True]), centre, None, "mask has shape"),
        (first, centre[:2], None, "expected 3 finite numbers, or 1 times 3"),
        (first, [0.0, np.nan, 0.0], None, "position is array"),
        (first, centre, np.array([2.0, 0.0, 0.0, 0.0]), "expected a unit quaternion"),
    ):
        with pytest.raises(InvalidInput, match=said):
            odometry.place(rows, place, turn)  # type: ignore[arg-type]
    np.testing.assert_array_equal(odometry.position, [[0.1] * 3, [0.0] * 3])
    np.testing.assert_array_equal(odometry.quaternion, [[1, 0, 0, 0]] * 2)


def test_objects_begin_at_their_contacts_and_again_when_forgotten(dex5: HandModel) -> None:
    q = np.tile([0.0, 0.75, -1.5], 5)[None].repeat(2, axis=0)
    touch = np.ones((2, 5), bool)
    touch[1, 2:] = False
    odometry = ContactOdometry(dex5, 0.05)
    odometry.start(2)
    state, now = _state(dex5, q, touch), dex5.configuration(q)
    seen = odometry.track(state, now, touch)
    tip = now.fingertip_position
    assert seen.object_position is not None
    np.testing.assert_allclose(
        seen.object_position, [tip[0].mean(axis=0), tip[1, :2].mean(axis=0)], atol=1e-6
    )
    np.testing.assert_array_equal(seen.object_quaternion, [[1.0, 0, 0, 0]] * 2)
    odometry.position = odometry.position + 0.02
    odometry.forget(np.array([False, True]))
    again = odometry.track(state, now, np.zeros_like(touch))
    assert again.object_position is not None
    np.testing.assert_allclose(again.object_position[0], tip[0].mean(axis=0) + 0.02, atol=1e-6)
    np.testing.assert_allclose(again.object_position[1], tip[1, :2].mean(axis=0), atol=1e-6)


@pytest.mark.parametrize("name", ["in-grasp", "switch, guarded"])
def test_controllers_know_where_an_untracked_object_is(dex5: HandModel, name: str) -> None:
    scene = Scene.build(dex5, "cylinder", "up")
    sim = BatchSimulator(scene, 2, seed=0)
    controller = {
        "in-grasp": lambda: InGraspManipulation(dex5, twist=(0.002, 0, 0, 0, 0, 0.2)),
        "switch, guarded": lambda: ContactSwitch(dex5, kind="guarded"),
    }[name]()
    state = sim.read()
    start, turned = np.asarray(state.object_position), np.asarray(state.object_quaternion)
    part = getattr(controller, "_part", controller)
    for _ in range(60):
        unseen = replace(state, object_position=None, object_quaternion=None)
        sim.write(state.q_target + controller.act(unseen))
        sim.step()
        state = sim.read()
    reckoned = part._odometry.position - start
    moved = np.asarray(state.object_position) - start
    # the middle of the contacts, where the odometry begins, is not the centre: up to 5 mm
    np.testing.assert_allclose(reckoned, moved, atol=0.005)
    about = rotation_vector(multiply(np.asarray(state.object_quaternion), inverse(turned)))
    np.testing.assert_allclose(rotation_vector(part._odometry.quaternion), about, atol=0.1)
    if name == "in-grasp":
        assert about[:, 2].min() > 0.3


def test_the_thesis_takes_the_centroid(dex5: HandModel) -> None:
    q = np.tile([0.0, 0.75, -1.5], 5)[None]
    state = _state(dex5, q, np.ones((1, 5), bool))
    aside = np.array([0.01, 0.0, 0.0])
    controller = InGraspManipulation(dex5, InGraspManipulationConfig.thesis())
    moved = replace(state, contact_position=state.contact_position + aside)
    for seen in (state, moved):
        controller.act(seen)
        centroid = seen.contact_position.mean(axis=1)
        np.testing.assert_allclose(controller.diagnostics["origin"], centroid)


def test_the_gait_knows_where_the_object_is_without_tracking(dex5: HandModel) -> None:
    sim = BatchSimulator(Scene.build(dex5, "cube", "down"), 4, seed=0)
    gait = CoordinatedGait(dex5)
    state = sim.read()
    start = np.asarray(state.object_position)
    offset = 0.0
    for step in range(240):
        unseen = replace(state, object_position=None, object_quaternion=None)
        sim.write(state.q_target + gait.act(unseen))
        sim.step()
        state = sim.read()
        if step == 0:
            offset = gait.diagnostics["origin"] - start
    there = np.asarray(state.object_position)
    error = np.linalg.norm(gait.diagnostics["origin"] - offset - there, axis=-1)
    moved = np.linalg.norm(there - start, axis=-1)
    assert (moved < 0.03).all()
    assert (error < 0.02).all()


def test_the_callers_arrays_are_its_own(dex5: HandModel) -> None:
    """A pose written into the buffer of the one before moved the object that was known."""
    odometry = ContactOdometry(dex5, 0.05)
    odometry.start(2)
    position, quaternion = np.full((2, 3), 0.1), np.tile([1.0, 0.0, 0.0, 0.0], (2, 1))
    odometry.follow(position, quaternion)
    position[:], quaternion[:] = 99.0, 0.0
    assert (odometry.position == 0.1).all() and (odometry.quaternion[:, 0] == 1.0).all()
