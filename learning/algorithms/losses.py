"""Behaviour cloning weighted by value (thesis chapter 4, eq. bcloss, with its sign corrected).

The thesis minimises +beta log pi(a|s) Q(s, a), which pushes the policy away from good actions.
Here it is -beta w log pi(a|s) with w = max(Q(s, a), 0): the better an action, the more it is
imitated, and one of negative value is not imitated at all.
"""

from __future__ import annotations

import torch

CLONED_LIMIT = 0.995
"""Actions are cloned up to this: a squashed Gaussian gives those at the bounds no density."""


def imitation_weight(value: torch.Tensor, guided: torch.Tensor) -> torch.Tensor:
    """W of each transition: max(Q(s, a), 0), and 0 where no controller's action is known.

    Args:
        value: Q(s, a) of the controller's action, ``(B, 1)``.
        guided: 1 where there is one, ``(B, 1)``.
    """
    return (value.clamp(min=0.0) * guided).detach()


def cloning_weight(
    kind: str, guide_value: torch.Tensor | None, policy_value: torch.Tensor, guided: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor | float]:
    """Weight of each imitated action ``(B, 1)``, and what the actor's own loss is divided by.

    Args:
        kind: "value": max(Q, 0) as in the thesis; "equal": 1, with the actor's own loss divided
            by the mean |Q| (Fujimoto and Gu 2021), so that beta means the same however large
            values are; "better": 1 where the critics prefer the controller's action to the
            policy's, else 0 (Nair et al. 2018).
        guide_value, policy_value: Q of the controller's and of the policy's action, ``(B, 1)``;
            "equal" does not ask for the first.
        guided: 1 where there is a controller's action, ``(B, 1)``.
    """
    if kind == "value":
        assert guide_value is not None
        return imitation_weight(guide_value, guided), 1.0
    scale = policy_value.abs().mean().clamp(min=1e-3).detach()
    if kind == "better":
        assert guide_value is not None
        guided = guided * (guide_value > policy_value)
    return guided.detach(), scale


def squashed_log_prob(
    action: torch.Tensor, mean: torch.Tensor, log_std: torch.Tensor
) -> torch.Tensor:
    """Log pi(a|s) of a = tanh(u), u ~ N(mean, exp(log_std)^2), ``(B, 1)``; a within (-1, 1)."""
    u = torch.atanh(action)
    z = (u - mean) * torch.exp(-log_std)
    log_prob = -0.5 * (z * z) - log_std - 0.5 * float(torch.log(torch.tensor(2.0 * torch.pi)))
    return (log_prob - torch.log1p(-action * action)).sum(dim=1, keepdim=True)


def likelihood_cloning(
    action: torch.Tensor, mean: torch.Tensor, log_std: torch.Tensor, weight: torch.Tensor
) -> torch.Tensor:
    """-mean(w log pi(a|s)) over the batch, for SAC."""
    cloned = action.clamp(-CLONED_LIMIT, CLONED_LIMIT)
    return -(weight * squashed_log_prob(cloned, mean, log_std)).mean()


def squared_cloning(
    action: torch.Tensor, policy_action: torch.Tensor, weight: torch.Tensor
) -> torch.Tensor:
    """mean(w |pi(s) - a|^2) over the batch, for TD3, whose policy has no density."""
    error = ((policy_action - action) ** 2).sum(dim=1, keepdim=True)
    return (weight * error).mean()


def gaussian_log_prob(
    action: torch.Tensor, mean: torch.Tensor, log_std: torch.Tensor
) -> torch.Tensor:
    """Log density of ``action`` ``(B, d)`` under N(mean, exp(log_std)^2), ``(B,)``."""
    z = (action - mean) * torch.exp(-log_std)
    return (-0.5 * z * z - log_std - 0.9189385332046727).sum(dim=1)


def gaussian_kl(
    old_mean: torch.Tensor, old_log_std: torch.Tensor, mean: torch.Tensor, log_std: torch.Tensor
) -> torch.Tensor:
    """KL(old || new) of diagonal Gaussians ``(B, d)``, ``(B,)``."""
    shift = (torch.exp(2.0 * old_log_std) + (old_mean - mean) ** 2) * torch.exp(-2.0 * log_std)
    return (log_std - old_log_std + 0.5 * shift - 0.5).sum(dim=1)


def clipped_policy_loss(
    log_ratio: torch.Tensor, advantage: torch.Tensor, clip: float
) -> torch.Tensor:
    """-mean(min(r A, clip(r, 1 - c, 1 + c) A)), r the ratio of densities (Schulman et al. 2017)."""
    ratio = torch.exp(log_ratio)
    clipped = ratio.clamp(1.0 - clip, 1.0 + clip)
    return -torch.minimum(ratio * advantage, clipped * advantage).mean()


def value_loss(
    value: torch.Tensor, old_value: torch.Tensor, returns: torch.Tensor, clip: float | None = None
) -> torch.Tensor:
    """Mean squared error; with ``clip`` the greater one: of the value, or of one that moved by it.

    A value that has moved so far towards its return is then held back. So ``clip`` is in the unit
    of returns, and where these are large, values need many updates to get there.
    """
    error = (value - returns) ** 2
    if clip is not None:
        near = old_value + (value - old_value).clamp(-clip, clip)
        error = torch.maximum(error, (near - returns) ** 2)
    return error.mean()


def adapted_rate(rate: float, kl: float, target: float) -> float:
    """The learning rate after an update that changed the policy by ``kl``, as rsl_rl adapts it."""
    if kl > 2.0 * target:
        return max(1e-5, rate / 1.5)
    if 0.0 < kl < 0.5 * target:
        return min(1e-2, rate * 1.5)
    return rate
