"""Objects that nothing tracks: their pose from the start, and from what the fingers feel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dexctl import controllers
from dexctl.enclosing import enclosing_centre
from dexctl.grasp import TouchTracking
from dexctl.rotations import from_rotation_vector, inverse, multiply, rotation_vector
from dexctl.settings import from_plain
from dexctl.sim import SceneConfig, Shape, Simulation
from dexctl.state import GraspState


def scene(**changes: object) -> SceneConfig:
    usual = {"object": "cylinder", "object_pose": "odometry", "threads": 1}
    return from_plain(SceneConfig, usual | changes)


def off(a: GraspState, b: GraspState) -> np.ndarray:
    """The angle between the orientations that two states tell, ``(N,)`` [rad]."""
    assert a.object_quaternion is not None
    assert b.object_quaternion is not None
    turn = multiply(a.object_quaternion, inverse(b.object_quaternion))
    return np.linalg.norm(rotation_vector(turn), axis=-1)


def turn(simulation: Simulation, steps: int) -> None:
    igm = controllers.make("igm", simulation.hand)
    for _ in range(steps):
        state = simulation.read()
        simulation.write(state.q_target + igm.act(state))
        simulation.step()


def test_it_follows_the_object() -> None:
    with Simulation(scene(), 3) as simulation:
        assert off(simulation.read(), simulation.state) == pytest.approx(0.0, abs=1e-7)
        np.testing.assert_allclose(
            simulation.read().object_centre(), simulation.state.object_centre()
        )
        start = simulation.state
        turn(simulation, 30)
        came = off(simulation.state, start)
        assert (came > 0.2).all()
        assert (off(simulation.read(), simulation.state) < 0.25 * came).all()
        assert (off(simulation.read(), simulation.state) > 1e-6).all()  # it does not look


@pytest.mark.parametrize("touch", ["joint-torque", "binary"])
@pytest.mark.parametrize("pose", ["odometry", "unknown"])
def test_touch_is_told_without_the_true_pose(touch: str, pose: str) -> None:
    """Normals point to where the object is thought to be, not to where it is."""
    with Simulation(scene(touch=touch, object_pose=pose), 2) as simulation:
        turn(simulation, 40)
        known = simulation.read().object_position  # that the next normals can go by
        turn(simulation, 1)
        seen = simulation.read()
        tip = simulation.hand.configuration(seen.q).fingertip_position
        if pose == "odometry":
            assert known is not None
            assert np.abs(known - simulation.state.object_centre()).max() > 1e-5  # it is not there
            centre = known
        else:
            assert known is None and seen.object_quaternion is None
            assert seen.in_contact.all()  # then it is all of them that it is between
            centre = enclosing_centre(tip)
        inward = centre[:, None] - tip
        inward /= np.linalg.norm(inward, axis=-1, keepdims=True)
        expected = np.where(seen.in_contact[..., None], inward, 0.0)
        np.testing.assert_allclose(seen.contact_normal, expected, atol=1e-9)


def test_nothing_may_be_known_of_the_pose() -> None:
    with Simulation(scene(object_pose="unknown", sensor_latency=0.1), 2) as simulation:
        turn(simulation, 10)  # which goes by touch alone
        seen = simulation.read()
        assert seen.object_position is None and seen.object_quaternion is None
        assert simulation.state.object_position is not None


@pytest.mark.parametrize("pose", ["touch", "odometry"])
def test_an_episode_that_begins_changes_no_other(pose: str) -> None:
    own = scene(object_pose=pose)
    with Simulation(own, 3) as simulation, Simulation(own, 3) as other:
        for one in (simulation, other):
            turn(one, 10)
        simulation.reset(None, np.array([False, True, False]))
        seen = simulation.read()
        assert off(seen, simulation.state)[1] == pytest.approx(0.0, abs=1e-7)
        for one in (simulation, other):
            turn(one, 5)
        a, b = simulation.read(), other.read()
        assert a.object_quaternion is not None
        assert b.object_quaternion is not None
        np.testing.assert_array_equal(a.object_quaternion[[0, 2]], b.object_quaternion[[0, 2]])


@pytest.mark.parametrize("pose", ["touch", "odometry"])
def test_it_goes_on_to_the_bit_where_it_was_saved(pose: str) -> None:
    with Simulation(scene(joint_noise=0.01, object_pose=pose), 2) as simulation:
        turn(simulation, 5)
        saved = simulation.save()
        turn(simulation, 5)
        expected = simulation.read().object_quaternion
        simulation.restore(saved)
        turn(simulation, 5)
        np.testing.assert_array_equal(simulation.read().object_quaternion, expected)


def turn_by(name: str, simulation: Simulation, seconds: float, axis: tuple | None = None) -> None:
    controller = controllers.resolve(name, simulation.hand, axis=axis)
    for _ in range(round(seconds / simulation.control_period)):
        state = simulation.read()
        simulation.write(state.q_target + controller.act(state))
        simulation.step()


def test_a_known_shape_tells_how_it_is_turned_where_odometry_is_lost() -> None:
    """A learned gait, which lets contacts slip as it likes, turns a cube for ten seconds."""
    away = {}
    for pose in ("odometry", "touch"):
        with Simulation(scene(object="cube", object_pose=pose), 4) as simulation:
            start = simulation.state
            turn_by("dex5-cube-x", simulation, 10.0, (1, 0, 0))
            seen, there = simulation.read(), simulation.state
            assert (off(there, start) > 0.3).all()
            away[pose] = off(seen, there), seen.object_centre() - there.object_centre()
    assert away["touch"][0].max() < 0.25 < 0.5 < np.median(away["odometry"][0])
    assert np.abs(away["touch"][1]).max() < 0.015


def test_every_object_is_found_by_its_own_shape() -> None:
    objects = ("cube", "l_shape")
    with Simulation(scene(object=objects, object_pose="touch"), 4) as simulation:
        turn_by("dex5-nine", simulation, 5.0)
        assert simulation.objects == ("cube", "cube", "l_shape", "l_shape")
        assert off(simulation.read(), simulation.state).max() < 0.25


@pytest.mark.parametrize("pose", ["touch", "odometry"])
def test_what_was_read_stays_as_it_was(pose: str) -> None:
    with Simulation(scene(object_pose=pose), 2) as simulation:
        turn(simulation, 5)
        seen = simulation.read()
        assert seen.object_position is not None and seen.object_quaternion is not None
        before = seen.object_position.copy(), seen.object_quaternion.copy()
        simulation.reset(None, np.array([True, False]))
        simulation.read()
        np.testing.assert_array_equal(seen.object_position, before[0])
        np.testing.assert_array_equal(seen.object_quaternion, before[1])


@pytest.mark.parametrize("name", ["cube", "u_shape"])
def test_an_object_that_is_put_in_a_little_off_is_found(name: str) -> None:
    """By 5 mm and 0.1 rad, as somebody's hand may be; a second later it is not a third of that."""
    with Simulation(scene(object=name, object_pose="tracked"), 6) as simulation:
        shape = Shape.of_body(simulation.sim.groups[0].scene.model)
        tracking = TouchTracking(simulation.hand, shape)
        tracking.start(6)
        there = simulation.state
        assert there.object_position is not None and there.object_quaternion is not None
        way = np.random.default_rng(0).normal(size=(2, 6, 3))
        way /= np.linalg.norm(way, axis=-1, keepdims=True)
        wrong = multiply(from_rotation_vector(0.1 * way[1]), there.object_quaternion)
        tracking.place(np.ones(6, bool), there.object_position + 0.005 * way[0], wrong)
        igm = controllers.make("igm", simulation.hand)
        for _ in range(20):
            state = simulation.read()
            told = tracking.track(replace(state, object_position=None, object_quaternion=None))
            simulation.write(state.q_target + igm.act(state))
            simulation.step()
        assert off(told, state).max() < 0.035
        assert state.object_position is not None
        across = tracking.position[:, :2] - state.object_position[:, :2]
        assert np.linalg.norm(across, axis=1).max() < 0.002
