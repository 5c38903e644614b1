"""What all algorithms do: learn a small task, continue to the same bits, refuse what is wrong."""

from __future__ import annotations

import re
from copy import deepcopy
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch")

import torch

from dexctl.exceptions import InvalidInput, UnknownName
from learning.algorithms import (
    Algorithm,
    Cloning,
    DAggerConfig,
    PPOConfig,
    SACConfig,
    TD3Config,
    Transitions,
    make,
)

GROUPS = {"policy": slice(0, 2), "critic": slice(0, 3)}
OFF_POLICY: dict[str, Any] = {
    "batch_size": 64, "buffer_size": 4000, "learning_starts": 64, "network": (32, 32),
    "learning_rate": 3e-3, "tau": 0.02, "gamma": 0.5,
}  # fmt: skip
CONFIGS = {
    "sac": SACConfig(**OFF_POLICY, n_step=2, layer_norm=True, policy_average=0.9),
    "td3": TD3Config(**OFF_POLICY),
    "ppo": PPOConfig(network=(32, 32), rollout_steps=8, gamma=0.5, learning_rate=3e-3),
    "dagger": DAggerConfig(
        network=(32, 32), batch_size=64, buffer_size=4000, learning_rate=3e-3, policy_average=0.9,
    ),
}  # fmt: skip
N = 16


def build(name: str, seed: int = 0, **options: Any) -> Any:
    options = {"groups": GROUPS, "observation_size": 3, "action_size": 1, "num_envs": N, **options}
    options.setdefault("labels", name == "dagger")
    return make(CONFIGS[name], seed=seed, **options)


class Contextual:
    """The best action is half of the first number observed; episodes are cut after 5 steps."""

    def __init__(self, seed: int = 0) -> None:
        self.rng, self.time = np.random.default_rng(seed), 0
        self.observation = self.draw()

    def draw(self) -> np.ndarray:
        return self.rng.uniform(-1, 1, (N, 3)).astype(np.float32)

    def turn(self, agent: Algorithm, **options: Any) -> None:
        action = agent.act(self.observation)
        assert action.shape == (N, 1) and np.abs(action).max() <= 1.0
        reward = 1.0 - (action[:, 0] - 0.5 * self.observation[:, 0]) ** 2
        following, self.time = self.draw(), self.time + 1
        nowhere, ended = np.zeros(N, bool), np.full(N, self.time % 5 == 0)
        agent.observe(
            Transitions(
                self.observation, action, reward, following, nowhere, ended,
                np.ones(N, bool), 0.5 * self.observation[:, :1],
            )
        )  # fmt: skip
        agent.update(**options)
        self.observation = following


def policy(agent: Algorithm, observation: np.ndarray) -> np.ndarray:
    found = observation[:, GROUPS["policy"]]
    *hidden, (weight, bias) = agent.policy_layers()
    for w, b in hidden:
        found = np.maximum(found @ w.T + b, 0.0)
    return np.tanh(found @ weight.T + bias)


@pytest.mark.parametrize(
    ("name", "turns"),
    [
        ("sac", 300),
        pytest.param("td3", 300, marks=pytest.mark.slow),
        pytest.param("ppo", 800, marks=pytest.mark.slow),
        ("dagger", 100),
    ],
)
def test_a_small_task_is_learned(name: str, turns: int) -> None:
    agent, task = build(name), Contextual()
    for _ in range(turns):
        task.turn(agent)
    observation = np.random.default_rng(1).uniform(-1, 1, (500, 3))
    error = policy(agent, observation)[:, 0] - 0.5 * observation[:, 0]
    assert np.sqrt((error**2).mean()) < 0.1  # 0.29 of a policy that always does 0
    assert agent.steps == turns * N and agent.updates > 0 and not agent.diverged


@pytest.mark.parametrize("name", CONFIGS)
def test_a_killed_run_continues_to_the_same_bits(name: str) -> None:
    agent, task = build(name), Contextual()
    for _ in range(21):
        task.turn(agent, beta=0.5, left=0.7)
    saved, other_task = deepcopy(agent.state_dict()), deepcopy(task)
    again = build(name, seed=5)
    again.load_state_dict(saved)
    for _ in range(21):
        task.turn(agent, beta=0.4, left=0.5)
        other_task.turn(again, beta=0.4, left=0.5)
    assert agent.steps == again.steps and agent.updates == again.updates
    assert agent.statistics == again.statistics and agent.statistics
    for ours, theirs in zip(agent.policy_layers(), again.policy_layers(), strict=True):
        assert (ours[0] == theirs[0]).all() and (ours[1] == theirs[1]).all()
    assert (agent.act(task.observation) == again.act(task.observation)).all()


@pytest.mark.parametrize("name", CONFIGS)
def test_a_run_of_another_device_goes_on(name: str) -> None:
    # a processor's generator has 5056 bytes, a GPU's 16, and neither takes those of the other
    agent, task = build(name), Contextual()
    for _ in range(21):
        task.turn(agent)
    saved = deepcopy(agent.state_dict())
    saved["random"] = torch.arange(16, dtype=torch.uint8)
    drawn = []
    for seed in (5, 6):
        again = build(name, seed=seed)
        again.load_state_dict(deepcopy(saved))
        drawn.append(again.act(task.observation))
        deepcopy(task).turn(again)
        assert again.updates >= agent.updates and not again.diverged
    assert (drawn[0] == drawn[1]).all()  # the checkpoint decides, not the seed of the new one


