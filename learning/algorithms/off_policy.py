"""What SAC and TD3 share: a memory, twin critics with targets, an actor and its average."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from copy import deepcopy
from typing import Any, ClassVar

import numpy as np
import torch

from dexctl.exceptions import InvalidInput
from learning.algorithms.base import (
    Algorithm,
    Cloning,
    Layers,
    Transitions,
    Turns,
    columns,
)
from learning.algorithms.losses import cloning_weight
from learning.algorithms.networks import layers, numbers, restore, take_layers
from learning.algorithms.perceptrons import Perceptrons
from learning.algorithms.replay import Batch, Replay


class OffPolicy(Algorithm):
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

    overlaps: ClassVar[bool] = True
    _outputs_per_action: ClassVar[int] = 1
    _of_the_run: ClassVar[tuple[str, ...]] = ("random", "replay")

    def __init__(
        self,
        config: Any,
        *,
        groups: Mapping[str, slice],
        observation_size: int,
        action_size: int,
        num_envs: int,
        labels: bool = False,
        cloning: Cloning | None = None,
        seed: int = 0,
        device: str = "cpu",
        turns: Turns | None = None,
    ) -> None:
        super().__init__()
        self.config, self.cloning, self.device = config, cloning or Cloning(), device
        self._seen, self._known = columns(groups, observation_size, num_envs, action_size)
        self.num_envs, self.action_size = num_envs, action_size
        self._random = torch.Generator(device).manual_seed(seed)
        self.replay = Replay(
            config.buffer_size, num_envs=num_envs, observation_size=observation_size,
            action_size=action_size, labels=labels, n_step=config.n_step, gamma=config.gamma,
            seed=seed, device=device, turns=turns,
        )  # fmt: skip

        def width(part: slice) -> int:
            return len(range(*part.indices(observation_size)))

        kwargs: Any = {"generator": self._random, "device": device}
        outputs = action_size * self._outputs_per_action
        self.actor = Perceptrons(1, (width(self._seen), *config.network, outputs), **kwargs)
        inputs = width(self._known) + action_size
        self.critic = Perceptrons(
            2, (inputs, *config.network, 1), layer_norm=config.layer_norm, **kwargs
        )
        self.networks = {
            "actor": self.actor, "critic": self.critic, "critic_target": self.critic.copy(),
        }  # fmt: skip
        if config.policy_average > 0:
            self.networks["averaged_actor"] = self.actor.copy()
        self.optimizers = {
            name: torch.optim.Adam([self.networks[name].flat], config.learning_rate, fused=True)
            for name in ("actor", "critic")
        }

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

    def update(self, *, beta: float = 0.0, left: float = 1.0) -> None:
        if self.steps <= self.config.learning_starts:
            return
        for optimizer in self.optimizers.values():
            optimizer.param_groups[0]["lr"] = self.config.rate(left)
        found: dict[str, list[torch.Tensor]] = {}
        for _ in range(self.config.gradient_steps):
            self.updates += 1
            for name, value in self._learn(
                self.replay.sample(self.config.batch_size), beta
            ).items():
                found.setdefault(name, []).append(value)
        self.statistics |= {name: float(torch.stack(v).mean()) for name, v in found.items()}

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

    def _tensor(self, array: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(np.asarray(array, np.float32), device=self.device)

    def _noise(self, like: torch.Tensor) -> torch.Tensor:
        return torch.randn(like.shape, generator=self._random, device=self.device)

    def _learn_critics(self, batch: Batch, next_value: torch.Tensor, weight: float) -> torch.Tensor:
        """Towards r + discount Q(s', a'), ``next_value`` ``(B, 1)``; the loss."""
        target = batch.reward + batch.discount * next_value
        values = self.critic(batch.observation[:, self._known], batch.action)
        loss = weight * ((values - target) ** 2).mean(dim=(1, 2)).sum()
        self._step("critic", loss)
        return loss.detach()

    def _step(self, name: str, loss: torch.Tensor) -> None:
        self.optimizers[name].zero_grad()
        loss.backward()
        self.optimizers[name].step()
        if name == "actor" and "averaged_actor" in self.networks:
            average = self.networks["averaged_actor"]
            average.follow(self.actor, 1.0 - self.config.policy_average)

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

    def policy_layers(self) -> Layers:
        return layers(self.networks.get("averaged_actor", self.actor), self.action_size)

    def begin_with(self, policy: Layers) -> None:
        config, d = self.config, self.action_size
        if config.actor_starts <= config.learning_starts:
            raise InvalidInput(
                f"actor_starts is {config.actor_starts}; the critics of a policy alone have to "
                f"learn before its actor does: expected more than learning_starts, "
                f"{config.learning_starts}, such as 100000"
            )
        take_layers(self.actor, policy, d)
        with torch.no_grad():
            self.actor.weights[-1][0, d:] = 0.0
            self.actor.biases[-1][0, d:] = self._beside_the_mean()
            for name in ("averaged_actor", "actor_target"):
                if name in self.networks:
                    self.networks[name].flat.copy_(self.actor.flat)

    def _beside_the_mean(self) -> float:
        """Output of an actor beside the mean action, where it begins with a policy alone."""
        return 0.0

    @property
    def _actor_waits(self) -> bool:
        """Whether this update is of the critics alone."""
        config = self.config
        return bool(self.updates % config.policy_delay) or self.steps < config.actor_starts

    @property
    def diverged(self) -> bool:
        return not all(bool(torch.isfinite(net.flat).all()) for net in self.networks.values())

    def _state(self) -> dict[str, Any]:
        return {
            "networks": numbers(self.networks),
            "optimizers": {name: o.state_dict() for name, o in self.optimizers.items()},
            "random": self._random.get_state(),
            "replay": self.replay.state_dict(),
        }

    def _load_state(self, saved: Mapping[str, Any]) -> None:
        restore(self.networks, saved["networks"])
        self.replay.load_state_dict(saved["replay"])
        for name, optimizer in self.optimizers.items():
            optimizer.load_state_dict(deepcopy(saved["optimizers"][name]))
        self._random.set_state(saved["random"])
