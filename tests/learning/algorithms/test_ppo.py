"""PPO: advantages, losses and the adaptive rate by hand; what it refuses."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch")

import torch
from torch.overrides import TorchFunctionMode

from dexctl.exceptions import InvalidInput
from learning.algorithms import PPO, PPOConfig, Transitions
from learning.algorithms.losses import (
    adapted_rate,
    clipped_policy_loss,
    gaussian_kl,
    gaussian_log_prob,
    value_loss,
)
from learning.algorithms.normalisation import Normalisation
from learning.algorithms.rollout_buffer import advantages


def make(**options: Any) -> PPO:
    options = {"network": (8,), "rollout_steps": 4, "minibatches": 2, **options}
    return PPO(
        PPOConfig(**options), groups={"policy": slice(0, 2), "critic": slice(1, 4)},
        observation_size=4, action_size=2, num_envs=3, seed=0,
    )  # fmt: skip


def step(agent: PPO, rng: np.random.Generator) -> None:
    observation = rng.normal(size=(3, 4)).astype(np.float32)
    action = agent.act(observation)
    ended = rng.random(3) < 0.3
    agent.observe(
        Transitions(observation, action, rng.normal(size=3), observation + 1, ended, ended)
    )
    agent.update()


class Placed(TorchFunctionMode):
    """Tensors that are made have a device: else they are where the algorithm may not be."""

    def __torch_function__(self, function, types, args=(), kwargs=None):
        if function in (torch.as_tensor, torch.full, torch.ones, torch.randn, torch.zeros):
            assert kwargs and "device" in kwargs, function
        return function(*args, **(kwargs or {}))


def test_all_is_done_on_one_device() -> None:
    agent, rng = make(), np.random.default_rng(0)
    with Placed():
        agent.imitate(
            rng.normal(size=(6, 4)), np.tanh(rng.normal(size=(6, 2))),
            epochs=1, batch_size=4, seed=0,
        )  # fmt: skip
        for _ in range(4):
            step(agent, rng)


def test_advantages_by_hand() -> None:
    """gamma 0.5, lambda 0.5: the first environment is cut at the second step, the other terminates.

    Both have rewards 1, 1, 1, values 2, 2, 2, and 4 follows each step.
    """
    ones = np.ones((3, 2))
    ended = np.array([[False, False], [True, True], [False, False]])
    terminated = ended & np.array([False, True])
    found = advantages(ones, 2 * ones, 4 * ones, terminated, ended, gamma=0.5, gae_lambda=0.5)
    # delta = 1 + 0.5 * 4 - 2 = 1, where it terminates 1 - 2 = -1; each counts 0.25 of the next
    assert found[:, 0].tolist() == [1 + 0.25 * 1, 1, 1]
    assert found[:, 1].tolist() == [1 + 0.25 * -1, -1, 1]


def test_clipped_losses_by_hand() -> None:
    ratio = torch.tensor([1.5, 0.5, 1.5, 0.5])
    advantage = torch.tensor([1.0, 1.0, -1.0, -1.0])
    # min(1.5, 1.2), min(0.5, 0.8), min(-1.5, -1.2), min(-0.5, -0.8)
    loss = clipped_policy_loss(ratio.log(), advantage, 0.2)
    assert float(loss) == pytest.approx(-(1.2 + 0.5 - 1.5 - 0.8) / 4)
    # moved from 1 to 2, clipped 1.2: errors to 3 are 1 and 3.24; to 1.2 they are 0.64 and 0
    value, old, returns = torch.full((2,), 2.0), torch.ones(2), torch.tensor([3.0, 1.2])
    assert float(value_loss(value, old, returns, 0.2)) == pytest.approx((3.24 + 0.64) / 2)
    assert float(value_loss(value, old, returns)) == pytest.approx((1.0 + 0.64) / 2)


def test_densities_by_hand() -> None:
    mean, log_std = torch.zeros(1, 2), torch.log(torch.tensor([1.0, 2.0]))
    found = gaussian_log_prob(torch.tensor([[1.0, 2.0]]), mean, log_std)
    assert float(found) == pytest.approx(-1.0 - np.log(2) - np.log(2 * np.pi))
    # log(2) + (1 + 1) / (2 * 4) - 1/2
    kl = gaussian_kl(
        torch.ones(1, 1), torch.zeros(1), torch.zeros(1, 1), torch.log(torch.tensor([2.0]))
    )
    assert float(kl) == pytest.approx(np.log(2) + 0.25 - 0.5)
    assert float(gaussian_kl(mean, log_std, mean, log_std)) == pytest.approx(0.0, abs=1e-7)


def test_adaptive_rate_by_hand() -> None:
    assert adapted_rate(1e-3, 0.03, 0.01) == pytest.approx(1e-3 / 1.5)
    assert adapted_rate(1e-3, 0.004, 0.01) == pytest.approx(1.5e-3)
    assert adapted_rate(1e-3, 0.01, 0.01) == adapted_rate(1e-3, 0.0, 0.01) == 1e-3
    assert adapted_rate(1.2e-5, 1.0, 0.01) == 1e-5 and adapted_rate(9e-3, 1e-5, 0.01) == 1e-2


def test_an_update_every_so_many_steps() -> None:
    agent, rng = make(epochs=3), np.random.default_rng(0)
    for _ in range(9):
        step(agent, rng)
    assert agent.steps == 27 and agent.updates == 2 * 3 * 2 and agent.rollout.position == 1
    assert set(agent.statistics) == {"actor_loss", "critic_loss", "entropy", "kl", "learning_rate"}
    fixed = make(target_kl=None, learning_rate_end=1e-4)
    for _ in range(4):
        step(fixed, rng)
        fixed.update(left=0.5)
    assert fixed.optimizer.param_groups[0]["lr"] == 1e-3  # left was 1 when the update was due


def test_the_critic_may_have_a_rate_of_its_own() -> None:
    """The actor's adapts, the critic's stays; steps of Adam are about as long as the rate."""
    agent = make(critic_learning_rate=0.5, learning_rate=1e-3, epochs=2, minibatches=1)
    rng = np.random.default_rng(0)
    before = [weight.detach().clone() for weight in agent._weights]
    for _ in range(4):
        step(agent, rng)
    actor, _, critic = (
        float((new.detach() - old).abs().max())
        for new, old in zip(agent._weights, before, strict=True)
    )
    assert agent.updates == 2
    assert 0.9e-3 < actor < 2.6e-3 and 0.45 < critic < 1.1
    for _ in range(8):
        step(agent, rng)
    rates = [group["lr"] for group in agent.optimizer.param_groups]
    assert rates[0] != 1e-3 and rates[1] == 0.5
    saved = agent.state_dict()
    other = make(critic_learning_rate=0.5)
    other.load_state_dict(saved)
    assert [group["lr"] for group in other.optimizer.param_groups] == rates


def test_values_follow_rewards_of_any_size() -> None:
    """A value may move further than the ratio of densities may, in whatever unit rewards are."""

    def learned(**options: Any) -> np.ndarray:
        agent = make(epochs=60, learning_rate=0.03, target_kl=None, max_gradient=1e3, **options)
        observed, ended = np.zeros((3, 4), np.float32), np.ones(3, bool)
        for _ in range(4):  # one update
            action = agent.act(observed)
            agent.observe(Transitions(observed, action, np.full(3, -10.0), observed, ended, ended))
            agent.update()
        with torch.no_grad():
            return agent._value(agent._inputs(observed)["critic"])

    assert learned() == pytest.approx(-10.0, abs=0.5)
    assert np.abs(learned(value_clip=0.2)).max() < 3.0  # one of its own holds it back


def test_groups_and_normalisation_go_into_the_layers() -> None:
    agent, rng = make(), np.random.default_rng(0)
    for _ in range(8):
        step(agent, rng)
    observed = rng.normal(size=(5, 4)).astype(np.float32)
    (w, b), (v, c) = agent.policy_layers()
    assert w.shape == (8, 2)
    found = np.tanh(np.maximum(observed[:, :2] @ w.T + b, 0) @ v.T + c)
    inputs = agent._inputs(observed)
    with torch.no_grad():
        mean = torch.tanh(agent.actor(torch.from_numpy(inputs["policy"]))[0]).numpy()
    assert found == pytest.approx(mean, abs=1e-5)
    assert agent.critic.widths == (3, 8, 1)


def test_running_mean_and_deviation() -> None:
    rows = np.random.default_rng(0).normal(3.0, 2.0, (60, 4))
    running = Normalisation(4)
    for part in np.split(rows, [7, 30]):
        running.see(part)
    assert running.mean == pytest.approx(rows.mean(axis=0))
    assert running.deviation == pytest.approx(rows.std(axis=0))


def test_it_learns_from_its_own_actions_only() -> None:
    agent = make()
    observed, nowhere = np.zeros((3, 4)), np.zeros(3, bool)
    action = agent.act(observed)
    assert np.abs(action).max() <= 1.0 and action.dtype == np.float32
    given = Transitions(observed, action, np.zeros(3), observed, nowhere, nowhere)
    with pytest.raises(InvalidInput, match="not those of the last act"):
        agent.observe(given._replace(action=action + 0.1))
    with pytest.raises(InvalidInput, match=r"environments \[0, 1, 2\] is not finite"):
        agent.observe(given._replace(reward=np.full(3, np.nan)))
    agent.observe(given)
    with pytest.raises(InvalidInput, match="not those of the last act"):
        agent.observe(given)
