"""Observations, actions, noise, initial states, and the configuration behind them."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import dexctl
from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.settings import changed, from_plain, to_plain
from learning.envs import (
    DEFAULT_PARTS,
    PARTS,
    EnvConfig,
    ManipulationEnv,
    Observation,
    SetPointAction,
    make_vector,
)
from learning.envs.observation import ORIENTATIONS


def env_config(**settings: Any) -> EnvConfig:
    return from_plain(EnvConfig, settings)


@pytest.fixture(scope="module")
def state(dex5: dexctl.HandModel) -> dexctl.GraspState:
    """Two hands with a number of its own everywhere; finger 4 touches in neither."""
    count = np.arange(30.0).reshape(2, 15)
    touch = np.ones((2, 5), bool)
    touch[:, 4] = False
    normal = np.zeros((2, 5, 3))
    normal[:, :4, 2] = 1.0
    return dexctl.GraspState(
        q=0.01 * count,
        q_target=0.01 * count + 0.005,
        in_contact=touch,
        contact_position=(0.1 + 0.001 * np.arange(30.0)).reshape(2, 5, 3) * touch[..., None],
        contact_normal=normal,
        contact_force=touch * 2.0,
        object_position=np.array([[0.0, 0.0, 0.1], [0.01, 0.0, 0.13]]),
        object_quaternion=np.array([[1.0, 0.0, 0.0, 0.0], [-0.6, 0.8, 0.0, 0.0]]),
        gravity=np.array([[0.0, 0.0, -9.81], [0.0, 6.0, 8.0]]),
        goal_quaternion=np.array([[0.0, 1.0, 0.0, 0.0], [-0.6, 0.0, 0.8, 0.0]]),
        goal_angular_velocity=np.array([[0.0, 0.3, 0.4], [0.5, 0.0, 0.0]]),
    )


def test_layout_is_the_thesis_vector(dex5: dexctl.HandModel, state: dexctl.GraspState) -> None:
    observation = Observation(dex5)
    assert observation.parts == DEFAULT_PARTS
    assert observation.size == 15 + 15 + 15 + 15 + 5
    vector = observation(state)
    assert vector.dtype == np.float32
    expected = np.concatenate(
        [
            state.q,
            state.q_target,
            state.contact_position.reshape(2, 15),
            state.contact_normal.reshape(2, 15),
            state.contact_force,
        ],
        axis=1,
    )
    np.testing.assert_array_equal(vector, expected.astype(np.float32))
    np.testing.assert_array_equal(observation(state[1]), vector[1])
    assert observation.slices["contact_force"] == slice(60, 65)


def test_parts_are_switchable_and_ordered(dex5: dexctl.HandModel, state: dexctl.GraspState) -> None:
    vector = Observation(dex5, ("touch", "object_quaternion", "object_position"))(state)
    np.testing.assert_allclose(
        vector[1], [1, 1, 1, 1, 0, 0.6, -0.8, 0, 0, 0.01, 0, 0.13], atol=1e-7
    )
    for name in PARTS:
        assert Observation(dex5, (name,))(state).shape[1] == Observation(dex5, (name,)).size


def test_orientations_without_jumps_by_hand(
    dex5: dexctl.HandModel, state: dexctl.GraspState
) -> None:
    """Where the object takes x and y, whichever of q and -q it is told."""
    look = Observation(dex5, ("object_rotation",), scaled=True)
    # wxyz (-0.6, 0.8, 0, 0): cos -0.28, sin -0.96 about x
    by_hand = [[1, 0, 0, 0, 1, 0], [1, 0, 0, 0, -0.28, -0.96]]
    np.testing.assert_allclose(look(state), by_hand, atol=1e-6)
    other = replace(state, object_quaternion=-np.asarray(state.object_quaternion))
    np.testing.assert_array_equal(look(other), look(state))


def test_critics_may_see_as_it_is_what_the_policy_is_told_with_noise() -> None:
    parts = ("q", "object_position")
    config = env_config(
        object="cylinder", threads=1, parts=parts, critic_parts=parts, joint_noise=0.1,
        object_pose="touch",
    )  # fmt: skip
    envs = make_vector(config, 3, seed=0)
    seen, _ = envs.reset(seed=0)
    envs.step(np.zeros((3, 15)))
    seen = envs.step(np.zeros((3, 15)))[0]
    assert seen.shape == (3, 36) and envs.state.object_position is not None
    np.testing.assert_allclose(seen[:, 18:33], envs.state.q, atol=1e-6)
    np.testing.assert_allclose(seen[:, 33:], envs.state.object_position, atol=1e-6)
    assert np.abs(seen[:, :15] - seen[:, 18:33]).max() > 0.05
    assert 1e-5 < np.abs(seen[:, 15:18] - seen[:, 33:]).max() < 0.02  # by touch


def test_scaled_observations_by_hand(dex5: dexctl.HandModel, state: dexctl.GraspState) -> None:
    observation = Observation(dex5, tuple(PARTS), scaled=True, centre=(0.0, 0.0, 0.1))
    vector = observation(state)
    at = observation.slices
    middle, half = (dex5.lower + dex5.upper) / 2, (dex5.upper - dex5.lower) / 2
    np.testing.assert_allclose(vector[:, at["q"]], (state.q - middle) / half, atol=1e-6)
    np.testing.assert_allclose(vector[1, at["object_position"]], [0.2, 0.0, 0.6], atol=1e-6)
    np.testing.assert_allclose(vector[:, at["contact_force"]], [[1, 1, 1, 1, 0]] * 2)
    np.testing.assert_allclose(vector[:, at["gravity"]], [[0, 0, -1], [0, 0.6, 0.8]], atol=1e-6)
    position = vector[0, at["contact_position"]].reshape(5, 3)
    np.testing.assert_allclose(position[0], [2.0, 2.02, 0.04], atol=1e-5)
    np.testing.assert_array_equal(position[4], 0.0)
    assert Observation.from_dict(dex5, json.loads(json.dumps(observation.to_dict()))) == observation


def test_observations_stay_in_their_space() -> None:
    for scaled in (False, True):
        config = env_config(
            object="cylinder", parts=tuple(name for name in PARTS if name not in ORIENTATIONS),
            scaled=scaled, normal_noise=0.5, force_noise_share=0.5, threads=1,
        )  # fmt: skip
        env = ManipulationEnv(config, seed=0)
        observation, _ = env.reset(seed=0)
        env.action_space.seed(0)
        for _ in range(20):
            assert observation in env.observation_space
            observation, *_ = env.step(env.action_space.sample())


def test_controllers_see_the_truth() -> None:
    config = env_config(object="cylinder", threads=1)
    plain, noisy = (
        make_vector(config, 2, seed=0),
        make_vector(changed(config, {"joint_noise": 0.1}), 2),
    )
    a, _ = plain.reset(seed=0)
    b, _ = noisy.reset(seed=0)
    np.testing.assert_array_equal(plain.state.q, noisy.state.q)
    assert not np.array_equal(a, b)


def test_actions_and_changes(dex5: dexctl.HandModel, state: dexctl.GraspState) -> None:
    action = SetPointAction(dex5, max_speed=2.0, max_lead=0.25, control_period=0.05)
    values = np.linspace(-1, 1, 15)
    np.testing.assert_allclose(action.to_change(values), 0.1 * values)
    np.testing.assert_allclose(action.from_change(action.to_change(values)), values)
    np.testing.assert_array_equal(action.to_change(3 * np.ones(15)), 0.1)
    np.testing.assert_array_equal(action.from_change(9 * np.ones(15)), 1.0)
    far = replace(state, q_target=np.clip(state.q + 0.2, dex5.lower, dex5.upper))
    reached = far.q_target + action.limited(far, np.full((2, 15), 0.1))
    assert (reached <= np.minimum(far.q + 0.25, dex5.upper) + 1e-12).all()


def test_configurations_go_through_json() -> None:
    config = env_config(object=("cube", "sphere"), axis=(0, 0, -2), gravity=(0, 0, 9.81))
    assert from_plain(EnvConfig, json.loads(json.dumps(to_plain(config)))) == config
    assert config.task.direction == (0.0, 0.0, -1.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_tilt": 0.0}, "max_tilt is 0.0; expected a finite number above 0"),
        ({"joint_noise": -1.0}, "joint_noise is -1.0"),
        ({"drop_distance": np.nan}, "drop_distance is nan"),
        ({"episode_steps": 0}, "episode_steps is 0; expected a whole number from 1 on"),
        ({"episode_steps": 10.5}, "episode_steps is 10.5"),
        ({"axis": (0, 0, 0)}, "axis is"),
        ({"parts": ()}, "parts is"),
        ({"parts": ("q", "q")}, "each named once"),
        ({"object": ()}, "object is"),
    ],
)
def test_bad_settings(options: dict, message: str) -> None:
    with pytest.raises(InvalidInput, match=message):
        env_config(**options)


def test_unknown_names() -> None:
    with pytest.raises(UnknownName, match="unknown observation part 'smell'; known: q, q_target"):
        env_config(parts=("q", "smell"))
    with pytest.raises(UnknownName, match="unknown axis 'up'; known: x, y, z"):
        env_config(axis="up")
    with pytest.raises(UnknownName, match="unknown gravity 'sideways'"):
        make_vector(env_config(gravity="sideways"), 1)


def test_a_pose_that_is_not_tracked(dex5: dexctl.HandModel, state: dexctl.GraspState) -> None:
    blind = replace(state, object_position=None)
    with pytest.raises(InvalidInput, match="'object_position' needs the object's pose"):
        Observation(dex5, ("q", "object_position"))(blind)
