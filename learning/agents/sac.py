"""SAC with a guide: the agent of the thesis."""

from __future__ import annotations

from typing import Any

import torch
from stable_baselines3 import SAC
from torch.nn import functional

from learning.agents.guided import GuidedExploration, follow, frozen, means
from learning.agents.least import least_value
from learning.agents.losses import likelihood_cloning, squared_cloning
from learning.agents.replay import GuidedReplayBuffer
from learning.exploration.guide import Guide


class GuidedSAC(GuidedExploration, SAC):
    """Soft actor-critic whose behaviour is a mixture of its policy and controllers.

    The update is stable-baselines3's with a fixed entropy coefficient, plus behaviour cloning
    where the method has it. It is restated to compute less: the actor's loss is differentiated
    through the critic of least value alone (`least_value`), and log probabilities are left out
    where the entropy coefficient is 0, the thesis's.

    Args:
        policy, env, **options: as `stable_baselines3.SAC`'s; ``ent_coef`` must be a number.
        guide: who acts.
        exploration_noise: added to the policy's actions.
        policy_delay: updates of the critics to one of the actor; None: 1.
        overlap: whether environments step while the updates run, see `OverlappedLoop`.
        average: see `GuidedExploration`.
    """

    def __init__(
        self,
        policy: Any,
        env: Any,
        *,
        guide: Guide | None = None,
        exploration_noise: float = 0.0,
        policy_delay: int | None = None,
        overlap: bool = False,
        average: float = 0.0,
        **options: Any,
    ) -> None:
        options = {"ent_coef": 0.0, "replay_buffer_class": GuidedReplayBuffer, **options}
        super().__init__(policy, env, **options)
        self._begin(guide, exploration_noise, overlap, average)
        self.policy_delay = policy_delay or 1

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """``gradient_steps`` updates of critic, actor and target."""
        assert self.replay_buffer is not None
        self.policy.set_training_mode(True)
        self._update_learning_rate([self.actor.optimizer, self.critic.optimizer])
        entropy_weight, beta = float(self.ent_coef), self._beta()
        squared = self.guide is not None and self.guide.config.cloning == "squared"
        names = ("critic_loss", "actor_loss", "bc_loss", "q_mean")
        sums = {name: torch.zeros((), device=self.device) for name in names}
        actor_updates = 0
        for _ in range(gradient_steps):
            self._n_updates += 1
            batch = self.replay_buffer.sample(batch_size)
            if updates_actor := self._n_updates % self.policy_delay == 0:
                mean, log_std, _ = self.actor.get_action_dist_params(batch.observations)
                action, log_prob = squashed_sample(mean, log_std, bool(entropy_weight))
            with torch.no_grad():
                next_action, next_log_prob = self._draw(batch.next_observations, entropy_weight)
                target = torch.cat(self.critic_target(batch.next_observations, next_action), dim=1)
                target = target.min(dim=1, keepdim=True).values - entropy_weight * next_log_prob
                discount = self.gamma if batch.discounts is None else batch.discounts
                target = batch.rewards + (1.0 - batch.dones) * discount * target
            values = self.critic(batch.observations, batch.actions)
            critic_loss = (
                0.5 * torch.stack([functional.mse_loss(value, target) for value in values]).sum()
            )
            self.critic.optimizer.zero_grad()
            critic_loss.backward()
            self.critic.optimizer.step()
            follow(self.critic_target, self.critic, self.tau)
            sums["critic_loss"] += critic_loss.detach()
            if not updates_actor:
                continue

            with frozen(self.critic):
                least, value = least_value(self.critic, batch.observations, action)
                actor_loss = (entropy_weight * log_prob - least).mean()
                cloning = torch.zeros((), device=self.device)
                if beta > 0:
                    weight, scale = self._cloning_weight(batch, least)
                    actor_loss = actor_loss / scale
                    if squared:
                        cloning = squared_cloning(batch.guide_actions, torch.tanh(mean), weight)
                    else:
                        cloning = likelihood_cloning(batch.guide_actions, mean, log_std, weight)
                self.actor.optimizer.zero_grad()
                (actor_loss + beta * cloning).backward()
            self.actor.optimizer.step()
            self._actor_updated()
            actor_updates += 1
            sums["actor_loss"] += actor_loss.detach()
            sums["bc_loss"] += cloning.detach()
            sums["q_mean"] += value.mean()
        critics = {"critic_loss": sums.pop("critic_loss")}
        self.statistics |= means(critics, gradient_steps)
        if actor_updates:
            self.statistics |= means(sums, actor_updates)

    def _draw(
        self, observation: torch.Tensor, entropy_weight: float
    ) -> tuple[torch.Tensor, torch.Tensor | float]:
        mean, log_std, _ = self.actor.get_action_dist_params(observation)
        return squashed_sample(mean, log_std, bool(entropy_weight))


def squashed_sample(
    mean: torch.Tensor, log_std: torch.Tensor, with_log_prob: bool
) -> tuple[torch.Tensor, torch.Tensor | float]:
    """Drawn actions a = tanh(u), and their log probability ``(B, 1)`` or 0 where not asked for."""
    noise = torch.randn_like(mean)
    u = mean + torch.exp(log_std) * noise
    action = torch.tanh(u)
    if not with_log_prob:
        return action, 0.0
    # log(1 - tanh(u)^2) without cancellation
    bend = 2.0 * (0.6931471805599453 - u - functional.softplus(-2.0 * u))
    gaussian = -0.5 * noise * noise - log_std - 0.9189385332046727
    return action, (gaussian - bend).sum(dim=1, keepdim=True)
