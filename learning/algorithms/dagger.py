"""DAgger: one policy that does what controllers would do, wherever it comes to by itself."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch

from dexctl.exceptions import InvalidInput
from learning.algorithms.base import Cloning, Transitions, Turns
from learning.algorithms.config import DAggerConfig
from learning.algorithms.labels import Labels
from learning.algorithms.losses import squared_cloning
from learning.algorithms.remembering import Remembering


class DAgger(Remembering):
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
    _of_the_run: ClassVar[tuple[str, ...]] = ("random", "memory")
    config: DAggerConfig

    def __init__(
        self,
        config: DAggerConfig,
        *,
        observation_size: int,
        action_size: int,
        labels: bool = True,
        cloning: Cloning | None = None,
        seed: int = 0,
        device: str = "cpu",
        turns: Turns | None = None,
        **options: Any,
    ) -> None:
        if not labels:
            raise InvalidInput("labels is False; expected True: DAgger learns from nothing else")
        sizes: dict[str, int] = {"observation_size": observation_size, "action_size": action_size}
        super().__init__(config, **sizes, seed=seed, device=device, **options)
        # symmetries turn whole observations; without them the policy's columns are enough
        every = slice(None)
        self._kept, self._of_kept = (self._seen, every) if turns is None else (every, self._seen)
        self.memory = Labels(
            config.buffer_size, observation_size=len(range(observation_size)[self._kept]),
            action_size=action_size, seed=seed, turns=turns,
        )  # fmt: skip

    def act(self, observation: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            seen = self._tensor(observation[:, self._seen])
            return self._around_the_policy(seen, self.config.action_noise).cpu().numpy()

    def observe(self, transitions: Transitions) -> None:
        transitions.check()
        label, guided = transitions.guide_action, transitions.guided
        if label is not None and guided is not None:
            self.memory.add(transitions.observation[guided, self._kept], label[guided])
        self.steps += self.num_envs

    @property
    def _ready(self) -> bool:
        return self.memory.count > 0

    def _learn_once(self, beta: float) -> dict[str, torch.Tensor]:
        """It does nothing but clone, so ``beta`` is not looked at."""
        seen, label = self.memory.sample(self.config.batch_size)
        action = torch.tanh(self.actor(self._tensor(seen[:, self._of_kept]))[0])
        alike = torch.ones((len(action), 1), device=self.device)
        loss = squared_cloning(self._tensor(label), action, alike)
        self._step("actor", loss)
        return {"bc_loss": loss.detach()}

    def _state(self) -> dict[str, Any]:
        return {**super()._state(), "memory": self.memory.state_dict()}

    def _load_state(self, saved: Mapping[str, Any]) -> None:
        super()._load_state(saved)
        self.memory.load_state_dict(saved["memory"])