@pytest.mark.parametrize("name", CONFIGS)
def test_what_is_saved_is_plain(name: str) -> None:
    agent, task = build(name), Contextual()
    for _ in range(10):
        task.turn(agent)

    def check(value: Any) -> None:
        if isinstance(value, dict):
            for one in value.values():
                check(one)
        elif isinstance(value, list | tuple):
            for one in value:
                check(one)
        else:
            plain = bool | int | float | str | np.ndarray | torch.Tensor
            assert value is None or isinstance(value, plain), type(value)

    check(agent.state_dict())


@pytest.mark.parametrize("name", ["sac", "td3"])
def test_values_are_the_smaller_ones(name: str) -> None:
    agent, task = build(name), Contextual()
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (4, N, 1)).astype(np.float32)
    found = agent.values(task.observation, actions)
    assert found.shape == (4, N)
    for c in range(4):
        both = agent.critic(torch.from_numpy(task.observation), torch.from_numpy(actions[c]))
        assert found[c] == pytest.approx(both.min(dim=0).values[:, 0].detach().numpy(), abs=1e-6)


@pytest.mark.parametrize("name", ["sac", "td3"])
def test_nothing_before_learning_starts(name: str) -> None:
    agent, task = build(name), Contextual()
    for _ in range(4):
        task.turn(agent)
    assert agent.steps == 64 and agent.updates == 0
    task.turn(agent)
    assert agent.updates == 2


@pytest.mark.parametrize("name", CONFIGS)
def test_another_algorithm_or_network_is_refused(name: str) -> None:
    agent = build(name)
    before = agent.actor.flat.clone()
    saved = agent.state_dict()
    with pytest.raises(InvalidInput, match="the saved algorithm is dqn; expected"):
        agent.load_state_dict(saved | {"algorithm": "dqn"})
    other = build(name, groups={"policy": slice(0, 1), "critic": slice(0, 3)}).state_dict()
    with pytest.raises(InvalidInput, match="the saved actor has layers of"):
        agent.load_state_dict(other)
    assert before.equal(agent.actor.flat)


@pytest.mark.parametrize("name", CONFIGS)
def test_divergence_shows(name: str) -> None:
    agent = build(name)
    assert not agent.diverged
    with torch.no_grad():
        next(reversed(agent.networks.values())).weights[1][0, 0, 0] = float("inf")
    assert agent.diverged


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"groups": {"policy": slice(0, 2)}}, "has the groups policy; expected policy and critic"),
        ({"groups": {"policy": slice(0, 0), "critic": slice(0, 3)}}, "'policy' is columns 0 to 0"),
        ({"groups": {"policy": slice(0, 2), "critic": slice(0, 4)}}, "'critic' is columns 0 to 4"),
        ({"num_envs": 0}, "num_envs is 0"),
        ({"action_size": 1.5}, "action_size is 1.5"),
    ],
)
@pytest.mark.parametrize("name", CONFIGS)
def test_bad_sizes(name: str, options: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidInput, match=message):
        build(name, **options)


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        (SACConfig, {"gamma": 1.5}, "gamma is 1.5"),
        (SACConfig, {"n_step": 0}, "n_step is 0"),
        (SACConfig, {"policy_delay": 0}, "policy_delay is 0"),
        (SACConfig, {"tau": 0.0}, "tau is 0.0"),
        (SACConfig, {"network": ()}, "network is ()"),
        (SACConfig, {"buffer_size": 100}, "one batch of 512"),
        (SACConfig, {"learning_rate": float("nan")}, "learning_rate is nan"),
        (SACConfig, {"learning_rate_end": -1.0}, "learning_rate_end is -1.0"),
        (SACConfig, {"learning_starts": -1}, "learning_starts is -1"),
        (SACConfig, {"entropy_coefficient": -0.1}, "entropy_coefficient is -0.1"),
        (TD3Config, {"exploration_noise": -1.0}, "exploration_noise is -1.0"),
        (TD3Config, {"batch_size": True}, "batch_size is True"),
        (DAggerConfig, {"action_noise": -0.1}, "action_noise is -0.1"),
        (DAggerConfig, {"buffer_size": 100}, "one batch of 1024"),
        (DAggerConfig, {"decay_start": 2.0}, "decay_start is 2.0"),
        (PPOConfig, {"clip": 0.0}, "clip is 0.0"),
        (PPOConfig, {"epochs": 0}, "epochs is 0"),
        (PPOConfig, {"gae_lambda": 2.0}, "gae_lambda is 2.0"),
        (PPOConfig, {"target_kl": 0.0}, "target_kl is 0.0"),
        (PPOConfig, {"value_clip": -0.2}, "value_clip is -0.2"),
        (PPOConfig, {"learning_rate_end": 0.0}, "expected None where the learning rate adapts"),
        (Cloning, {"kind": "fast"}, "'fast'; known: likelihood, squared"),
        (Cloning, {"weight": "heavy"}, "'heavy'; known: value, equal, better"),
    ],
)
def test_bad_settings(kind: Any, options: dict[str, Any], message: str) -> None:
    with pytest.raises((InvalidInput, UnknownName), match=re.escape(message)):
        kind(**options)


def test_ppo_takes_no_labels_and_no_more_minibatches_than_steps() -> None:
    with pytest.raises(InvalidInput, match="labels is True"):
        build("ppo", labels=True)
    with pytest.raises(InvalidInput, match="minibatches is 4; expected at most the 2"):
        make(
            PPOConfig(rollout_steps=2), groups=GROUPS, observation_size=3, action_size=1, num_envs=1
        )
