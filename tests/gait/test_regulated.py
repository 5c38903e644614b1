"""RegulatedTurning: what it adds to who turns the object, and an object that does not wander."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dexctl import GraspState, InvalidInput, UnknownName, controllers
from dexctl.controller import Controller
from dexctl.gait import CommandedTurning, CoordinatedGait, GoalSteering, RegulatedTurning
from dexctl.rotations import from_rotation_vector, multiply
from dexctl.sim import BatchSimulator, Scene


@pytest.fixture(scope="module")
def start(cylinder: Scene) -> GraspState:
    with BatchSimulator(cylinder, 3, seed=0, threads=1) as sim:
        sim.step()
        return sim.read()


def moved(state: GraspState, by: list[list[float]]) -> GraspState:
    """With the objects so far from where they are [m], and the contacts where they were."""
    assert state.object_position is not None
    return replace(state, object_position=state.object_position + np.array(by))


def motion_of_contacts(controller: Controller, state: GraspState) -> np.ndarray:
    """Of the points that touch, with what the controller does, ``(N, m, 3)`` [m]."""
    jacobian = controller.hand.contact_jacobian(state.q, state.contact_position)
    return np.einsum("nmij,nj->nmi", jacobian, controller.act(state))


def test_where_nothing_is_off_it_is_the_other_controller(
    cylinder: Scene, start: GraspState
) -> None:
    hand = cylinder.hand
    made = RegulatedTurning(hand, turner=CoordinatedGait(hand))
    np.testing.assert_allclose(made.act(start), CoordinatedGait(hand).act(start), atol=1e-9)
    np.testing.assert_allclose(made.diagnostics["regulation"], 0.0, atol=1e-9)
    assert made.control_period == 0.05
    np.testing.assert_array_equal(made.axis, [0, 0, 1])


def test_contacts_are_moved_as_the_object_has_to_come_back(
    cylinder: Scene, start: GraspState, still: Callable[..., Any]
) -> None:
    """10 mm up at 0.5 / s, and 20 mm aside at 0.25 / s, over 50 ms: 0.25 mm each."""
    turner = still(cylinder.hand)
    made = RegulatedTurning(
        cylinder.hand, turner=turner, height_gain=0.5, centring_gain=0.25, tilt_gain=0.0
    )
    made.act(start)
    off = moved(start, [[0, 0, 0.01], [-0.02, 0, 0], [0, 0, 0]])
    found = motion_of_contacts(made, off)
    assert turner.asked is off
    want = np.array([[0, 0, -0.25e-3], [0.25e-3, 0, 0], [0, 0, 0]])
    touch = start.in_contact
    assert touch.sum(axis=1).min() >= 3
    for row in range(3):  # the inverse is damped
        np.testing.assert_allclose(
            found[row, touch[row]], np.tile(want[row], (touch[row].sum(), 1)), atol=4e-5
        )
    np.testing.assert_allclose(found[~touch], 0.0, atol=1e-12)


def test_a_tilt_is_turned_back_about_the_centre(
    cylinder: Scene, start: GraspState, still: Callable[..., Any]
) -> None:
    """0.1 rad about x at 0.5 / s over 50 ms: -2.5 mrad times the lever."""
    made = RegulatedTurning(cylinder.hand, turner=still(cylinder.hand), tilt_gain=0.5)
    made.act(start)
    assert start.object_quaternion is not None
    tilt = from_rotation_vector(np.array([0.1, 0.0, 0.0]))
    tilted = replace(start, object_quaternion=multiply(tilt[None], start.object_quaternion))
    found = motion_of_contacts(made, tilted)
    assert start.object_position is not None
    lever = start.contact_position - start.object_position[:, None]
    want = np.cross([-0.05 * 0.5 * np.sin(0.1), 0.0, 0.0], lever)
    touch = start.in_contact
    np.testing.assert_allclose(found[touch], want[touch], atol=2e-5)
    # a turn about the axis is none of its business
    made.reset()
    made.act(start)
    turn = from_rotation_vector(np.array([0.0, 0.0, 0.7]))
    made.act(replace(start, object_quaternion=multiply(turn[None], start.object_quaternion)))
    np.testing.assert_allclose(made.diagnostics["regulation"], 0.0, atol=1e-6)


def test_set_points_stay_near_the_joints(
    cylinder: Scene, start: GraspState, still: Callable[..., Any]
) -> None:
    """However far the object is: as with in-grasp manipulation, 0.25 rad, and 2 rad/s."""
    made = RegulatedTurning(cylinder.hand, turner=still(cylinder.hand), height_gain=20.0)
    made.act(start)
    off = moved(start, [[0, 0, -0.05]] * 3)
    q_target = off.q_target
    for _ in range(20):
        change = made.act(replace(off, q_target=q_target))
        assert np.abs(change).max() <= 2.0 * 0.05 + 1e-9
        q_target = q_target + change
    assert np.abs(q_target - off.q).max() <= 0.25 + 1e-9


def test_a_reset_takes_another_place_in_the_hands_that_are_meant(
    cylinder: Scene, start: GraspState, still: Callable[..., Any]
) -> None:
    made = RegulatedTurning(cylinder.hand, turner=still(cylinder.hand))
    made.act(start)
    off = moved(start, [[0, 0, 0.01]] * 3)
    made.reset(mask=np.array([True, False, False]))
    change = made.act(off)
    np.testing.assert_allclose(change[0], 0.0, atol=1e-9)
    assert np.abs(change[1:]).max(axis=1).min() > 1e-3


def test_a_policys_object_stays_nearer_to_its_place() -> None:
    """An L on its side: alone the policy lets it go further from the middle, with the same seed."""
    scene = Scene.build("dex5", "l_shape", (0.0, -9.81, 0.0))
    away = {}
    for name in ("dex5-l-any", "regulated:dex5-l-any"):
        controller = controllers.resolve(name, scene.hand)
        with BatchSimulator(scene, 6, seed=0, threads=1) as sim:
            found, first = [], sim.read().object_position
            assert first is not None
            turned = np.zeros(6)
            for _ in range(300):
                state = sim.read()
                assert state.object_position is not None
                found.append(np.linalg.norm(state.object_position - first, axis=1))
                turned += sim.object_angular_velocity[:, 2] * 0.05
                sim.write(state.q_target + controller.act(state))
                sim.step()
        away[name] = np.mean(found)
        assert np.median(turned) > 6.0
    assert away["regulated:dex5-l-any"] < 0.85 * away["dex5-l-any"]


def test_by_name_with_a_pace_and_in_others(cylinder: Scene) -> None:
    hand = cylinder.hand
    made = controllers.resolve("regulated:dex5-easy-any@0.8", hand)
    assert isinstance(made, RegulatedTurning)
    assert made.turner.pace == 0.8  # type: ignore[attr-defined]
    gait = controllers.make("regulated", hand, turner="coordinated", axis=(0, 0, -1), tilt_gain=1)
    assert isinstance(gait, RegulatedTurning)
    np.testing.assert_array_equal(gait.axis, [0, 0, -1])
    assert gait.config.tilt_gain == 1
    assert gait.tracks
    centred = controllers.resolve("centred:dex5-easy-any@0.8", hand)
    assert isinstance(centred, RegulatedTurning)
    assert (centred.config.height_gain, centred.config.centring_gain) == (0.0, 0.5)
    assert not gait.turner.tracks
    assert GoalSteering(hand, turner=gait).tracks
    assert CommandedTurning(hand, [gait.turner, gait]).tracks
    assert not CommandedTurning(hand, [gait.turner]).tracks
    both = controllers.resolve("sequence:regulated:dex5-cube-z,regulated:dex5-cube-x", hand)
    assert both.tracks


def test_what_it_refuses(cylinder: Scene, start: GraspState, still: Callable[..., Any]) -> None:
    hand = cylinder.hand
    for name, said in (
        ("hold", "Hold does not turn about one axis; expected one that does"),
        ("dex5-axes", "does not turn about one axis"),
    ):
        with pytest.raises(InvalidInput, match=said):
            controllers.resolve(f"regulated:{name}", hand)
    with pytest.raises(UnknownName, match="walk"):
        controllers.resolve("regulated:walk", hand)
    with pytest.raises(InvalidInput, match="expected regulated:NAME"):
        controllers.resolve("regulated", hand)
    with pytest.raises(InvalidInput, match="turner is None; expected a Controller"):
        RegulatedTurning(hand, turner=None)  # type: ignore[arg-type]
    with pytest.raises(InvalidInput, match="tilt_gain is -1"):
        RegulatedTurning(hand, turner=still(hand), tilt_gain=-1.0)
    made = RegulatedTurning(hand, turner=still(hand))
    made.act(replace(start, object_quaternion=None))  # it needs none where tilt is left alone
    levelling = RegulatedTurning(hand, turner=still(hand), tilt_gain=0.5)
    for one, without in ((made, "object_position"), (levelling, "object_quaternion")):
        with pytest.raises(InvalidInput, match="expected a tracked object"):
            one.act(replace(start, **{without: None}))
