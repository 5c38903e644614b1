"""The environments: single against batch, seeds, episodes, autoreset, replays, divergence."""

from __future__ import annotations

import subprocess
import sys
import warnings
from copy import deepcopy
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import learning
from dexctl.exceptions import InvalidInput, SimulationError, UnknownName
from dexctl.settings import from_plain
from dexctl.sim import rotation_about
from learning.envs import EnvConfig, ManipulationEnv, ManipulationVectorEnv, make_vector


def env_config(**settings: Any) -> EnvConfig:
    return from_plain(EnvConfig, settings)


NOISY = env_config(
    object="cylinder",
    joint_noise=0.02,
    position_noise=0.002,
    normal_noise=0.1,
    force_noise_share=0.2,
    push_force=0.5,
    push_seconds=0.1,
    threads=1,
)
SHORT = env_config(object="cylinder", episode_steps=5, threads=1)
OPEN = np.tile([0.0, 1.0, 0.0], 5)  # all fingers away from the object


def test_gymnasium_is_content() -> None:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*Box observation space.*infinity.*")
        env = gymnasium.make(learning.FINGER_GAITING, object="cylinder", threads=1)
        check_env(env.unwrapped, skip_render_check=True)
    assert env.observation_space.shape == (65,)
    assert env.action_space == gymnasium.spaces.Box(-1.0, 1.0, (15,), np.float32)
    env.close()


def test_make_vec_uses_the_batched_environment() -> None:
    envs = gymnasium.make_vec(learning.FINGER_GAITING, num_envs=3, object=("cube", "sphere"))
    batch = envs.unwrapped
    assert isinstance(batch, ManipulationVectorEnv)
    assert batch.objects == ("cube", "cube", "sphere")
    assert envs.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    observations, _ = envs.reset(seed=0)
    assert observations in envs.observation_space
    assert observations.shape == (3, 65)
    envs.close()


def test_each_of_a_batch_is_a_single_environment_with_its_seed(wiggle: np.ndarray) -> None:
    batch = make_vector(NOISY, 3)
    singles = [ManipulationEnv(NOISY) for _ in range(3)]
    first, _ = batch.reset(seed=5)
    rows = [env.reset(seed=5 + i)[0] for i, env in enumerate(singles)]
    np.testing.assert_array_equal(first, rows)
    assert not np.array_equal(first[0], first[1])
    for action in wiggle[:6]:
        observations, rewards, _, _, info = batch.step(np.tile(action, (3, 1)))
        for i, env in enumerate(singles):
            observation, reward, _, _, single = env.step(action)
            np.testing.assert_array_equal(observation, observations[i])
            assert reward == rewards[i]
            assert single["rotation"] == info["rotation"][i]


def test_several_objects_are_their_environments_side_by_side(wiggle: np.ndarray) -> None:
    both = make_vector(env_config(object=("cylinder", "sphere"), threads=1), 2, seed=0)
    sphere = ManipulationEnv(object="sphere", threads=1)
    row, _ = sphere.reset(seed=10)
    observations, _ = both.reset(seed=9)
    np.testing.assert_array_equal(row, observations[1])
    for action in wiggle[:3]:
        np.testing.assert_array_equal(
            sphere.step(action)[0], both.step(np.tile(action, (2, 1)))[0][1]
        )


def test_seeds_repeat_and_streams_go_on() -> None:
    envs = make_vector(SHORT, 2)
    first, _ = envs.reset(seed=3)
    on, _ = envs.reset()
    again, _ = envs.reset(seed=3)
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, on)
    one_each, _ = envs.reset(seed=[4, 3])
    np.testing.assert_array_equal(one_each[1], first[0])
    huge, _ = envs.reset(seed=2**63)
    assert np.isfinite(huge).all()


def test_episodes_end_and_begin_in_the_same_step() -> None:
    envs = make_vector(SHORT, 3, seed=1)
    actions = np.zeros((3, 15))
    for _ in range(3):
        envs.step(actions)
    reset, _ = envs.reset(mask=[False, True, False])  # now it is out of step with the others
    envs.step(actions)
    observations, _, terminated, truncated, info = envs.step(actions)
    np.testing.assert_array_equal(truncated, [True, False, True])
    np.testing.assert_array_equal(info["done"], truncated | terminated)
    np.testing.assert_array_equal(info["episode_length"], [5, 2, 5])
    np.testing.assert_array_equal(observations[1], info["final_obs"][1])
    assert not np.array_equal(observations[0], info["final_obs"][0])
    np.testing.assert_array_equal(observations, envs.observation(envs.state))
    np.testing.assert_array_equal(envs.state.time, [0.0, 0.1, 0.0])
    assert reset.shape == (3, 65)
    _, _, _, _, info = envs.step(actions)
    np.testing.assert_array_equal(info["episode_length"], [1, 3, 1])


