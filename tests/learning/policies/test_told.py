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
from learning import policies
from learning.envs import Observation, SetPointAction
from learning.policies import Layer, Policy, PolicySpec

GOAL = np.array([0.8, 0.0, 0.0, 0.6])
SPIN = np.array([0.0, -0.4, 0.0])
TRAINED = {"env": {"task": {"turning": {"command_speed_range": [0.3, 0.5]}}}}


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
