"""SAC: the algorithm of the thesis."""

from __future__ import annotations

import math
from typing import ClassVar

import torch

from learning.algorithms.config import SACConfig
from learning.algorithms.losses import likelihood_cloning, squared_cloning
from learning.algorithms.networks import gaussian, squashed_sample
from learning.algorithms.off_policy import OffPolicy
from learning.algorithms.replay import Batch


class SAC(OffPolicy):
    """Soft actor-critic (Haarnoja et al. 2018) with a fixed entropy coefficient, and cloning.

    Log probabilities are left out where the coefficient is 0. The actor goes up the smaller of
    both critics, and only that one is differentiated in each row.
    """

    name: ClassVar[str] = "sac"
    _outputs_per_action: ClassVar[int] = 2
    config: SACConfig

    def _beside_the_mean(self) -> float:
        return math.log(self.config.initial_deviation)

    def _explore(self, observation: torch.Tensor) -> torch.Tensor:
        return self._draw(observation)[0]

    def _draw(
        self, observation: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor | float, torch.Tensor, torch.Tensor]:
        """Actions, their log probability, and mean and log standard deviation before the tanh."""
        mean, log_std = gaussian(self.actor, observation)
        with_log_prob = self.config.entropy_coefficient > 0
        return *squashed_sample(mean, log_std, self._noise(mean), with_log_prob), mean, log_std

    def _learn(self, batch: Batch, beta: float) -> dict[str, torch.Tensor]:
        entropy = self.config.entropy_coefficient
        seen, known = batch.observation[:, self._seen], batch.observation[:, self._known]
        target = self.networks["critic_target"]
        with torch.no_grad():
            next_action, next_log_prob, *_ = self._draw(batch.next_observation[:, self._seen])
            next_value = target(batch.next_observation[:, self._known], next_action).amin(dim=0)
        found = {
            "critic_loss": self._learn_critics(batch, next_value - entropy * next_log_prob, 0.5)
        }
        target.follow(self.critic, self.config.tau)
        if self._actor_waits:
            return found

        action, log_prob, mean, log_std = self._draw(seen)
        values = self.critic(known, action, frozen=True)
        least = values.min(dim=0).values
        actor_loss = (entropy * log_prob - least).mean()
        cloning = torch.zeros(())
        if beta > 0:
            weight, scale = self._weigh(batch, least)
            actor_loss = actor_loss / scale
            if self.cloning.kind == "squared":
                cloning = squared_cloning(batch.guide_action, torch.tanh(mean), weight)
            else:
                cloning = likelihood_cloning(batch.guide_action, mean, log_std, weight)
        self._step("actor", actor_loss + beta * cloning)
        return found | {
            "actor_loss": actor_loss.detach(),
            "bc_loss": cloning.detach(),
            "q_mean": values.detach().mean(),
        }
