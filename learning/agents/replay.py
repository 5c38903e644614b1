"""Replay memory: one row of numbers a transition, so that a batch is one gather."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import BaseBuffer, ReplayBuffer

from dexctl.exceptions import InvalidInput


class GuidedSamples(NamedTuple):
    """A batch of B transitions, on the learner's device; the first five as stable-baselines3's.

    Attributes:
        observations, next_observations: ``(B, k)``; the next one of an episode's last step is
            the observation it ended with, never the first of the next episode.
        actions: what was done, ``(B, d)``, in [-1, 1].
        dones: 1 where the episode terminated; 0 where it was cut by its time limit, ``(B, 1)``.
        rewards: ``(B, 1)``; for n-step returns the discounted sum of up to n, and
            ``next_observations`` and ``dones`` are of the last of these steps.
        discounts: gamma^n of n-step returns, ``(B, 1)``; None where n is 1.
        guided: 1 where ``guide_actions`` is a controller's, ``(B, 1)``.
        guide_actions: what a controller did, or would have done, ``(B, d)``.
    """

    observations: torch.Tensor
    actions: torch.Tensor
    next_observations: torch.Tensor
    dones: torch.Tensor
    rewards: torch.Tensor
    discounts: torch.Tensor | None
    guided: torch.Tensor
    guide_actions: torch.Tensor


class GuidedReplayBuffer(ReplayBuffer):
    """The last transitions of N environments, with what the controllers did in them.

    Rows are allocated once and the pages are touched as they are filled. Sampling has a random
    stream of its own, which is part of :meth:`state_dict`.

    Args:
        buffer_size: transitions of all environments together.
        observation_space, action_space, device, n_envs: as stable-baselines3's.
        optimize_memory_usage: must be False.
        labels: keep a controller's action beside the one that was done (for RL+BC); otherwise a
            guided transition's own action is the controller's.
        n_step, gamma: of the returns; they end early where the episode or the memory does. The
            actions in between are whoever's acted, without correction.
        seed: of the sampling.
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        device: torch.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        *,
        labels: bool = False,
        n_step: int = 1,
        gamma: float = 0.99,
        seed: int = 0,
    ) -> None:
        if buffer_size < n_envs:
            raise InvalidInput(
                f"the replay buffer holds {buffer_size} transitions; expected at least one for "
                f"each of {n_envs} environments"
            )
        if optimize_memory_usage:
            raise InvalidInput("optimize_memory_usage is True; this buffer has no such variant")
        steps = buffer_size // n_envs
        BaseBuffer.__init__(self, steps, observation_space, action_space, device, n_envs)
        self.optimize_memory_usage = False
        self.handle_timeout_termination = False
        self.labels, self.n_step, self.gamma = labels, n_step, gamma
        (k,) = self.obs_shape
        d = int(self.action_dim)
        edges = np.cumsum([0, k, k, d, 1, 1, 1, 1, d if labels else 0])
        self._columns = [slice(int(a), int(b)) for a, b in pairwise(edges)]
        self._rows = np.zeros((steps, n_envs, int(edges[-1])), np.float32)
        self._rng = np.random.default_rng(seed)

    @property
    def nbytes(self) -> int:
        """Memory that the full buffer takes [B]; a checkpoint holds as much of it as is filled."""
        return self._rows.nbytes

    def add(
        self,
        obs: np.ndarray,
        next_obs: np.ndarray,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]] | None = None,
        *,
        ended: np.ndarray | None = None,
        guided: np.ndarray | None = None,
        guide_action: np.ndarray | None = None,
    ) -> None:
        """Add one step of all environments.

        Args:
            obs, next_obs, action, reward, done: ``(N, ...)``; ``done`` only where the episode
                terminated.
            infos: not read.
            ended: where the episode terminated or was cut, ``(N,)``; as ``done`` without.
            guided: where a controller did, or labels, this step, ``(N,)``; nowhere without.
            guide_action: its labels ``(N, d)``, for a buffer that keeps them.

        Raises:
            InvalidInput: a number is not finite; nothing was added.
        """
        row = self._rows[self.pos]
        columns = [obs, next_obs, action, reward[:, None], done[:, None]]
        columns += [(done if ended is None else ended)[:, None]]
        columns += [np.zeros((self.n_envs, 1)) if guided is None else guided[:, None]]
        if self.labels:
            columns += [np.zeros_like(action) if guide_action is None else guide_action]
        new = np.concatenate(columns, axis=1, dtype=np.float32)
        if not np.isfinite(new.sum()):
            bad = np.flatnonzero(~np.isfinite(new).all(axis=1))
            raise InvalidInput(
                f"a transition of environments {bad[:8].tolist()} is not finite: NaN or infinity "
                "in observation, action or reward"
            )
        row[:] = new
        self.pos += 1
        if self.pos == self.buffer_size:
            self.full, self.pos = True, 0

    def sample(self, batch_size: int, env: Any = None) -> GuidedSamples:
        """``batch_size`` transitions, drawn with replacement; ``env`` is not used."""
        flat = self._rows.reshape(-1, self._rows.shape[-1])
        index = self._rng.integers(0, self.size() * self.n_envs, batch_size)
        rows = torch.from_numpy(flat[index]).to(self.device)
        obs, next_obs, action, reward, done, _, guided, label = (rows[:, c] for c in self._columns)
        discounts = None
        if self.n_step > 1:
            last, reward, discounts = (
                torch.from_numpy(found).to(self.device) for found in self._ahead(flat, index)
            )
            next_obs, done = last[:, self._columns[1]], last[:, self._columns[4]]
        return GuidedSamples(
            obs, action, next_obs, done, reward, discounts, guided, label if self.labels else action
        )

    def _ahead(
        self, flat: np.ndarray, index: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rows that the n-step returns end with, the returns and gamma^n, ``(B, ...)``."""
        n, size = self.n_step, self.size()
        step, env = np.divmod(index, self.n_envs)
        left = (self.pos - 1 - step) % size  # younger steps in the memory
        path = (step[:, None] + np.arange(n)) % size * self.n_envs + env[:, None]
        ended = flat[path, self._columns[5].start] > 0
        ended |= np.arange(n) >= left[:, None]
        ended[:, -1] = True
        count = ended.argmax(axis=1)  # steps beyond the first
        weight = self.gamma ** np.arange(n) * (np.arange(n) <= count[:, None])
        reward = (flat[path, self._columns[3].start] * weight).sum(axis=1, keepdims=True)
        last = flat[path[np.arange(len(path)), count]]
        discount = self.gamma ** (count[:, None] + 1.0)
        return last, reward.astype(np.float32), discount.astype(np.float32)

    def state_dict(self) -> dict[str, Any]:
        """All of it: the rows that are filled (a view, not a copy), and the random stream."""
        return {
            "rows": torch.from_numpy(self._rows[: self.size()]),
            "pos": self.pos,
            "full": self.full,
            "rng": self._rng.bit_generator.state,
        }

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Continue from what `state_dict` gave.

        Raises:
            InvalidInput: it is of a buffer of another shape.
        """
        rows = saved["rows"].numpy()
        fits = saved["pos"] if not saved["full"] else self.buffer_size
        if rows.shape != (fits, *self._rows.shape[1:]):
            raise InvalidInput(
                f"the saved replay buffer has shape {rows.shape}; expected "
                f"{(fits, *self._rows.shape[1:])}"
            )
        self._rows[: len(rows)] = rows
        self.pos, self.full = int(saved["pos"]), bool(saved["full"])
        self._rng.bit_generator.state = saved["rng"]
