"""Observations, actions, noise, initial states, and the configuration behind them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import dexctl
from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.streams import Streams
from learning.envs import (
    DEFAULT_PARTS,
    PARTS,
    EnvConfig,
    FingerGaitingEnv,
    InitialStates,
    Observation,
    SetPointAction,
    make_vector,
)
from learning.envs.noise import SensorNoise, observed
from learning.envs.simulation import shares


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


def test_scaled_observations_by_hand(dex5: dexctl.HandModel, state: dexctl.GraspState) -> None:
    observation = Observation(dex5, tuple(PARTS), scaled=True, centre=(0.0, 0.0, 0.1))
    vector = observation(state)
    at = observation.slices
    middle, half = (dex5.lower + dex5.upper) / 2, (dex5.upper - dex5.lower) / 2
    np.testing.assert_allclose(vector[:, at["q"]], (state.q - middle) / half, atol=1e-6)
    np.testing.assert_allclose(vector[1, at["object_position"]], [0.2, 0.0, 0.6], atol=1e-6)
    np.testing.assert_allclose(vector[:, at["contact_force"]], [[1, 1, 1, 1, 0]] * 2)
    position = vector[0, at["contact_position"]].reshape(5, 3)
    np.testing.assert_allclose(position[0], [2.0, 2.02, 0.04], atol=1e-5)
    np.testing.assert_array_equal(position[4], 0.0)
    assert Observation.from_dict(dex5, json.loads(json.dumps(observation.to_dict()))) == observation


def test_observations_stay_in_their_space() -> None:
    for scaled in (False, True):
        config = EnvConfig(
            object="cylinder", parts=tuple(PARTS), scaled=scaled, normal_noise=0.5, force_noise=0.5,
            threads=1,
        )  # fmt: skip
        env = FingerGaitingEnv(config, seed=0)
        observation, _ = env.reset(seed=0)
        env.action_space.seed(0)
        for _ in range(20):
            assert observation in env.observation_space
            observation, *_ = env.step(env.action_space.sample())


def test_noise_has_the_size_asked_for(state: dexctl.GraspState) -> None:
    count = 4000
    many = state[np.zeros(count, int)]
    noise = SensorNoise(joint=0.1, position=0.01, normal=0.02, force=0.2)
    seen = observed(many, noise, Streams(0, (count,)))
    assert (seen.q - many.q).std() == pytest.approx(0.1, rel=0.03)
    np.testing.assert_array_equal(seen.q_target, many.q_target)
    offset = (seen.contact_position - many.contact_position)[:, :4]
    assert offset.std() == pytest.approx(0.01, rel=0.03)
    assert (seen.contact_force[:, :4] / 2.0).std() == pytest.approx(0.2, rel=0.03)
    np.testing.assert_allclose(np.linalg.norm(seen.contact_normal[:, :4], axis=-1), 1.0)
    assert seen.contact_normal[:, :4, 0].std() == pytest.approx(0.02, rel=0.03)
    for array in (seen.contact_position, seen.contact_normal, seen.contact_force):
        np.testing.assert_array_equal(array[:, 4], 0.0)
    assert observed(many, SensorNoise(), Streams(0, (count,))) is many


def test_controllers_see_the_truth() -> None:
    config = EnvConfig(object="cylinder", threads=1)
    plain, noisy = make_vector(config, 2, seed=0), make_vector(replace(config, joint_noise=0.1), 2)
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


def test_initial_states_are_those_of_the_file(tmp_path: Path) -> None:
    envs = make_vector(EnvConfig(object=("cylinder", "sphere"), threads=1), 2, seed=0)
    settled = envs.state
    assert settled.object_position is not None
    assert settled.object_quaternion is not None
    turn = np.array([[np.cos(0.2), 0.0, 0.0, np.sin(0.2)]])
    states = InitialStates(
        q=settled.q[[0, 0, 1]],
        q_target=settled.q_target[[0, 0, 1]],
        object_position=settled.object_position[[0, 0, 1]],
        object_quaternion=np.concatenate([settled.object_quaternion[:1], turn, turn]),
        object=np.array(["cylinder", "cylinder", "sphere"]),
        joint_names=np.array(envs.hand.joint_names),
    )
    path = tmp_path / "states.npz"
    states.save(path)
    config = EnvConfig(object=("cylinder", "sphere"), initial_states=path, threads=1)
    drawn = make_vector(config, 24, seed=0)
    quaternion = drawn.state.object_quaternion
    assert quaternion is not None
    np.testing.assert_allclose(quaternion[12:], np.tile(turn, (12, 1)))
    turned = np.isclose(quaternion[:12, 3], turn[0, 3])
    assert 0 < turned.sum() < 12
    np.testing.assert_allclose(drawn.state.q[:12], np.tile(settled.q[0], (12, 1)))
    assert drawn.state.in_contact.all()
    spread = (drawn.state.q_target[:12] - settled.q_target[0]).std()
    assert spread == pytest.approx(0.02, rel=0.3)
    _, _, _, _, info = drawn.step(np.zeros((24, 15)))
    assert (np.abs(info["rotation"]) < 0.1).all()

    with pytest.raises(InvalidInput, match="none of the object 'cube'; they are of cylinder"):
        make_vector(EnvConfig(object="cube", initial_states=path), 1)
    names = np.array(["a", *envs.hand.joint_names[1:]])
    replace(states, joint_names=names).save(path)
    with pytest.raises(InvalidInput, match="states are of a hand with joints a, "):
        make_vector(config, 2)
    with pytest.raises(InvalidInput, match="'nowhere.npz' cannot be read"):
        make_vector(EnvConfig(initial_states="nowhere.npz"), 1)
    with pytest.raises(InvalidInput, match=r"object_quaternion has norm 2; expected 1"):
        replace(states, object_quaternion=2 * states.object_quaternion)
    np.savez(path, q=states.q)
    with pytest.raises(InvalidInput, match="lacks q_target, object_position"):
        InitialStates.load(path)


def test_configurations_go_through_json() -> None:
    config = EnvConfig(object=("cube", "sphere"), axis=(0, 0, -2), gravity=(0, 0, 9.81))
    assert EnvConfig(**json.loads(json.dumps(config.to_dict()))) == config
    assert config.direction == (0.0, 0.0, -1.0)
    assert config.max_change == pytest.approx(0.1)


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
        EnvConfig(**options)


def test_unknown_names() -> None:
    with pytest.raises(UnknownName, match="unknown observation part 'smell'; known: q, q_target"):
        EnvConfig(parts=("q", "smell"))
    with pytest.raises(UnknownName, match="unknown axis 'up'; known: x, y, z"):
        EnvConfig(axis="up")
    with pytest.raises(UnknownName, match="unknown gravity 'sideways'"):
        make_vector(EnvConfig(gravity="sideways"), 1)


def test_a_pose_that_is_not_tracked(dex5: dexctl.HandModel, state: dexctl.GraspState) -> None:
    blind = replace(state, object_position=None)
    with pytest.raises(InvalidInput, match="'object_position' needs the object's pose"):
        Observation(dex5, ("q", "object_position"))(blind)


def test_shares_are_even() -> None:
    assert shares(7, 3) == [3, 2, 2]
    assert shares(5, 5) == [1] * 5