def test_final_observations_are_those_without_autoreset(wiggle: np.ndarray) -> None:
    envs = make_vector(SHORT, 1, seed=2)
    plain = ManipulationVectorEnv(SHORT, 1, seed=2, autoreset=False)
    for action in wiggle[:5]:
        observations, _, _, truncated, info = envs.step(action[None])
        last, _, _, _, _ = plain.step(action[None])
    assert truncated.all()
    np.testing.assert_array_equal(info["final_obs"], last)
    assert info["rotation"][0] != 0.0  # of the episode that ended, not of the next one
    np.testing.assert_array_equal(observations, plain.reset()[0])


def test_dropping_the_object_ends_the_episode() -> None:
    env = ManipulationEnv(object="cylinder", gravity="down", threads=1, seed=0)
    env.reset(seed=0)
    for _ in range(40):
        _, reward, terminated, truncated, info = env.step(OPEN)
        if terminated:
            break
    assert info["dropped"]
    assert not truncated
    assert np.isfinite(reward)
    away = env.state.object_centre() - env.batch.simulation.sim.start_position[0]
    assert 0.05 < np.linalg.norm(away) < 0.3


def test_rotation_is_that_of_the_trials() -> None:
    from dexctl import controllers

    envs = make_vector(env_config(object="cylinder", threads=2), 2, seed=0)
    igm = controllers.make("igm", envs.hand)
    poses = [envs.state.object_quaternion]
    returns = np.zeros(2)
    for _ in range(60):
        _, rewards, _, _, info = envs.step(envs.change_to_action(igm.act(envs.state)))
        poses.append(envs.state.object_quaternion)
        returns += rewards
    expected = rotation_about(np.array(poses))[-1]
    assert (expected > 0.2).all()
    np.testing.assert_allclose(info["rotation"], expected, atol=1e-9)
    np.testing.assert_allclose(info["episode_return"], returns)
    # the reward is the speed, cut off at 0.5: its sum in time is the rotation at most
    assert (returns * 0.05 <= expected + 1e-3).all()


def test_restored_environments_go_on_with_the_same_bits(wiggle: np.ndarray) -> None:
    config = env_config(
        object="cylinder", episode_steps=6, joint_noise=0.01, push_force=0.3, threads=1
    )
    envs, other = make_vector(config, 2, seed=8), make_vector(config, 2, seed=99)
    for action in wiggle[:4]:
        envs.step(np.tile(action, (2, 1)))
    other.restore(deepcopy(envs.save()))
    for action in wiggle[4:12]:  # past the end of an episode
        a = envs.step(np.tile(action, (2, 1)))
        b = other.step(np.tile(action, (2, 1)))
        for left, right in zip(a[:4], b[:4], strict=True):
            np.testing.assert_array_equal(left, right)
        for name, value in a[4].items():
            np.testing.assert_array_equal(value, b[4][name])
    with pytest.raises(SimulationError, match="saved state has shape"):
        make_vector(config, 3, seed=0).restore(envs.save())


def test_diverged_physics_ends_the_episode_with_its_last_finite_state(
    in_scratch: Path, caplog: pytest.LogCaptureFixture
) -> None:
    envs = make_vector(SHORT, 2, seed=0)
    envs.step(np.zeros((2, 15)))
    before = envs.observation(envs.state)
    group = envs.simulation.sim.groups[0]
    group.set_parameters(kv=0.15)
    broken = group._parameters.models[1]  # its servos push away from their set-points
    broken.actuator_forcelimited[:] = 0
    broken.actuator_biasprm[:, 1] = 1e14
    with np.errstate(all="ignore"):
        observations, rewards, terminated, truncated, info = envs.step(np.zeros((2, 15)))
    np.testing.assert_array_equal(terminated, [False, True])
    assert not truncated.any()
    np.testing.assert_array_equal(info["diverged"], terminated)
    assert not info["dropped"].any()
    np.testing.assert_array_equal(info["final_obs"][1], before[1])
    assert rewards[1] == 0.0
    assert envs.diverged_count == 1
    assert "broken down in environments [1]" in caplog.text
    assert np.isfinite(observations).all()
    assert envs.state[1].time == 0.0


def test_wild_actions_give_numbers_all_the_same() -> None:
    config = env_config(object=("cube", "sphere"), max_speed=20.0, max_lead=3.0, threads=2)
    envs = make_vector(config, 16, seed=0)
    rng = np.random.default_rng(0)
    ended = 0
    for _ in range(60):
        observations, rewards, _, _, info = envs.step(rng.choice([-1.0, 1.0], (16, 15)))
        assert np.isfinite(observations).all()
        assert np.isfinite(info["final_obs"]).all()
        assert np.isfinite(rewards).all()
        assert (rewards <= 0.5).all()
        ended += int(info["done"].sum())
    assert ended > 16


