"""The losses and updates of SAC and TD3: by hand, and against plain autograd."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch")

import torch

from learning.algorithms import SAC, TD3, Cloning, SACConfig, TD3Config
from learning.algorithms.losses import (
    cloning_weight,
    imitation_weight,
    likelihood_cloning,
    squared_cloning,
    squashed_log_prob,
)
from learning.algorithms.networks import gaussian, squashed_sample
from learning.algorithms.replay import Batch

KINDS = [(SAC, SACConfig), (TD3, TD3Config)]


def make(kind: Any, config: Any, *, cloning: Cloning | None = None, **options: Any) -> Any:
    """The actor sees 3 of 5 numbers; 2 actions."""
    options = {"network": (16, 16), "buffer_size": 600, "gamma": 0.9, **options}
    return kind(
        config(**options), groups={"policy": slice(0, 3), "critic": slice(0, 5)},
        observation_size=5, action_size=2, num_envs=4, cloning=cloning, seed=1,
    )  # fmt: skip


def batch(rows: int = 64, seed: int = 0, guided: float = 1.0) -> Batch:
    generator = torch.Generator().manual_seed(seed)

    def draw(width: int) -> torch.Tensor:
        return 2 * torch.rand(rows, width, generator=generator) - 1

    return Batch(
        draw(5), draw(2), draw(5), draw(1), 0.9 * (draw(1) > 0).float(),
        torch.full((rows, 1), guided), draw(2),
    )  # fmt: skip


def test_log_prob_by_hand() -> None:
    # u = atanh(0.5) = 0.549306; with mean 0.049306 and std 0.5, z = 1:
    # -1/2 - log(0.5) - log(2 pi)/2 - log(1 - 0.25) = -0.438109
    action, mean = torch.tensor([[0.5]]), torch.tensor([[float(np.arctanh(0.5)) - 0.5]])
    found = squashed_log_prob(action, mean, torch.log(torch.tensor([[0.5]])))
    by_hand = -0.5 - np.log(0.5) - 0.5 * np.log(2 * np.pi) - np.log(0.75)
    assert float(found) == pytest.approx(by_hand, abs=1e-5) == pytest.approx(-0.438109, abs=1e-5)


def test_log_prob_of_a_sample_is_that_of_its_action() -> None:
    torch.manual_seed(0)
    mean, log_std = torch.randn(50, 4), 0.3 * torch.randn(50, 4) - 1.0
    action, log_prob = squashed_sample(mean, log_std, torch.randn(50, 4), True)
    assert isinstance(log_prob, torch.Tensor)
    inside = (action.abs() < 0.99).all(dim=1)
    again = squashed_log_prob(action, mean, log_std)
    assert inside.sum() > 20
    torch.testing.assert_close(log_prob[inside], again[inside], rtol=1e-3, atol=1e-3)


def test_weight_is_the_value_where_positive_and_guided() -> None:
    value = torch.tensor([[2.0], [-3.0], [4.0]], requires_grad=True)
    weight = imitation_weight(value, torch.tensor([[1.0], [1.0], [0.0]]))
    assert weight.flatten().tolist() == [2.0, 0.0, 0.0] and not weight.requires_grad


def test_cloning_pulls_towards_the_action_not_away() -> None:
    """The thesis's printed sign would push away."""
    mean = torch.zeros(1, 2, requires_grad=True)
    loss = likelihood_cloning(
        torch.tensor([[0.5, -0.5]]), mean, torch.zeros(1, 2), torch.tensor([[2.0]])
    )
    loss.backward()
    # d/dmean of -w log pi = -w (u - mean) / std^2, u = atanh(a)
    assert mean.grad is not None
    assert mean.grad[0].tolist() == pytest.approx([-2 * np.arctanh(0.5), 2 * np.arctanh(0.5)])


def test_cloning_at_the_bounds_is_finite() -> None:
    mean = torch.zeros(1, 1, requires_grad=True)
    loss = likelihood_cloning(torch.ones(1, 1), mean, torch.zeros(1, 1), torch.ones(1, 1))
    loss.backward()
    assert mean.grad is not None
    assert torch.isfinite(loss) and torch.isfinite(mean.grad).all()


def test_squared_cloning_by_hand() -> None:
    action, policy = torch.tensor([[1.0, 0.0], [0.5, 0.5]]), torch.tensor([[0.0, 0.0], [0.5, 0.0]])
    weight = torch.tensor([[2.0], [4.0]])
    assert float(squared_cloning(action, policy, weight)) == pytest.approx((2 * 1 + 4 * 0.25) / 2)


def test_cloning_weights_by_hand() -> None:
    guide_value = torch.tensor([[2.0], [-1.0], [3.0], [5.0]])
    policy_value = torch.tensor([[1.0], [1.0], [4.0], [-2.0]])
    guided = torch.tensor([[1.0], [1.0], [1.0], [0.0]])

    def weights(kind: str) -> tuple[list[float], float]:
        weight, scale = cloning_weight(kind, guide_value, policy_value, guided)
        return weight.flatten().tolist(), float(scale)

    assert weights("value") == ([2.0, 0.0, 3.0, 0.0], 1.0)
    assert weights("equal") == ([1.0, 1.0, 1.0, 0.0], 2.0)  # mean |Q| of the policy's actions
    assert weights("better") == ([1.0, 0.0, 0.0, 0.0], 2.0)


