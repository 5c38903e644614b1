"""The updates: equal to stable-baselines3's without controllers; the cloning by hand."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import gymnasium
import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("stable_baselines3")

import torch
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.logger import configure
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from learning.agents import GuidedSAC, GuidedTD3
from learning.agents.guided import follow, frozen
from learning.agents.losses import (
    imitation_weight,
    likelihood_cloning,
    squared_cloning,
    squashed_log_prob,
)
from learning.agents.replay import GuidedSamples
from learning.agents.sac import squashed_sample

KWARGS: dict[str, Any] = {
    "seed": 1,
    "device": "cpu",
    "buffer_size": 100,
    "gamma": 0.9,
    "policy_kwargs": {"net_arch": [16, 16]},
}


def batches(count: int, guided: float = 0.0) -> list[GuidedSamples]:
    """Transitions of Pendulum's shapes: 3 numbers observed, 1 action."""
    generator = torch.Generator().manual_seed(0)

    def draw(*shape: int) -> torch.Tensor:
        return 2 * torch.rand(*shape, generator=generator) - 1

    return [
        GuidedSamples(
            draw(8, 3), draw(8, 1), draw(8, 3), (draw(8, 1) > 0.5).float(), draw(8, 1), None,
            torch.full((8, 1), guided), draw(8, 1),
        )
        for _ in range(count)
    ]  # fmt: skip


def feed(agent: Any, given: list[Any]) -> None:
    """Make ``agent`` sample these batches, one after the other."""
    left = iter(given)
    agent.replay_buffer.sample = lambda *_args, **_kwargs: next(left)
    agent.set_logger(configure(None, []))


@pytest.mark.parametrize(
    ("ours", "stock", "options"),
    [
        (GuidedSAC, SAC, {"ent_coef": 0.0}),
        (GuidedSAC, SAC, {"ent_coef": 0.2}),
        (GuidedTD3, TD3, {}),
    ],
)
def test_updates_equal_stock(ours: Any, stock: Any, options: dict[str, Any]) -> None:
    given = batches(6)
    found = []
    for kind in (ours, stock):
        env = gymnasium.make("Pendulum-v1")
        agent = kind("MlpPolicy", env, **deepcopy(KWARGS), **options)
        plain = [ReplayBufferSamples(*batch[:5]) for batch in given]
        feed(agent, given if kind is ours else plain)
        torch.manual_seed(7)
        agent.train(6, 8)
        found.append(agent.policy.state_dict())
    a, b = found
    assert a.keys() == b.keys()
    for name in a:
        torch.testing.assert_close(a[name], b[name], rtol=1e-4, atol=1e-6)


def test_fused_adam_equals_plain_adam() -> None:
    found = []
    for fused in (True, False):
        kwargs = {**KWARGS["policy_kwargs"], "optimizer_kwargs": {"fused": fused}}
        env = gymnasium.make("Pendulum-v1")
        agent = GuidedSAC("MlpPolicy", env, **{**KWARGS, "policy_kwargs": kwargs})
        feed(agent, batches(4))
        torch.manual_seed(7)
        agent.train(4, 8)
        found.append(agent.policy.state_dict())
    for name in found[0]:
        torch.testing.assert_close(found[0][name], found[1][name], rtol=1e-4, atol=1e-6)


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
    action, log_prob = squashed_sample(mean, log_std, True)
    inside = (action.abs() < 0.99).all(dim=1)
    again = squashed_log_prob(action, mean, log_std)
    assert isinstance(log_prob, torch.Tensor)
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


@pytest.mark.parametrize("kind", [GuidedSAC, GuidedTD3])
def test_cloning_brings_the_policy_to_the_controller(kind: Any) -> None:
    """With a positive value, the deterministic policy comes closer to the controller's actions."""
    agent = kind(
        "MlpPolicy", gymnasium.make("Pendulum-v1"), **{**deepcopy(KWARGS), "learning_rate": 3e-3}
    )
    agent._beta = lambda: 100.0
    batch = batches(1, guided=1.0)[0]
    batch = batch._replace(guide_actions=0.6 * torch.ones(8, 1), rewards=10 * torch.ones(8, 1))

    def error() -> float:
        with torch.no_grad():
            obs = batch.observations
            action = agent.actor(obs, deterministic=True) if kind is GuidedSAC else agent.actor(obs)
        return float((action - 0.6).abs().mean())

    before = error()
    feed(agent, [batch] * 150)
    agent.train(150, 8)
    assert error() < 0.3 * before
    assert agent.statistics["bc_loss"] != 0.0


def test_frozen_lets_gradients_through_and_leaves_none() -> None:
    layer = torch.nn.Linear(2, 1)
    x = torch.ones(1, 2, requires_grad=True)
    with frozen(layer):
        layer(x).sum().backward()
    assert layer.weight.grad is None and x.grad is not None
    assert layer.weight.requires_grad


def test_follow() -> None:
    target, source = torch.nn.Linear(2, 1), torch.nn.Linear(2, 1)
    expected = 0.75 * target.weight.detach() + 0.25 * source.weight.detach()
    follow(target, source, 0.25)
    torch.testing.assert_close(target.weight.detach(), expected)
