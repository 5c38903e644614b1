"""PPO whose critic may see more than its actor (Schulman et al. 2017; Pinto et al. 2018)."""

from __future__ import annotations

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
    columns,
)
from learning.algorithms.config import PPOConfig
from learning.algorithms.generators import restore_generator
from learning.algorithms.losses import (
    adapted_rate,
    clipped_policy_loss,
    gaussian_kl,
    gaussian_log_prob,
    squared_cloning,
    value_loss,
)
from learning.algorithms.networks import layers, numbers, restore, take_layers
from learning.algorithms.normalisation import Normalisation
from learning.algorithms.perceptrons import Perceptrons
from learning.algorithms.rollout_buffer import RolloutBuffer, advantages


class PPO(Algorithm):
    """Proximal policy optimisation.

    Actions are drawn from a Gaussian around tanh(network), with one standard deviation for each
    that does not depend on the observation, and cut to [-1, 1] for the environment. Densities are
    those of what was drawn, before the cut: so they are finite, and tanh(network) is the policy.

    It learns from its own actions only, so it takes no guide and clones nobody.

    Args:
        config: the settings.
        groups: columns of an observation that actor ("policy") and critic ("critic") see.
        observation_size, action_size, num_envs: K, d and N.
        labels, cloning: not for PPO; ``labels`` must be False.
        seed: of weights, exploration and minibatches.
        device: that the updates run on.
    """

    # the rate that adapted is the optimiser's
    _of_the_run: ClassVar[tuple[str, ...]] = ("random", "rollout", "optimizer")
    overlaps: ClassVar[bool] = False
    name: ClassVar[str] = "ppo"

    def __init__(
        self,
        config: PPOConfig,
        *,
        groups: Mapping[str, slice],
        observation_size: int,
        action_size: int,
        num_envs: int,
        labels: bool = False,
        cloning: Cloning | None = None,
        seed: int = 0,
        device: str = "cpu",
    ) -> None:
        super().__init__()
        parts = columns(groups, observation_size, num_envs, action_size)
        if labels:
            raise InvalidInput("labels is True; expected False, since PPO imitates nobody")
        if num_envs * config.rollout_steps < config.minibatches:
            raise InvalidInput(
                f"minibatches is {config.minibatches}; expected at most the "
                f"{num_envs * config.rollout_steps} transitions between two updates"
            )
        self.config, self.device, self.num_envs = config, device, num_envs
        self.action_size = action_size
        self._columns: dict[str, slice] = dict(zip(("policy", "critic"), parts, strict=True))
        sizes = {n: len(range(*c.indices(observation_size))) for n, c in self._columns.items()}
        self._random = torch.Generator(device).manual_seed(seed)
        kwargs: Any = {"generator": self._random, "device": device}
        self.actor = Perceptrons(1, (sizes["policy"], *config.network, action_size), **kwargs)
        self.critic = Perceptrons(1, (sizes["critic"], *config.network, 1), **kwargs)
        with torch.no_grad():  # the first actions are about 0 everywhere
            self.actor.weights[-1].mul_(0.01)
            self.actor.biases[-1].mul_(0.01)
        log_std = torch.full((action_size,), float(np.log(config.initial_deviation)), device=device)
        self.log_std = log_std.requires_grad_()
        self.networks = {"actor": self.actor, "critic": self.critic}
        optimised: list[Any] = self._weights
        if config.critic_learning_rate is not None:
            *actor, critic = self._weights
            optimised = [
                {"params": actor},
                {"params": [critic], "lr": config.critic_learning_rate},
            ]
        self.optimizer = torch.optim.Adam(optimised, config.learning_rate, fused=True)
        self._sizes = sizes
        self.normalisations = {
            n: Normalisation(size) for n, size in sizes.items() if config.normalise
        }
        single = ("log_prob", "value", "next_value", "reward", "terminated", "ended")
        self.rollout = RolloutBuffer(
            config.rollout_steps,
            num_envs,
            {**sizes, "action": action_size, "mean": action_size, **dict.fromkeys(single, 0)},
        )
        self._chosen: dict[str, np.ndarray] = {}

    @property
    def _weights(self) -> list[torch.Tensor]:
        return [self.actor.flat, self.log_std, self.critic.flat]

    def _inputs(self, observation: np.ndarray) -> dict[str, np.ndarray]:
        """What actor and critic are given of observations, by group."""
        parts = {name: observation[:, c].astype(np.float32) for name, c in self._columns.items()}
        return parts | {n: one(parts[n]) for n, one in self.normalisations.items()}

    def _see(self, observation: np.ndarray) -> None:
        """Let the normalisations take observations into account."""
        for name, one in self.normalisations.items():
            one.see(observation[:, self._columns[name]])

    def _tensor(self, array: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(array, dtype=torch.float32, device=self.device)

    def _value(self, inputs: np.ndarray) -> np.ndarray:
        return self.critic(self._tensor(inputs))[0, :, 0].cpu().numpy()

    def imitate(
        self,
        observation: np.ndarray,
        action: np.ndarray,
        *,
        epochs: int,
        batch_size: int,
        seed: int,
    ) -> None:
        """By the squared error of the mean action (thesis chapter 5, Alg. IPT)."""
        self._see(observation)
        seen = self._tensor(self._inputs(observation)["policy"])
        wanted = self._tensor(action)
        optimizer = torch.optim.Adam([self.actor.flat], 1e-3)
        order = np.random.default_rng(seed)
        for _ in range(epochs):
            rows = order.permutation(len(action))
            for first in range(0, len(rows), batch_size):
                index = torch.as_tensor(rows[first : first + batch_size], device=self.device)
                mean = torch.tanh(self.actor(seen[index])[0])
                optimizer.zero_grad()
                alike = torch.ones(len(index), 1, device=self.device)
                squared_cloning(wanted[index], mean, alike).backward()
                optimizer.step()

    def act(self, observation: np.ndarray) -> np.ndarray:
        """As of every algorithm; densities and values are kept for the `observe` that follows."""
        self._see(observation)
        inputs = self._inputs(observation)
        with torch.no_grad():
            mean = torch.tanh(self.actor(self._tensor(inputs["policy"]))[0])
            noise = torch.randn(mean.shape, generator=self._random, device=self.device)
            action = mean + torch.exp(self.log_std) * noise
            log_prob = gaussian_log_prob(action, mean, self.log_std)
            found = {"action": action, "mean": mean, "log_prob": log_prob}
            self._chosen = {name: array.cpu().numpy() for name, array in found.items()}
            self._chosen |= {"value": self._value(inputs["critic"]), **inputs}
        return np.clip(self._chosen["action"], -1.0, 1.0)

    def observe(self, transitions: Transitions) -> None:
        transitions.check()
        done = np.clip(self._chosen["action"], -1.0, 1.0) if self._chosen else None
        if done is None or not np.allclose(transitions.action, done, atol=1e-5):
            raise InvalidInput(
                "the actions are not those of the last act(); PPO learns from its own"
            )
        with torch.no_grad():
            following = self._value(self._inputs(transitions.next_observation)["critic"])
        self.rollout.add(
            **self._chosen, next_value=following, reward=transitions.reward,
            terminated=transitions.terminated, ended=transitions.ended,
        )  # fmt: skip
        self._chosen = {}
        self.steps += self.num_envs

    def update(self, *, beta: float = 0.0, left: float = 1.0) -> None:
        if not self.rollout.full:
            return
        config, kept = self.config, self.rollout.arrays
        group = self.optimizer.param_groups[0]
        if config.learning_rate_end is not None:
            end = config.learning_rate_end
            group["lr"] = end + (config.learning_rate - end) * left
        gained = advantages(
            kept["reward"], kept["value"], kept["next_value"], kept["terminated"] > 0,
            kept["ended"] > 0, gamma=config.gamma, gae_lambda=config.gae_lambda,
        )  # fmt: skip
        count = gained.size
        data = {name: self._tensor(a.reshape(count, *a.shape[2:])) for name, a in kept.items()}
        data["returns"] = self._tensor((gained + kept["value"]).reshape(count))
        spread = max(float(gained.std()), 1e-8)
        data["advantage"] = self._tensor(((gained - gained.mean()) / spread).reshape(count))
        old_log_std = self.log_std.detach().clone()
        found: dict[str, list[float]] = {}
        for _ in range(config.epochs):
            order = torch.randperm(count, generator=self._random, device=self.device)
            for index in order.tensor_split(config.minibatches):
                batch = {name: rows[index] for name, rows in data.items()}
                for name, value in self._learn(batch, old_log_std).items():
                    found.setdefault(name, []).append(value)
        self.rollout.position = 0
        self.statistics = {name: float(np.mean(values)) for name, values in found.items()}
        self.statistics["learning_rate"] = group["lr"]

    def _learn(
        self, batch: Mapping[str, torch.Tensor], old_log_std: torch.Tensor
    ) -> dict[str, float]:
        """One step of the optimiser."""
        config, group = self.config, self.optimizer.param_groups[0]
        self.updates += 1
        mean = torch.tanh(self.actor(batch["policy"])[0])
        with torch.no_grad():
            kl = gaussian_kl(batch["mean"], old_log_std, mean, self.log_std).mean().item()
        if config.target_kl is not None:
            group["lr"] = adapted_rate(group["lr"], kl, config.target_kl)
        log_prob = gaussian_log_prob(batch["action"], mean, self.log_std)
        actor_loss = clipped_policy_loss(
            log_prob - batch["log_prob"], batch["advantage"], config.clip
        )
        value = self.critic(batch["critic"])[0, :, 0]
        critic_loss = value_loss(value, batch["value"], batch["returns"], config.value_clip)
        entropy = (self.log_std + 1.4189385332046727).sum()
        loss = actor_loss - config.entropy_coefficient * entropy
        self.optimizer.zero_grad()
        (loss + config.value_weight * critic_loss).backward()
        for weights in ([self.actor.flat, self.log_std], [self.critic.flat]):
            torch.nn.utils.clip_grad_norm_(weights, config.max_gradient)
        if self.steps <= config.critic_steps:  # Adam leaves out what has no gradient
            self.actor.flat.grad = self.log_std.grad = None
        self.optimizer.step()
        return {
            "actor_loss": actor_loss.item(), "critic_loss": critic_loss.item(),
            "entropy": entropy.item(), "kl": kl,
        }  # fmt: skip

    def policy_layers(self) -> Layers:
        found = layers(self.actor, self.action_size)
        if "policy" in self.normalisations:
            found[0] = self.normalisations["policy"].fold(*found[0])
        return found

    def begin_with(self, policy: Layers) -> None:
        """As of every algorithm; the actor takes observations as the policy does from then on."""
        if not self.config.critic_steps:
            raise InvalidInput(
                "critic_steps is 0; the critic of a policy alone has to learn before its actor "
                "does: expected some, such as 500000"
            )
        take_layers(self.actor, policy, self.action_size)
        self.normalisations.pop("policy", None)

    @property
    def diverged(self) -> bool:
        return not all(bool(torch.isfinite(weight).all()) for weight in self._weights)

    def _state(self) -> dict[str, Any]:
        return {
            "networks": numbers(self.networks),
            "log_std": self.log_std.detach(),
            "optimizer": self.optimizer.state_dict(),
            "normalisations": {n: one.state_dict() for n, one in self.normalisations.items()},
            "random": self._random.get_state(),
            "rollout": self.rollout.state_dict(),
        }

    def _load_state(self, saved: Mapping[str, Any]) -> None:
        restore(self.networks, saved["networks"])
        # an actor that began with a policy has none; earlier versions kept them where none is used
        kept = saved["normalisations"] if self.config.normalise else {}
        self.normalisations = {name: Normalisation(self._sizes[name]) for name in kept}
        for name, one in self.normalisations.items():
            one.load_state_dict(kept[name])
        self.rollout.load_state_dict(saved["rollout"])
        with torch.no_grad():
            self.log_std.copy_(saved["log_std"])
        self.optimizer.load_state_dict(deepcopy(saved["optimizer"]))
        restore_generator(self._random, saved["random"])