def test_gymnasium_wrappers_take_the_batch() -> None:
    envs = gymnasium.make_vec(learning.FINGER_GAITING, num_envs=2, object="cylinder",
                              episode_steps=3, threads=1)  # fmt: skip
    envs = gymnasium.wrappers.vector.RecordEpisodeStatistics(envs)
    envs.reset(seed=0)
    total = np.zeros(2)
    for _ in range(3):
        _, rewards, _, truncated, info = envs.step(np.zeros((2, 15), np.float32))
        total += rewards
    assert truncated.all()
    np.testing.assert_allclose(info["episode"]["r"], total, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(info["episode_return"], total)
    envs.close()


def test_importing_learning_is_cheap() -> None:
    code = (
        "import sys, learning; "
        "print([m for m in ('torch', 'mujoco', 'casadi', 'mink') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_bad_input() -> None:
    envs = make_vector(SHORT, 2, seed=0)
    with pytest.raises(InvalidInput, match=r"actions have shape \(15,\); expected \(2, 15\)"):
        envs.step(np.zeros(15))
    bad = np.zeros((2, 15))
    bad[1, 3] = np.nan
    with pytest.raises(InvalidInput, match=r"the action at \[1, 3\] is nan"):
        envs.step(bad)
    with pytest.raises(InvalidInput, match="mask has shape"):
        envs.reset(mask=[True])
    for seed in (1.5, "a", [1, 2, 3]):
        with pytest.raises(InvalidInput, match="seed is .*; expected an integer, or 2 of them"):
            envs.reset(seed=seed)
    with pytest.raises(InvalidInput, match=r"seed is 0\.5"):
        make_vector(SHORT, 2, seed=0.5)  # pyright: ignore[reportArgumentType]
    with pytest.raises(UnknownName, match="unknown object 'brick'; known: cube"):
        make_vector(env_config(object="brick"), 1)
    with pytest.raises(UnknownName, match="unknown hand 'foot'"):
        env_config(hand="foot")
    with pytest.raises(InvalidInput, match="num_envs is 1; expected at least 2"):
        make_vector(env_config(object=("cube", "sphere")), 1)
    with pytest.raises(InvalidInput, match="num_envs is 2.5"):
        make_vector(SHORT, 2.5)  # pyright: ignore[reportArgumentType]
    with pytest.raises(UnknownName, match="unknown render_mode 'ascii'"):
        ManipulationEnv(SHORT, render_mode="ascii")
    with pytest.raises(UnknownName, match="unknown setting 'obiect'; known: scene, task"):
        ManipulationEnv(obiect="cube")


def test_pictures() -> None:
    from dexctl.exceptions import MissingExtra

    env = ManipulationEnv(SHORT, render_mode="rgb_array", seed=0)
    try:
        picture = env.render()
    except (MissingExtra, SimulationError) as error:  # no OpenGL on this machine
        pytest.skip(str(error))
    assert picture is not None
    assert picture.shape == (600, 800, 3)
    assert picture.std() > 5
    env.close()


def test_a_window_shows_every_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a window that only counts; the real one needs a display."""
    shown: list[str] = []

    class Window:
        def __init__(self, scene: Any) -> None:
            shown.append("open")

        def __call__(self, sim: Any) -> None:
            shown.append("draw")

        def close(self) -> None:
            shown.append("close")

    monkeypatch.setattr("dexctl.sim.Viewer", Window)
    env = ManipulationEnv(SHORT, render_mode="human")
    env.reset(seed=0)
    for _ in range(2):
        env.step(np.zeros(15))
    env.close()
    assert shown[0] == "open" and shown[-1] == "close"
    assert shown.count("draw") >= 2 and shown.count("open") == 1


def test_without_a_display_one_line_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    if sys.platform != "linux":
        pytest.skip("other systems do not tell")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    env = ManipulationEnv(SHORT, render_mode="human")
    env.reset(seed=0)
    with pytest.raises(SimulationError, match="the viewer needs a display") as caught:
        env.step(np.zeros(15))
    assert "\n" not in str(caught.value)
    env.close()


def test_pushes_have_their_size_and_change_direction() -> None:
    from dexctl.sim.pushes import Push, Pusher
    from dexctl.streams import Streams

    pusher = Pusher(Push(push_force=0.7, push_seconds=0.15), Streams(0, (500,)), 0.05)
    first = pusher(np.zeros(500, int))
    np.testing.assert_allclose(np.linalg.norm(first, axis=1), 0.7)
    assert np.abs(first.mean(axis=0)).max() < 0.06  # no direction is preferred
    np.testing.assert_array_equal(pusher(np.full(500, 2)), first)
    steps = np.full(500, 2)
    steps[:10] = 3
    changed = (pusher(steps) != first).any(axis=1)
    np.testing.assert_array_equal(np.flatnonzero(changed), np.arange(10))
