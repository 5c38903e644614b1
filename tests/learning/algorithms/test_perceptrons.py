"""The least of the critics' values: numbers and gradient are autograd's."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("stable_baselines3")

import torch
from gymnasium import spaces
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.torch_layers import FlattenExtractor
from torch import nn

from learning.agents.guided import frozen
from learning.agents.least import least_value, perceptron


def critic(count: int = 2, widths: tuple[int, ...] = (16, 12)) -> Any:
    torch.manual_seed(0)
    observed = spaces.Box(-1, 1, (5,), np.float32)
    extractor = FlattenExtractor(observed)
    return ContinuousCritic(
        observed, spaces.Box(-1, 1, (3,), np.float32), list(widths), extractor, 5, n_critics=count
    )


def inputs(rows: int = 200) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    observation = torch.randn(rows, 5, generator=generator)
    return observation, torch.randn(rows, 3, generator=generator).requires_grad_()


@pytest.mark.parametrize(("count", "widths"), [(2, (16, 12)), (3, (8,)), (1, (8, 8, 8)), (2, ())])
def test_equals_autograd(count: int, widths: tuple[int, ...]) -> None:
    critics = critic(count, widths)
    observation, action = inputs()
    with frozen(critics):
        least, values = least_value(critics, observation, action)
    weight = torch.linspace(-1, 1, len(action))[:, None]
    (weight * least).sum().backward()
    ours, action.grad = action.grad, None
    plain = torch.cat(critics(observation, action), dim=1)
    (weight * plain.min(dim=1, keepdim=True).values).sum().backward()
    assert len(set(plain.argmin(dim=1).tolist())) == count  # each of them is the least somewhere
    torch.testing.assert_close(values, plain.detach())
    torch.testing.assert_close(least, plain.min(dim=1, keepdim=True).values)
    torch.testing.assert_close(ours, action.grad)
    assert not values.requires_grad


def test_by_hand() -> None:
    """Q_1 = relu(2 a), Q_2 = relu(a) + 0.5: the first is the least where 0 < a < 0.5."""
    critics = critic(2, (1,))
    with torch.no_grad():
        for network, slope, bias in zip(critics.q_networks, (2.0, 1.0), (0.0, 0.5), strict=True):
            for parameter in network.parameters():
                parameter.zero_()
            network[0].weight[0, 5], network[2].weight[0, 0] = slope, 1.0
            network[2].bias[0] = bias
    action = torch.tensor([[-1.0, 0, 0], [0.25, 0, 0], [2.0, 0, 0]], requires_grad=True)
    least, values = least_value(critics, torch.zeros(3, 5), action)
    least.sum().backward()
    assert least.flatten().tolist() == [0.0, 0.5, 2.5]
    assert values.tolist() == [[0.0, 0.5], [0.5, 0.75], [4.0, 2.5]]
    assert action.grad is not None
    assert action.grad.tolist() == [[0.0, 0, 0], [2.0, 0, 0], [1.0, 0, 0]]


def test_other_critics_are_left_to_autograd() -> None:
    critics = critic()
    critics.q_networks[1] = nn.Sequential(
        nn.Linear(8, 4), nn.LayerNorm(4), nn.ReLU(), nn.Linear(4, 1)
    )
    assert perceptron(critics.q_networks[0]) is not None
    assert perceptron(critics.q_networks[1]) is None is perceptron(nn.Linear(8, 1))
    observation, action = inputs()
    least, values = least_value(critics, observation, action)
    least.sum().backward()
    plain = torch.cat(
        [network(torch.cat([observation, action], 1)) for network in critics.q_networks], 1
    )
    (expected,) = torch.autograd.grad(plain.min(dim=1).values.sum(), action)
    torch.testing.assert_close(action.grad, expected)
    assert not values.requires_grad
