"""Networks of the agents: critics that see more than the actor, and layer normalisation."""

from __future__ import annotations

from typing import Any

import torch
from gymnasium import spaces
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, create_mlp
from stable_baselines3.sac.policies import SACPolicy
from stable_baselines3.td3.policies import TD3Policy
from torch import nn


class First(BaseFeaturesExtractor):
    """The first ``size`` values of an observation: what the actor may see of it."""

    def __init__(self, observation_space: spaces.Space, size: int) -> None:
        super().__init__(observation_space, size)
        self._size = size

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        return observations[:, : self._size]


class GuidedPolicy:
    """Mixed in before a policy of stable-baselines3.

    Args:
        actor_size: k, how many values of the observation the actor sees; the critics see all.
            None: all.
        layer_norm: layer normalisation behind each hidden layer of the critics (Ball et al. 2023,
            "Efficient online reinforcement learning with offline data": it bounds what critics
            extrapolate to actions that nobody tried).
    """

    actor_kwargs: dict[str, Any]
    critic_kwargs: dict[str, Any]
    device: torch.device
    observation_space: spaces.Space

    def __init__(
        self,
        *args: Any,
        actor_size: int | None = None,
        layer_norm: bool = False,
        **options: Any,
    ) -> None:
        self._actor_size, self._layer_norm = actor_size, layer_norm
        super().__init__(*args, **options)

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Any:
        if self._actor_size is not None:
            features_extractor = First(self.observation_space, self._actor_size)
        return super().make_actor(features_extractor)  # type: ignore[misc]

    def make_critic(
        self, features_extractor: BaseFeaturesExtractor | None = None
    ) -> ContinuousCritic:
        critic = super().make_critic(features_extractor)  # type: ignore[misc]
        if self._layer_norm:
            normalise(critic)
            critic.to(self.device)
        return critic


class GuidedSACPolicy(GuidedPolicy, SACPolicy):
    """SAC's actor and critics."""


class GuidedTD3Policy(GuidedPolicy, TD3Policy):
    """TD3's actor and critics."""


def normalise(critic: ContinuousCritic) -> None:
    """Put layer normalisation between the hidden layers of ``critic`` and their activations."""
    for i, network in enumerate(critic.q_networks):
        linear = [layer for layer in network if isinstance(layer, nn.Linear)]  # type: ignore[attr-defined]
        widths = [layer.out_features for layer in linear[:-1]]
        made = nn.Sequential(
            *create_mlp(
                linear[0].in_features, 1, widths, nn.ReLU, post_linear_modules=[nn.LayerNorm]
            )
        )
        critic.add_module(f"qf{i}", made)
        critic.q_networks[i] = made