def test_sac_update_equals_textbook() -> None:
    """Critic, target and actor after one update, with autograd and Adam written down here."""
    agent, given, entropy = make(SAC, SACConfig, entropy_coefficient=0.2, tau=0.1), batch(), 0.2
    again = make(SAC, SACConfig, entropy_coefficient=0.2, tau=0.1)
    noise = torch.Generator()
    noise.set_state(agent._random.get_state())
    next_noise, this_noise = (torch.randn(64, 2, generator=noise) for _ in range(2))

    def pi(observation: torch.Tensor, drawn: torch.Tensor) -> Any:
        out = again.actor(observation[:, :3], plain=True)[0]
        return squashed_sample(out[:, :2], out[:, 2:].clamp(-20, 2), drawn, True)

    with torch.no_grad():
        action, log_prob = pi(given.next_observation, next_noise)
        twins = again.critic(given.next_observation, action, plain=True)
        target = given.reward + given.discount * (
            torch.minimum(twins[0], twins[1]) - entropy * log_prob
        )
    twins = again.critic(given.observation, given.action, plain=True)
    loss = 0.5 * torch.stack([((one - target) ** 2).mean() for one in twins]).sum()
    optimizer = torch.optim.Adam([again.critic.flat], 3e-4)
    loss.backward()
    optimizer.step()
    action, log_prob = pi(given.observation, this_noise)
    twins = again.critic(given.observation, action, plain=True)
    actor_loss = (entropy * log_prob - torch.minimum(twins[0], twins[1])).mean()
    optimizer = torch.optim.Adam([again.actor.flat], 3e-4)
    (again.actor.flat.grad,) = torch.autograd.grad(actor_loss, [again.actor.flat])
    optimizer.step()
    again.networks["critic_target"].follow(again.critic, 0.1)

    found = agent._learn(given, 0.0)
    assert float(found["critic_loss"]) == pytest.approx(loss.item(), rel=1e-5)
    assert float(found["actor_loss"]) == pytest.approx(actor_loss.item(), rel=1e-5)
    for name, net in agent.networks.items():
        torch.testing.assert_close(net.flat, again.networks[name].flat, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("kind", "config"), KINDS)
def test_targets_by_hand(kind: Any, config: Any) -> None:
    """With critics of value 4 everywhere: r + 0.9 * 4, or r alone where it terminated."""
    agent = make(kind, config)
    with torch.no_grad():
        for name in ("critic", "critic_target"):
            agent.networks[name].weights[-1].zero_()
            agent.networks[name].biases[-1].fill_(4.0)
    given = batch(2)._replace(
        reward=torch.tensor([[1.0], [2.0]]), discount=torch.tensor([[0.9], [0.0]])
    )
    found = agent._learn(given, 0.0)
    # errors 4 - 4.6 and 4 - 2, of both critics
    factor = 0.5 if kind is SAC else 1.0
    assert float(found["critic_loss"]) == pytest.approx(factor * 2 * (0.36 + 4.0) / 2, rel=1e-5)


@pytest.mark.parametrize(("kind", "config"), KINDS)
@pytest.mark.parametrize("cloning", ["likelihood", "squared"])
@pytest.mark.parametrize(
    "weight", ["value", *(pytest.param(one, marks=pytest.mark.slow) for one in ("equal", "better"))]
)
def test_cloning_brings_the_policy_to_the_controller(
    kind: Any, config: Any, cloning: str, weight: str
) -> None:
    agent = make(kind, config, learning_rate=3e-3, cloning=Cloning(kind=cloning, weight=weight))
    given = batch()._replace(
        guide_action=torch.full((64, 2), 0.6), reward=torch.full((64, 1), 10.0)
    )

    def error() -> float:
        with torch.no_grad():
            observed = given.observation[:, :3]
            mean = gaussian(agent.actor, observed)[0] if kind is SAC else agent.actor(observed)[0]
            return float((torch.tanh(mean) - 0.6).abs().mean())

    before = error()
    for _ in range(150):
        agent.updates += 1
        found = agent._learn(given, 100.0)
    assert error() < (0.7 if weight == "better" else 0.3) * before
    assert "bc_loss" in found or kind is TD3


@pytest.mark.parametrize(("kind", "config"), KINDS)
def test_the_actor_is_updated_less_often_and_averaged(kind: Any, config: Any) -> None:
    agent = make(kind, config, policy_delay=3, policy_average=0.9)
    mean = agent.networks["averaged_actor"]
    for i in range(1, 7):
        old, average = agent.actor.flat.detach().clone(), mean.flat.clone()
        agent.updates = i
        agent._learn(batch(seed=i), 0.0)
        assert old.equal(agent.actor.flat) == (i % 3 != 0)
        if i % 3 == 0:
            torch.testing.assert_close(mean.flat, 0.9 * average + 0.1 * agent.actor.flat.detach())
    weight, bias = agent.policy_layers()[-1]
    assert weight.shape == (2, 16) and bias.shape == (2,)
    assert (weight == mean.weights[-1][0, :2].numpy()).all()


def test_the_learning_rate_falls() -> None:
    config = SACConfig(learning_rate=1e-3, learning_rate_end=0.0)
    assert [config.rate(left) for left in (1.0, 0.5, 0.25, 0.0)] == pytest.approx(
        [1e-3, 1e-3, 5e-4, 0.0]
    )
    assert SACConfig().rate(0.0) == 3e-4
