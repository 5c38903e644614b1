"""The least value of several critics, differentiated only through the critic that gave it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import nn


def least_value(
    critic: Any, observation: torch.Tensor, action: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Min_i Q_i(s, a) ``(B, 1)``, and all of them ``(B, critics)``, without gradient.

    The gradient of the minimum is that of one critic in each row, and only by the action: so half
    of the way back through a pair need not be gone. The numbers are autograd's but for rounding.
    Critics other than perceptrons with ReLU, and those on a GPU, are left to autograd.

    Args:
        critic: stable-baselines3's `ContinuousCritic`; its parameters get no gradient.
        observation, action: ``(B, k)`` and ``(B, d)``.
    """
    networks = [perceptron(network) for network in critic.q_networks]
    inputs = torch.cat([observation, action.detach()], dim=1)
    plain = all(layers is not None for layers in networks)
    if plain and action.device.type == "cpu" and critic.share_features_extractor:
        return _Least.apply(action, inputs, networks)
    values = torch.cat(critic(observation, action), dim=1)
    return values.min(dim=1, keepdim=True).values, values.detach()


def perceptron(network: nn.Module) -> list[nn.Linear] | None:
    """The layers of a perceptron with a ReLU after each but the last; None of anything else."""
    if not isinstance(network, nn.Sequential):
        return None
    modules = list(network)
    kinds = [type(module) for module in modules]
    if kinds != [nn.Linear, nn.ReLU] * (len(modules) // 2) + [nn.Linear]:
        return None
    return [module for module in modules if isinstance(module, nn.Linear)]


class _Least(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        action: torch.Tensor,
        inputs: torch.Tensor,
        networks: Sequence[Sequence[nn.Linear]],
    ) -> tuple[torch.Tensor, torch.Tensor]:
        hidden, values = [], []
        for layers in networks:
            kept = [inputs]
            for layer in layers[:-1]:
                kept.append(torch.addmm(layer.bias, kept[-1], layer.weight.t()).relu_())
            values.append(torch.addmm(layers[-1].bias, kept[-1], layers[-1].weight.t()))
            hidden.append(kept[1:])
        found = torch.cat(values, dim=1)
        least, ctx.which = found.min(dim=1, keepdim=True)
        ctx.networks, ctx.hidden, ctx.width = networks, hidden, action.shape[1]
        ctx.mark_non_differentiable(found)
        return least, found

    @staticmethod
    def backward(ctx: Any, *grads: torch.Tensor) -> tuple[torch.Tensor, None, None]:
        grad = grads[0]
        by_action = grad.new_zeros(len(grad), ctx.width)
        for i, (layers, hidden) in enumerate(zip(ctx.networks, ctx.hidden, strict=True)):
            rows = torch.nonzero(ctx.which[:, 0] == i)[:, 0]
            back = grad.index_select(0, rows)
            for layer, values in zip(layers[:0:-1], hidden[::-1], strict=True):
                back = torch.ops.aten.threshold_backward(
                    back @ layer.weight, values.index_select(0, rows), 0.0
                )
            by_action.index_copy_(0, rows, back @ layers[0].weight[:, -ctx.width :])
        return by_action, None, None
