"""Replay memory: one row of numbers a transition, so that a batch is one gather."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch

from dexctl.exceptions import InvalidInput
from learning.algorithms.base import Transitions, Turns


class Batch(NamedTuple):
    """B transitions, on the learner's device.

    Attributes:
        observation, next_observation: ``(B, k)``; the next one of an episode's last step is the
            observation that it ended with, never the first of the next episode.
        action: what was done, ``(B, d)``, in [-1, 1].
        reward: ``(B, 1)``; for n-step returns the discounted sum of up to n, and
            ``next_observation`` and ``terminated`` are of the last of these steps.
        discount: what the value of ``next_observation`` counts: gamma^n, or 0 where the episode
            terminated, ``(B, 1)``.
        guided: 1 where ``guide_action`` is a controller's, ``(B, 1)``.
        guide_action: what a controller did, or would have done, ``(B, d)``.
    """

    observation: torch.Tensor
    action: torch.Tensor
    next_observation: torch.Tensor
    reward: torch.Tensor
    discount: torch.Tensor
    guided: torch.Tensor
    guide_action: torch.Tensor


class Replay:
    """The last transitions of N environments, with what the controllers did in them.

    Rows are allocated once and the pages are touched as they are filled. Sampling has a random
    stream of its own, which is part of `state_dict`.

    Args:
        capacity: transitions of all environments together.
        num_envs, observation_size, action_size: N, K and d.
        labels: keep a controller's action beside the one that was done; otherwise a guided
            transition's own action is the controller's.
        n_step, gamma: of the returns; they end early where the episode or the memory does. The
            actions in between are whoever's acted, without correction.
        seed: of the sampling.
        device: of the batches.
        turns: symmetries; each transition of a batch is turned by one that is drawn for it.

    Attributes:
        position: the row of steps that is written next.
        full: whether old steps are overwritten.
    """

    def __init__(
        self,
        capacity: int,
        *,
        num_envs: int,
        observation_size: int,
        action_size: int,
        labels: bool = False,
        n_step: int = 1,
        gamma: float = 0.99,
        seed: int = 0,
        device: str = "cpu",
        turns: Turns | None = None,
    ) -> None:
        if capacity < num_envs:
            raise InvalidInput(
                f"the replay buffer holds {capacity} transitions; expected at least one for "
                f"each of {num_envs} environments"
            )
        self.num_envs, self.labels, self.n_step, self.gamma = num_envs, labels, n_step, gamma
        self.device, self.turns = device, turns
        k, d = observation_size, action_size
        edges = np.cumsum([0, k, k, d, 1, 1, 1, 1, d if labels else 0])
        self._columns = [slice(int(a), int(b)) for a, b in pairwise(edges)]
        self._rows = np.zeros((capacity // num_envs, num_envs, int(edges[-1])), np.float32)
        self._rng = np.random.default_rng(seed)
        self.position, self.full = 0, False

    def __len__(self) -> int:
        """Steps of all environments that are kept."""
        return len(self._rows) if self.full else self.position

    @property
    def nbytes(self) -> int:
        """Memory that the full buffer takes [B]; a checkpoint holds as much of it as is filled."""
        return self._rows.nbytes

    def add(self, step: Transitions) -> None:
        """Keep one step of all environments.

        Raises:
            InvalidInput: a number is not finite; nothing was added.
        """
        step.check()
        n = self.num_envs
        guided = np.zeros(n) if step.guided is None else step.guided
        single = (step.reward, step.terminated, step.ended, guided)
        parts = [
            step.observation,
            step.next_observation,
            step.action,
            *(s[:, None] for s in single),
        ]
        if self.labels:
            parts.append(step.action if step.guide_action is None else step.guide_action)
        np.concatenate(parts, axis=1, out=self._rows[self.position], casting="unsafe")
        self.position += 1
        if self.position == len(self._rows):
            self.full, self.position = True, 0

    def sample(self, batch_size: int) -> Batch:
        """``batch_size`` transitions, drawn with replacement."""
        flat = self._rows.reshape(-1, self._rows.shape[-1])
        index = self._rng.integers(0, len(self) * self.num_envs, batch_size)
        rows = flat[index]
        observation, following, action, reward, terminated, _, guided, label = (
            rows[:, c] for c in self._columns
        )
        discount: Any = self.gamma
        if self.n_step > 1:
            last, reward, discount = self._ahead(flat, index)
            following, terminated = last[:, self._columns[1]], last[:, self._columns[4]]
        discount = discount * (1.0 - terminated)
        if self.turns is not None:
            which = self._rng.integers(0, len(self.turns.elements), batch_size)
            observation, following = (
                self.turns.observation(which, part) for part in (observation, following)
            )
            action = self.turns.action(which, action)
            label = self.turns.action(which, label) if self.labels else label
        found = (
            observation, action, following, reward, discount, guided,
            label if self.labels else action,
        )  # fmt: skip
        return Batch(*(self._tensor(part) for part in found))

    def _tensor(self, part: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(part, np.float32)).to(self.device)

    def _ahead(
        self, flat: np.ndarray, index: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rows that the n-step returns end with, the returns and gamma^n, ``(B, ...)``."""
        n, size = self.n_step, len(self)
        step, env = np.divmod(index, self.num_envs)
        left = (self.position - 1 - step) % size  # younger steps in the memory
        path = (step[:, None] + np.arange(n)) % size * self.num_envs + env[:, None]
        ended = flat[path, self._columns[5].start] > 0
        ended |= np.arange(n) >= left[:, None]
        ended[:, -1] = True
        count = ended.argmax(axis=1)  # steps beyond the first
        weight = self.gamma ** np.arange(n) * (np.arange(n) <= count[:, None])
        reward = (flat[path, self._columns[3].start] * weight).sum(axis=1, keepdims=True)
        last = flat[path[np.arange(len(path)), count]]
        discount = self.gamma ** (count[:, None] + 1.0)
        return last, reward, discount

    def state_dict(self) -> dict[str, Any]:
        """All of it: the rows that are filled (a view, not a copy), and the random stream."""
        return {
            "rows": self._rows[: len(self)],
            "position": self.position,
            "full": self.full,
            "rng": self._rng.bit_generator.state,
        }

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Continue from what `state_dict` gave.

        Raises:
            InvalidInput: it is of a buffer of another shape.
        """
        rows = np.asarray(saved["rows"])
        expected = (len(self._rows) if saved["full"] else saved["position"], *self._rows.shape[1:])
        if rows.shape != expected or len(rows) > len(self._rows):
            raise InvalidInput(
                f"the saved replay buffer has shape {rows.shape}; expected {expected}"
            )
        self._rows[: len(rows)] = rows
        self.position, self.full = int(saved["position"]), bool(saved["full"])
        self._rng.bit_generator.state = saved["rng"]
