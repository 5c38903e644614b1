"""TD3 with a guide."""

from __future__ import annotations

from typing import Any

import torch
from stable_baselines3 import TD3
from torch.nn import functional

from learning.agents.guided import GuidedExploration, follow, frozen, means
from learning.agents.losses import squared_cloning
from learning.agents.replay import GuidedReplayBuffer
from learning.exploration.guide import Guide


class GuidedTD3(GuidedExploration, TD3):
    """Twin delayed DDPG whose behaviour is a mixture of its policy and controllers.

    The update is stable-baselines3's, plus behaviour cloning where the method has it.

    Args:
        policy, env, **options: as `stable_baselines3.TD3`'s.
        guide: who acts.
        exploration_noise: standard deviation of what is added to the policy's actions.
        overlap: whether environments step while the updates run, see `OverlappedLoop`.
        average: see `GuidedExploration`.
    """

    def __init__(
        self,
        policy: Any,
        env: Any,
        *,
        guide: Guide | None = None,
        exploration_noise: float = 0.1,
        policy_delay: int | None = None,
        overlap: bool = False,
        average: float = 0.0,
        **options: Any,
    ) -> None:
        options = {"replay_buffer_class": GuidedReplayBuffer, **options}
        super().__init__(policy, env, policy_delay=policy_delay or 2, **options)
        self._begin(guide, exploration_noise, overlap, average)

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """``gradient_steps`` updates of the critic; of actor and targets at every second one."""
        assert self.replay_buffer is not None
        self.policy.set_training_mode(True)
        self._update_learning_rate([self.actor.optimizer, self.critic.optimizer])
        beta, actor_updates = self._beta(), 0
        of_critic = {"critic_loss": torch.zeros((), device=self.device)}
        names = ("actor_loss", "bc_loss", "q_mean")
        of_actor = {name: torch.zeros((), device=self.device) for name in names}
        for _ in range(gradient_steps):
            self._n_updates += 1
            batch = self.replay_buffer.sample(batch_size)
            with torch.no_grad():
                noise = torch.randn_like(batch.actions) * self.target_policy_noise
                noise = noise.clamp(-self.target_noise_clip, self.target_noise_clip)
                next_action = (self.actor_target(batch.next_observations) + noise).clamp(-1, 1)
                target = torch.cat(self.critic_target(batch.next_observations, next_action), dim=1)
                target = target.min(dim=1, keepdim=True).values
                discount = self.gamma if batch.discounts is None else batch.discounts
                target = batch.rewards + (1.0 - batch.dones) * discount * target
            values = self.critic(batch.observations, batch.actions)
            critic_loss = torch.stack(
                [functional.mse_loss(value, target) for value in values]
            ).sum()
            self.critic.optimizer.zero_grad()
            critic_loss.backward()
            self.critic.optimizer.step()
            of_critic["critic_loss"] += critic_loss.detach()
            if self._n_updates % self.policy_delay:
                continue

            with frozen(self.critic):
                action = self.actor(batch.observations)
                value = self.critic.q1_forward(batch.observations, action)
                actor_loss = -value.mean()
                cloning = torch.zeros((), device=self.device)
                if beta > 0:
                    weight, scale = self._cloning_weight(batch, value)
                    actor_loss = actor_loss / scale
                    cloning = squared_cloning(batch.guide_actions, action, weight)
                self.actor.optimizer.zero_grad()
                (actor_loss + beta * cloning).backward()
            self.actor.optimizer.step()
            self._actor_updated()
            follow(self.critic_target, self.critic, self.tau)
            follow(self.actor_target, self.actor, self.tau)
            actor_updates += 1
            of_actor["actor_loss"] += actor_loss.detach()
            of_actor["bc_loss"] += cloning.detach()
            of_actor["q_mean"] += value.detach().mean()
        self.statistics |= means(of_critic, gradient_steps)
        if actor_updates:
            self.statistics |= means(of_actor, actor_updates)
