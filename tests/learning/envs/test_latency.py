"""Latency: what is observed is what was observed some steps ago, and only that."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dexctl.exceptions import InvalidInput
from dexctl.settings import from_plain
from learning.envs import EnvConfig, ManipulationVectorEnv, make_vector


def env_config(**settings: Any) -> EnvConfig:
    return from_plain(EnvConfig, settings)


PARTS = ("q", "contact_force", "object_position", "q_target")


def made(latency: float, count: int = 2, **options) -> ManipulationVectorEnv:
    config = env_config(
        object="cylinder",
        parts=PARTS,
        joint_noise=0.01,
        threads=1,
        sensor_latency=latency,
        **options,
    )
    return make_vector(config, count, seed=5)


def observed(envs: ManipulationVectorEnv, actions: np.ndarray) -> list[np.ndarray]:
    """The first observations, and those after each action."""
    rows = [envs.reset(seed=5)[0]]
    rows += [envs.step(np.tile(action, (envs.num_envs, 1)))[0] for action in actions]
    return rows


def test_what_is_sensed_is_the_earlier_observation(wiggle: np.ndarray) -> None:
    now, late = made(0.0), made(0.1)
    before, after = observed(now, wiggle[:6]), observed(late, wiggle[:6])
    target = now.observation.slices["q_target"]
    sensed = slice(0, target.start)
    for i in range(7):
        np.testing.assert_array_equal(after[i][:, sensed], before[max(i - 2, 0)][:, sensed])
        np.testing.assert_array_equal(after[i][:, target], before[i][:, target])
    assert not np.array_equal(before[6][:, sensed], before[4][:, sensed])
    # controllers and reward keep to the truth
    np.testing.assert_array_equal(late.state.q, now.state.q)


def test_an_episode_begins_with_nothing_of_the_one_before(wiggle: np.ndarray) -> None:
    envs = made(0.1, episode_steps=4)
    rows = observed(envs, wiggle[:6])
    target = envs.observation.slices["q_target"].start
    first = rows[4][:, :target]  # of the second episode; the first was truncated
    np.testing.assert_array_equal(rows[5][:, :target], first)
    np.testing.assert_array_equal(rows[6][:, :target], first)
    assert not np.array_equal(rows[0][:, :target], first)


def test_an_environment_that_is_reset_leaves_the_others_alone(wiggle: np.ndarray) -> None:
    envs, alone = made(0.1), made(0.1)
    observed(envs, wiggle[:3])
    expected = observed(alone, wiggle[:5])
    after, _ = envs.reset(mask=np.array([True, False]))
    np.testing.assert_array_equal(after[1], expected[3][1])
    for i in (3, 4):
        after, *_ = envs.step(np.tile(wiggle[i], (2, 1)))
        np.testing.assert_array_equal(after[1], expected[i + 1][1])


def test_restored_environments_go_on_with_the_same_bits(wiggle: np.ndarray) -> None:
    envs, other = made(0.15), made(0.15)
    observed(envs, wiggle[:3])
    other.restore(envs.save())
    for action in wiggle[3:8]:
        actions = np.tile(action, (2, 1))
        np.testing.assert_array_equal(other.step(actions)[0], envs.step(actions)[0])


def test_the_settings() -> None:
    with pytest.raises(InvalidInput, match=r"sensor_latency is -0\.1"):
        env_config(sensor_latency=-0.1)
