"""Batched perceptrons: equal to separate ones of torch, and the way by hand to autograd's."""

from __future__ import annotations

from itertools import pairwise

import pytest

pytest.importorskip("torch")

import torch
from torch import nn

from learning.algorithms.perceptrons import Perceptrons, product


def made(count: int, widths: tuple[int, ...], layer_norm: bool = False) -> Perceptrons:
    generator = torch.Generator().manual_seed(0)
    found = Perceptrons(count, widths, layer_norm=layer_norm, generator=generator)
    with torch.no_grad():  # scales and shifts that matter
        for p in (*found.scales, *found.shifts):
            p += 0.3 * torch.randn(p.shape, generator=generator)
    return found


def inputs(rows: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    action = torch.randn(rows, 3, generator=generator).requires_grad_()
    return torch.randn(rows, 5, generator=generator), action


def separate(net: Perceptrons, c: int) -> nn.Sequential:
    """The c-th perceptron as torch has them."""
    modules: list[nn.Module] = []
    for k, (i, o) in enumerate(pairwise(net.widths)):
        linear = nn.Linear(i, o)
        linear.weight.data, linear.bias.data = net.weights[k][c].detach(), net.biases[k][c].detach()
        modules.append(linear)
        if k < len(net.weights) - 1:
            if net.layer_norm:
                norm = nn.LayerNorm(o)
                norm.weight.data, norm.bias.data = (
                    net.scales[k][c].detach(),
                    net.shifts[k][c].detach(),
                )
                modules.append(norm)
            modules.append(nn.ReLU())
    return nn.Sequential(*modules)


@pytest.mark.parametrize("layer_norm", [False, True])
@pytest.mark.parametrize("plain", [False, True])
def test_twins_are_two_separate_perceptrons(layer_norm: bool, plain: bool) -> None:
    net = made(2, (8, 16, 12, 1), layer_norm)
    observation, action = inputs(7)
    found = net(observation, action, plain=plain)
    joined = torch.cat([observation, action], dim=1)
    for c in range(2):
        torch.testing.assert_close(found[c], separate(net, c)(joined))


# 64 rows of 128 to 256 are oneDNN's where it is there, 7 rows never
@pytest.mark.parametrize("rows", [7, 64])
@pytest.mark.parametrize("layer_norm", [False, True])
@pytest.mark.parametrize("widths", [(8, 128, 256, 2), (8, 4), (8, 6, 6, 6, 1)])
def test_by_hand_equals_autograd(rows: int, layer_norm: bool, widths: tuple[int, ...]) -> None:
    net = made(2, widths, layer_norm)
    observation, action = inputs(rows)
    weight = torch.linspace(-1, 1, 2 * rows * widths[-1]).reshape(2, rows, widths[-1])
    found = []
    for plain in (False, True):
        values = net(observation, action, plain=plain)
        grads = torch.autograd.grad((weight * values).sum(), [action, net.flat])
        found.append((values.detach(), *grads))
    for ours, theirs in zip(*found, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-4)


def test_the_least_of_twins_by_hand() -> None:
    """Q_1 = relu(2 a), Q_2 = relu(a) + 0.5: the first is the least where 0 < a < 0.5."""
    net = made(2, (8, 1, 1))
    with torch.no_grad():
        net.flat.zero_()
        net.weights[0][:, 0, 5] = torch.tensor([2.0, 1.0])
        net.weights[1][:] = 1.0
        net.biases[1][1] = 0.5
    action = torch.tensor([[-1.0, 0, 0], [0.25, 0, 0], [2.0, 0, 0]], requires_grad=True)
    values = net(torch.zeros(3, 5), action, frozen=True)
    values.min(dim=0).values.sum().backward()
    assert values[:, :, 0].tolist() == [[0.0, 0.5, 4.0], [0.5, 0.75, 2.5]]
    assert action.grad is not None
    assert action.grad.tolist() == [[0.0, 0, 0], [2.0, 0, 0], [1.0, 0, 0]]
    assert net.flat.grad is None
    one = net(torch.zeros(3, 5), action, frozen=True, first=True)
    assert one[:, :, 0].tolist() == [[0.0, 0.5, 4.0]]


def test_weights_begin_as_those_of_torch() -> None:
    net = made(2, (100, 400, 1))
    weight = net.weights[0].detach()
    assert float(weight.abs().max()) == pytest.approx(0.1, rel=1e-3)
    assert float(weight.std()) == pytest.approx(0.1 / 3**0.5, rel=0.01)
    assert not weight[0].equal(weight[1])


def test_follow_and_copy() -> None:
    source, target = made(2, (4, 3, 1)), made(2, (4, 3, 1)).copy()
    before = target.weights[0].clone()
    with torch.no_grad():
        source.weights[0] += 1.0
    target.follow(source, 0.25)
    torch.testing.assert_close(target.weights[0], before + 0.25)
    assert source.flat.requires_grad and not target.flat.requires_grad


def test_product() -> None:
    generator = torch.Generator().manual_seed(0)
    a, b = torch.randn(64, 128, generator=generator), torch.randn(256, 128, generator=generator)
    bias = torch.randn(256, generator=generator)
    torch.testing.assert_close(product(a, b, bias, relu=True), (a @ b.t() + bias).relu())
    big = product(a.t(), torch.randn(64, 256, generator=generator).t())
    assert big.shape == (128, 256)
