"""What the algorithms make of perceptrons: squashed actions, layers of a file, saved weights."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch.nn import functional

from dexctl.exceptions import InvalidInput
from learning.algorithms.base import Layers
from learning.algorithms.perceptrons import Perceptrons

LOG_STD_LOWEST, LOG_STD_HIGHEST = -20.0, 2.0


def gaussian(actor: Perceptrons, observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean and log standard deviation ``(B, d)`` of a = tanh(u), from an actor of 2 d outputs."""
    mean, log_std = actor(observation)[0].chunk(2, dim=1)
    return mean, log_std.clamp(LOG_STD_LOWEST, LOG_STD_HIGHEST)


def squashed_sample(
    mean: torch.Tensor, log_std: torch.Tensor, noise: torch.Tensor, with_log_prob: bool
) -> tuple[torch.Tensor, torch.Tensor | float]:
    """Drawn actions a = tanh(u), and their log probability ``(B, 1)`` or 0 where not asked for."""
    u = mean + torch.exp(log_std) * noise
    action = torch.tanh(u)
    if not with_log_prob:
        return action, 0.0
    # log(1 - tanh(u)^2) without cancellation
    bend = 2.0 * (0.6931471805599453 - u - functional.softplus(-2.0 * u))
    density = -0.5 * noise * noise - log_std - 0.9189385332046727
    return action, (density - bend).sum(dim=1, keepdim=True)


def layers(actor: Perceptrons, outputs: int) -> Layers:
    """(weight, bias) of each layer, of the last one the first ``outputs`` rows."""
    found = [
        (weight[0].detach().cpu().numpy().copy(), bias[0].detach().cpu().numpy().copy())
        for weight, bias in zip(actor.weights, actor.biases, strict=True)
    ]
    weight, bias = found[-1]
    return [*found[:-1], (weight[:outputs], bias[:outputs])]


def take_layers(actor: Perceptrons, policy: Layers, outputs: int) -> None:
    """Give an actor's first ``outputs`` outputs the layers of a policy; others stay as they are.

    Raises:
        InvalidInput: they are of another shape; nothing was changed.
    """
    found = [policy[0][0].shape[1], *(len(bias) for _, bias in policy)]
    own = [*actor.widths[:-1], outputs]
    if found != own:
        raise InvalidInput(f"the policy has layers of {found}; expected {own}")
    with torch.no_grad():
        for i, (weight, bias) in enumerate(policy):
            actor.weights[i][0, : len(bias)] = torch.as_tensor(weight)
            actor.biases[i][0, : len(bias)] = torch.as_tensor(bias)


def numbers(networks: Mapping[str, Perceptrons]) -> dict[str, Any]:
    """The weights of networks, by name; views, not copies."""
    return {
        name: {"widths": list(net.widths), "layer_norm": net.layer_norm, "flat": net.flat.detach()}
        for name, net in networks.items()
    }


def restore(networks: Mapping[str, Perceptrons], saved: Mapping[str, Any]) -> None:
    """Give networks the weights that `numbers` gave.

    Raises:
        InvalidInput: they are of other networks; nothing was changed.
    """
    if set(saved) != set(networks):
        raise InvalidInput(
            f"the saved networks are {', '.join(sorted(saved))}; expected "
            f"{', '.join(sorted(networks))}"
        )
    for name, net in networks.items():
        found, normalised = list(saved[name]["widths"]), bool(saved[name]["layer_norm"])
        fits = saved[name]["flat"].shape == net.flat.shape
        if found != list(net.widths) or normalised != net.layer_norm or not fits:
            raise InvalidInput(
                f"the saved {name} has layers of {found} (layer_norm {normalised}); expected "
                f"{list(net.widths)} (layer_norm {net.layer_norm})"
            )
    with torch.no_grad():
        for name, net in networks.items():
            net.flat.copy_(saved[name]["flat"])
