"""What the algorithms share that learn from a memory: an actor, its average, and updates by it."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from copy import deepcopy
from typing import Any, ClassVar

import numpy as np
import torch

from learning.algorithms.base import Algorithm, Layers, columns
from learning.algorithms.generators import restore_generator
from learning.algorithms.networks import layers, numbers, restore, take_layers
from learning.algorithms.perceptrons import Perceptrons


class Remembering(Algorithm):
    """An algorithm whose updates are by batches of a memory, so that they may overlap with steps.

    Args:
        config: the settings, a `learning.algorithms.config.RememberingConfig`.
        groups: columns of an observation that actor ("policy") and critics ("critic") see.
        observation_size, action_size, num_envs: K, d and N.
        seed: of weights and exploration.
        device: that the updates run on.

    Attributes:
        actor: whose tanh, of the first d outputs, is the policy.
        networks: by name, the actor and, with a policy average, its average among them.
        optimizers: of the networks that learn, by their names.
    """

    overlaps: ClassVar[bool] = True
    _outputs_per_action: ClassVar[int] = 1

    def __init__(
        self,
        config: Any,
        *,
        groups: Mapping[str, slice],
        observation_size: int,
        action_size: int,
        num_envs: int,
        seed: int,
        device: str,
    ) -> None:
        super().__init__()
        self.config, self.device = config, device
        self._seen, self._known = columns(groups, observation_size, num_envs, action_size)
        self.num_envs, self.action_size = num_envs, action_size
        self._widths = [
            len(range(*part.indices(observation_size))) for part in (self._seen, self._known)
        ]
        self._random = torch.Generator(device).manual_seed(seed)
        outputs = action_size * self._outputs_per_action
        self.actor = self._perceptrons(1, (self._widths[0], *config.network, outputs))
        self.networks = {"actor": self.actor}
        if config.policy_average > 0:
            self.networks["averaged_actor"] = self.actor.copy()
        self.optimizers = {"actor": self._optimizer(self.actor)}

    def _perceptrons(
        self, count: int, widths: tuple[int, ...], layer_norm: bool = False
    ) -> Perceptrons:
        return Perceptrons(
            count, widths, layer_norm=layer_norm, generator=self._random, device=self.device
        )

    def _optimizer(self, network: Perceptrons) -> torch.optim.Adam:
        return torch.optim.Adam([network.flat], self.config.learning_rate, fused=True)

    @property
    @abstractmethod
    def _ready(self) -> bool:
        """Whether there is something to learn from."""

    @abstractmethod
    def _learn_once(self, beta: float) -> dict[str, torch.Tensor]:
        """One update; what it found, by name."""

    def update(self, *, beta: float = 0.0, left: float = 1.0) -> None:
        if not self._ready:
            return
        for optimizer in self.optimizers.values():
            optimizer.param_groups[0]["lr"] = self.config.rate(left)
        found: dict[str, list[torch.Tensor]] = {}
        for _ in range(self.config.gradient_steps):
            self.updates += 1
            for name, value in self._learn_once(beta).items():
                found.setdefault(name, []).append(value)
        self.statistics |= {name: float(torch.stack(v).mean()) for name, v in found.items()}

    def _tensor(self, array: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(np.ascontiguousarray(array, np.float32), device=self.device)

    def _noise(self, like: torch.Tensor) -> torch.Tensor:
        return torch.randn(like.shape, generator=self._random, device=self.device)

    def _around_the_policy(self, observation: torch.Tensor, deviation: float) -> torch.Tensor:
        """The policy's actions with noise, cut to [-1, 1]; ``observation`` as the actor sees it."""
        action = torch.tanh(self.actor(observation)[0])
        return (action + deviation * self._noise(action)).clamp_(-1.0, 1.0)

    def _step(self, name: str, loss: torch.Tensor) -> None:
        self.optimizers[name].zero_grad()
        loss.backward()
        self.optimizers[name].step()
        if name == "actor" and "averaged_actor" in self.networks:
            average = self.networks["averaged_actor"]
            average.follow(self.actor, 1.0 - self.config.policy_average)

    def policy_layers(self) -> Layers:
        return layers(self.networks.get("averaged_actor", self.actor), self.action_size)

    def begin_with(self, policy: Layers) -> None:
        d = self.action_size
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
    def diverged(self) -> bool:
        return not all(bool(torch.isfinite(net.flat).all()) for net in self.networks.values())

    def _state(self) -> dict[str, Any]:
        return {
            "networks": numbers(self.networks),
            "optimizers": {name: o.state_dict() for name, o in self.optimizers.items()},
            "random": self._random.get_state(),
        }

    def _load_state(self, saved: Mapping[str, Any]) -> None:
        restore(self.networks, saved["networks"])
        for name, optimizer in self.optimizers.items():
            optimizer.load_state_dict(deepcopy(saved["optimizers"][name]))
        restore_generator(self._random, saved["random"])
