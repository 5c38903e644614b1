"""Policies that are told what is wanted: by the state, or once for all like other controllers."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dexctl
from dexctl import controllers
from dexctl.exceptions import InvalidInput
from dexctl.rotations import inverse, multiply, rotation_vector
from dexctl.sim import BatchSimulator, Scene
from learning import policies
from learning.envs import Observation, SetPointAction
from learning.policies import Layer, Policy, PolicySpec

GOAL = np.array([0.8, 0.0, 0.0, 0.6])
SPIN = np.array([0.0, -0.4, 0.0])
TURNING = {"commands": ["x", "-y", "z"], "command_speed_range": [0.3, 0.5]}
TRAINED = {"env": {"task": {"turning": TURNING}}}


def made(hand: dexctl.HandModel, *parts: str) -> tuple[list[Layer], PolicySpec]:
    seen = Observation(hand, ("q", *parts))
    action = SetPointAction(hand, max_speed=2.0, max_lead=0.25, control_period=0.05)
    random, sizes = np.random.default_rng(0), (seen.size, 8, 15)
    layers = [
        Layer(random.standard_normal((out, into)), 0.1 * random.standard_normal(out))
        for into, out in pairwise(sizes)
    ]
    return layers, PolicySpec.of(hand, seen, action, "dex5")


@pytest.fixture(scope="module")
def state(dex5: dexctl.HandModel) -> dexctl.GraspState:
    q = dex5.posture({})[None].repeat(2, axis=0)
    return dexctl.GraspState(
        q=q,
        q_target=q,
        in_contact=np.zeros((2, 5), bool),
        contact_position=np.zeros((2, 5, 3)),
        contact_normal=np.zeros((2, 5, 3)),
        contact_force=np.zeros((2, 5)),
        object_quaternion=np.array([[1.0, 0.0, 0.0, 0.0], [0.6, 0.8, 0.0, 0.0]]),
    )


@pytest.mark.parametrize(
    ("part", "needed"),
    [
        ("touch", False),
        ("goal_quaternion", False),
        ("goal_rotation", True),
        ("object_position", True),
        ("object_rotation", True),
    ],
)
def test_policies_say_whether_they_need_the_objects_pose(
    dex5: dexctl.HandModel, part: str, needed: bool
) -> None:
    assert Policy(dex5, *made(dex5, part)).tracks is needed


@pytest.mark.parametrize(
    ("part", "name", "value", "keyword"),
    [
        ("goal_rotation", "goal_quaternion", GOAL, "goal"),
        ("goal_angular_velocity", "goal_angular_velocity", SPIN, "angular_velocity"),
    ],
)
def test_what_the_state_does_not_tell(
    dex5: dexctl.HandModel, state: dexctl.GraspState, part: str, name: str, value: Any, keyword: str
) -> None:
    layers, spec = made(dex5, part)
    told = replace(state, **{name: np.tile(value, (2, 1))})
    expected = Policy(dex5, layers, spec).act(told)
    once: dict[str, Any] = {keyword: value}
    policy = Policy(dex5, layers, spec, **once)
    np.testing.assert_array_equal(policy.act(state), expected)
    np.testing.assert_allclose(policy.act(state[1]), expected[1], atol=1e-12)
    other = replace(state, **{name: np.tile(-value[::-1], (2, 1))})
    np.testing.assert_array_equal(  # the state's own counts
        policy.act(other), Policy(dex5, layers, spec).act(other)
    )
    assert (policy.act(other) != expected).any()
    with pytest.raises(InvalidInput, match=f"{part!r} needs"):
        Policy(dex5, layers, spec).act(state)


def test_an_axis_is_a_command(
    dex5: dexctl.HandModel, state: dexctl.GraspState, tmp_path: Path
) -> None:
    layers, spec = made(dex5, "goal_angular_velocity")
    path = tmp_path / "commanded.npz"
    policies.save(path, layers, spec, {"trained": TRAINED})
    found = controllers.resolve(str(path), dex5, axis=(0.0, -1.0, 0.0))
    expected = Policy(dex5, layers, spec, angular_velocity=SPIN).act(state)
    np.testing.assert_allclose(found.act(state), expected, atol=1e-12)
    policies.save(path, layers, spec)
    with pytest.raises(InvalidInput, match="does not say at which speeds"):
        controllers.resolve(str(path), dex5, axis=(0.0, -1.0, 0.0))


@pytest.mark.parametrize(
    ("told", "message"),
    [
        ({"axis": "y"}, r"angular_velocity is \(0, 0.4, 0\) rad/s; .* commands x, -y, z at 0.3 to"),
        ({"axis": (1.0, 0.0, 1.0)}, r"angular_velocity is \(0.283, 0, 0.283\) rad/s"),
        ({"angular_velocity": (0.0, 0.0, 1.0)}, "at 0.3 to 0.5 rad/s"),
        ({"angular_velocity": (0.0, 0.0, 0.2)}, "at 0.3 to 0.5 rad/s"),
        ({"angular_velocity": (0.0, 0.0, -0.4)}, r"angular_velocity is \(0, 0, -0.4\)"),
    ],
)
def test_what_it_was_never_told_is_refused(
    dex5: dexctl.HandModel, tmp_path: Path, told: dict[str, Any], message: str
) -> None:
    layers, spec = made(dex5, "goal_angular_velocity")
    path = tmp_path / "commanded.npz"
    policies.save(path, layers, spec, {"trained": TRAINED})
    with pytest.raises(InvalidInput, match=message):
        policies.load(path, **told)
    for known in (0.3 * SPIN / 0.4, 0.5 * SPIN / 0.4, (0.0, 0.0, 0.35)):
        policies.load(path, angular_velocity=known)
    anywhere = {**TURNING, "commands": ["x", "any"]}
    policies.save(path, layers, spec, {"trained": {"env": {"task": {"turning": anywhere}}}})
    assert policies.load(path, axis=(1.0, 0.0, 1.0)).commanded == (("x", "any"), (0.3, 0.5))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"goal": GOAL}, "goal is .* was not trained to be told; expected None"),
        ({"angular_velocity": (1.0, 0.0)}, "angular_velocity is .* expected 3 finite numbers"),
        ({"angular_velocity": (1.0, 0.0, np.nan)}, "expected 3 finite numbers"),
    ],
)
def test_bad_input(dex5: dexctl.HandModel, settings: dict[str, Any], message: str) -> None:
    layers, spec = made(dex5, "goal_angular_velocity")
    with pytest.raises(InvalidInput, match=message):
        Policy(dex5, layers, spec, **settings)


def test_a_goal_is_an_orientation(dex5: dexctl.HandModel) -> None:
    layers, spec = made(dex5, "goal_quaternion")
    with pytest.raises(InvalidInput, match="expected a unit quaternion"):
        Policy(dex5, layers, spec, goal=(1.0, 1.0, 0.0, 0.0))


def test_a_policy_for_one_axis_in_an_image_of_the_hand(
    dex5: dexctl.HandModel, state: dexctl.GraspState, tmp_path: Path
) -> None:
    """What turns about z turns about -z in the mirror; about x it is refused, nothing made up."""
    layers, spec = made(dex5, "gravity", "object_quaternion")
    turning = {"env": {"task": {"turning": {"axis": "z", "commands": []}}}}
    path = tmp_path / "z.npz"
    policies.save(path, layers, spec, {"trained": turning})
    tilted = replace(state, gravity=np.array([[0.0, 3.0, -9.0], [1.0, 2.0, -9.5]]))
    tilted = replace(tilted, q=tilted.q + np.linspace(-0.1, 0.1, 15))
    one, other = policies.load(path), policies.load(path, axis="-z")
    assert (one.axis, other.axis) == ((0.0, 0.0, 1.0), (0.0, 0.0, -1.0))
    assert other.symmetry is not None
    image = other.symmetry.of_state(tilted)
    expected = other.symmetry.of_joints(one.act(tilted))
    np.testing.assert_allclose(other.act(image), expected, atol=1e-12)
    assert np.abs(other.act(tilted) - one.act(tilted)).max() > 1e-3
    assert other.turned_to((0.0, 0.0, 2.0)).axis == (0.0, 0.0, 1.0)
    assert policies.load(path, axis="z").symmetry is None
    named = controllers.resolve(str(path), dex5, axis=(0.0, 0.0, -1.0))
    np.testing.assert_array_equal(named.act(tilted), other.act(tilted))
    with pytest.raises(
        InvalidInput, match=r"axis is \(1, 0, 0\); .* make \(0, 0, -1\), \(0, 0, 1\)"
    ):
        policies.load(path, axis="x")


def test_a_command_that_was_always_about_one_axis(
    dex5: dexctl.HandModel, state: dexctl.GraspState, tmp_path: Path
) -> None:
    """It is told the one axis that it knows, in the image where that is the one asked for."""
    layers, spec = made(dex5, "goal_angular_velocity")
    turning = {"commands": ["x"], "command_speed_range": [0.3, 0.5]}
    path = tmp_path / "x.npz"
    policies.save(path, layers, spec, {"trained": {"env": {"task": {"turning": turning}}}})
    found = policies.load(path, axis=(-1.0, 0.0, 0.0))
    assert found.axis == (-1.0, 0.0, 0.0)
    assert found.symmetry is not None
    alone = Policy(dex5, layers, spec, angular_velocity=(0.4, 0.0, 0.0))
    image = found.symmetry.inverse.of_state(state)
    expected = found.symmetry.of_joints(alone.act(image))
    np.testing.assert_allclose(found.act(state), expected, atol=1e-12)


def test_a_policy_for_goals_turns_about_any_axis(dex5: dexctl.HandModel) -> None:
    """Goals that go ahead of the object, told 0.5 rad/s for 3 s about axes that nobody trained."""
    controller = controllers.resolve("pursuing:dex5-cube-goals", dex5)
    scene, told = Scene.build(dex5, "cube"), np.array([[0.3, 0.0, 0.4], [0.0, -0.4, 0.3]])
    with BatchSimulator(scene, 2, seed=0, threads=1) as sim:
        begin = sim.read()
        for _ in range(60):
            action = controller.act(replace(sim.read(), goal_angular_velocity=told))
            sim.write(sim.read().q_target + action)
            sim.step()
        came = sim.read()
    assert begin.object_quaternion is not None and came.object_quaternion is not None
    turned = rotation_vector(multiply(came.object_quaternion, inverse(begin.object_quaternion)))
    np.testing.assert_allclose(turned, 3.0 * told, atol=0.3)
