"""DAgger: one policy that does what controllers would do, wherever it comes to by itself."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from typing import Any, ClassVar

import numpy as np
import torch

from dexctl.exceptions import InvalidInput
from learning.algorithms.base import Algorithm, Cloning, Layers, Transitions, Turns, columns
from learning.algorithms.config import DAggerConfig
from learning.algorithms.labels import Labels
from learning.algorithms.losses import squared_cloning
from learning.algorithms.networks import layers, numbers, restore, take_layers
from learning.algorithms.perceptrons import Perceptrons


class DAgger(Algorithm):
    """Dataset aggregation (Ross, Gordon and Bagnell 2011, Alg. 3.1), a step at a time.

    The policy acts from the first step on, with noise. What controllers, or other policies, would
    have done in the states that it comes to is remembered, and the policy is fitted to that by the
    squared error: to all of it and not to the last states only, as aggregation asks for. There is
    no critic, and no reward is looked at. So it brings together what several do, each with its
    object or axis, and what sees more than a policy may: it does no better than they do.

    Args:
        config: the settings.
        groups: columns of an observation; those of the "policy" are seen.
        observation_size, action_size, num_envs: K, d and N.
        labels: whether states are labelled with controllers' actions; they have to be.
        cloning: not used: by the squared error.
        seed: of weights, exploration and sampling.
        device: that the updates run on.
        turns: symmetries that what is learned from is turned by, drawn anew each time.

    Raises:
        InvalidInput: ``labels`` is False, or a size or group is wrong.
    """

    name: ClassVar[str] = "dagger"
    overlaps: ClassVar[bool] = True
    _of_the_run: ClassVar[tuple[str, ...]] = ("random", "memory")

    def __init__(
        self,
        config: DAggerConfig,
        *,
        groups: Mapping[str, slice],
        observation_size: int,
        action_size: int,
        num_envs: int,
        labels: bool = True,
        cloning: Cloning | None = None,
        seed: int = 0,
        device: str = "cpu",
        turns: Turns | None = None,
    ) -> None:
        super().__init__()
        if not labels:
            raise InvalidInput(
                "labels is False; expected True, since DAgger learns from nothing else"
            )
        self.config, self.device = config, device
        self.num_envs, self.action_size = num_envs, action_size
        self._seen, _ = columns(groups, observation_size, num_envs, action_size)
        self._random = torch.Generator(device).manual_seed(seed)
        # turns are of whole observations
        width = len(range(*self._seen.indices(observation_size)))
        self.memory = Labels(
            config.buffer_size, observation_size=observation_size if turns else width,
            action_size=action_size, seed=seed, turns=turns,
        )  # fmt: skip
        self.actor = Perceptrons(
            1, (width, *config.network, action_size), generator=self._random, device=device
        )
        self.networks = {"actor": self.actor}
        if config.policy_average > 0:
            self.networks["averaged_actor"] = self.actor.copy()
        self.optimizer = torch.optim.Adam([self.actor.flat], config.learning_rate, fused=True)

    def _tensor(self, array: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(np.ascontiguousarray(array, np.float32), device=self.device)

    def act(self, observation: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            mean = torch.tanh(self.actor(self._tensor(observation[:, self._seen]))[0])
            noise = torch.randn(mean.shape, generator=self._random, device=self.device)
            action = mean + self.config.action_noise * noise
        return action.clamp(-1.0, 1.0).cpu().numpy()

    def observe(self, transitions: Transitions) -> None:
        transitions.check()
        seen, label, guided = transitions.observation, transitions.guide_action, transitions.guided
        if self.memory.turns is None:
            seen = seen[:, self._seen]
        if label is not None and guided is not None:
            self.memory.add(seen[guided], label[guided])
        self.steps += self.num_envs

    def update(self, *, beta: float = 0.0, left: float = 1.0) -> None:
        """As of every algorithm; it does nothing but clone, so ``beta`` is not looked at."""
        if not self.memory.count:
            return
        self.optimizer.param_groups[0]["lr"] = self.config.rate(left)
        found = []
        for _ in range(self.config.gradient_steps):
            self.updates += 1
            seen, label = self.memory.sample(self.config.batch_size)
            if self.memory.turns is not None:
                seen = seen[:, self._seen]
            action = torch.tanh(self.actor(self._tensor(seen))[0])
            alike = torch.ones((len(action), 1), device=self.device)
            loss = squared_cloning(self._tensor(label), action, alike)
            self.optimizer.zero_grad()
            loss.backward()
            self.optimizer.step()
            if "averaged_actor" in self.networks:
                average = self.networks["averaged_actor"]
                average.follow(self.actor, 1.0 - self.config.policy_average)
            found.append(loss.detach())
        self.statistics = {"bc_loss": float(torch.stack(found).mean())}

    def policy_layers(self) -> Layers:
        return layers(self.networks.get("averaged_actor", self.actor), self.action_size)

    def begin_with(self, policy: Layers) -> None:
        take_layers(self.actor, policy, self.action_size)
        if "averaged_actor" in self.networks:
            with torch.no_grad():
                self.networks["averaged_actor"].flat.copy_(self.actor.flat)

    @property
    def diverged(self) -> bool:
        return not all(bool(torch.isfinite(net.flat).all()) for net in self.networks.values())

    def _state(self) -> dict[str, Any]:
        return {
            "networks": numbers(self.networks),
            "optimizer": self.optimizer.state_dict(),
            "random": self._random.get_state(),
            "memory": self.memory.state_dict(),
        }

    def _load_state(self, saved: Mapping[str, Any]) -> None:
        restore(self.networks, saved["networks"])
        self.memory.load_state_dict(saved["memory"])
        self.optimizer.load_state_dict(deepcopy(saved["optimizer"]))
        self._random.set_state(saved["random"])
