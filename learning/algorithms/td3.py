"""TD3, as in the thesis's comparison."""

from __future__ import annotations

from typing import Any, ClassVar

import torch

from learning.algorithms.config import TD3Config
from learning.algorithms.losses import squared_cloning
from learning.algorithms.off_policy import OffPolicy
from learning.algorithms.replay import Batch


class TD3(OffPolicy):
    """Twin delayed DDPG (Fujimoto et al. 2018), and cloning by squared distance.

    Its policy has no density, so that the kind of cloning does not matter.
    """

    name: ClassVar[str] = "td3"
    config: TD3Config

    def __init__(self, config: TD3Config, **options: Any) -> None:
        super().__init__(config, **options)
        self.networks["actor_target"] = self.actor.copy()

    def _explore(self, observation: torch.Tensor) -> torch.Tensor:
        return self._around_the_policy(observation, self.config.exploration_noise)

    def _learn(self, batch: Batch, beta: float) -> dict[str, torch.Tensor]:
        config, networks = self.config, self.networks
        seen, known = batch.observation[:, self._seen], batch.observation[:, self._known]
        with torch.no_grad():
            noise = (config.target_noise * self._noise(batch.action)).clamp_(
                -config.target_noise_clip, config.target_noise_clip
            )
            following = batch.next_observation
            next_action = torch.tanh(networks["actor_target"](following[:, self._seen])[0])
            next_action = (next_action + noise).clamp_(-1.0, 1.0)
            next_value = networks["critic_target"](following[:, self._known], next_action)
        found = {"critic_loss": self._learn_critics(batch, next_value.amin(dim=0), 1.0)}
        if self._actor_waits:
            return found

        action = torch.tanh(self.actor(seen)[0])
        value = self.critic(known, action, frozen=True, first=True)[0]
        actor_loss = -value.mean()
        cloning = torch.zeros(())
        if beta > 0:
            weight, scale = self._weigh(batch, value)
            actor_loss = actor_loss / scale
            cloning = squared_cloning(batch.guide_action, action, weight)
        self._step("actor", actor_loss + beta * cloning)
        networks["critic_target"].follow(self.critic, config.tau)
        networks["actor_target"].follow(self.actor, config.tau)
        return found | {
            "actor_loss": actor_loss.detach(),
            "bc_loss": cloning.detach(),
            "q_mean": value.detach().mean(),
        }
