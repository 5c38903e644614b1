"""What SAC and TD3 share: a memory of transitions, and twin critics with targets."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch

from dexctl.exceptions import InvalidInput
from learning.algorithms.base import Cloning, Layers, Transitions, Turns
from learning.algorithms.losses import cloning_weight
from learning.algorithms.remembering import Remembering
from learning.algorithms.replay import Batch, Replay


class OffPolicy(Remembering):
    """An algorithm that learns from a memory of what anybody did.

    Args:
        config: the settings.
        groups: columns of an observation that actor ("policy") and critics ("critic") see.
        observation_size, action_size, num_envs: K, d and N.
        labels: whether states are labelled with controllers' actions, whoever acts.
        cloning: how these are imitated where `update` is given a ``beta`` above 0.
        seed: of weights, exploration and sampling.
        device: that the updates run on.
        turns: symmetries that what is learned from is turned by, drawn anew each time.
    """

    _of_the_run: ClassVar[tuple[str, ...]] = ("random", "replay")

    def __init__(
        self,
        config: Any,
        *,
        observation_size: int,
        action_size: int,
        num_envs: int,
        labels: bool = False,
        cloning: Cloning | None = None,
        seed: int = 0,
        device: str = "cpu",
        turns: Turns | None = None,
        **options: Any,
    ) -> None:
        sizes: dict[str, int] = {
            "observation_size": observation_size, "action_size": action_size, "num_envs": num_envs,
        }  # fmt: skip
        super().__init__(config, **sizes, seed=seed, device=device, **options)
        self.cloning = cloning or Cloning()
        self.replay = Replay(
            config.buffer_size, **sizes, labels=labels, n_step=config.n_step, gamma=config.gamma,
            seed=seed, device=device, turns=turns,
        )  # fmt: skip
        inputs = self._widths[1] + action_size
        self.critic = self._perceptrons(2, (inputs, *config.network, 1), config.layer_norm)
        self.networks |= {"critic": self.critic, "critic_target": self.critic.copy()}
        self.optimizers["critic"] = self._optimizer(self.critic)

    @abstractmethod
    def _explore(self, observation: torch.Tensor) -> torch.Tensor:
        """Actions of the policy ``(N, d)`` in [-1, 1], with whatever explores."""

    @abstractmethod
    def _learn(self, batch: Batch, beta: float) -> dict[str, torch.Tensor]:
        """One update; what it found, by name."""

    def act(self, observation: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            if self.steps < self.config.learning_starts and not self.begun:
                shape = (self.num_envs, self.action_size)
                drawn = torch.rand(shape, generator=self._random, device=self.device)
                return (2.0 * drawn - 1.0).cpu().numpy()
            return self._explore(self._tensor(observation)[:, self._seen]).cpu().numpy()

    def observe(self, transitions: Transitions) -> None:
        self.replay.add(transitions)
        self.steps += self.num_envs

    @property
    def _ready(self) -> bool:
        return self.steps > self.config.learning_starts

    def _learn_once(self, beta: float) -> dict[str, torch.Tensor]:
        return self._learn(self.replay.sample(self.config.batch_size), beta)

    def values(self, observation: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """The smaller of the critics' values of actions.

        Args:
            observation: ``(n, K)``.
            actions: candidates ``(C, n, d)`` in [-1, 1].

        Returns:
            ``(C, n)``.
        """
        count, n, d = actions.shape
        with torch.no_grad():
            known = self._tensor(observation)[:, self._known].repeat(count, 1)
            found = self.critic(known, self._tensor(actions.reshape(count * n, d)))
            return found.amin(dim=0).reshape(count, n).cpu().numpy()

    def _learn_critics(self, batch: Batch, next_value: torch.Tensor, weight: float) -> torch.Tensor:
        """Towards r + discount Q(s', a'), ``next_value`` ``(B, 1)``; the loss."""
        target = batch.reward + batch.discount * next_value
        values = self.critic(batch.observation[:, self._known], batch.action)
        loss = weight * ((values - target) ** 2).mean(dim=(1, 2)).sum()
        self._step("critic", loss)
        return loss.detach()

    def _weigh(
        self, batch: Batch, policy_value: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor | float]:
        """See `learning.algorithms.losses.cloning_weight`; ``policy_value`` is ``(B, 1)``."""
        guide_value = None
        if self.cloning.weight != "equal":
            with torch.no_grad():
                known = batch.observation[:, self._known]
                guide_value = self.critic(known, batch.guide_action).amin(dim=0)
        return cloning_weight(self.cloning.weight, guide_value, policy_value.detach(), batch.guided)

    def begin_with(self, policy: Layers) -> None:
        config = self.config
        if config.actor_starts <= config.learning_starts:
            raise InvalidInput(
                f"actor_starts is {config.actor_starts}; the critics of a policy alone have to "
                f"learn before its actor does: expected more than learning_starts, "
                f"{config.learning_starts}, such as 100000"
            )
        super().begin_with(policy)

    @property
    def _actor_waits(self) -> bool:
        """Whether this update is of the critics alone."""
        config = self.config
        return bool(self.updates % config.policy_delay) or self.steps < config.actor_starts

    def _state(self) -> dict[str, Any]:
        return {**super()._state(), "replay": self.replay.state_dict()}

    def _load_state(self, saved: Mapping[str, Any]) -> None:
        super()._load_state(saved)
        self.replay.load_state_dict(saved["replay"])
