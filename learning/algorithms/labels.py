"""Labels: what controllers would have done, in the states that were last visited."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from dexctl.exceptions import InvalidInput
from learning.algorithms.base import Turns


class Labels:
    """The last labelled states, one row of numbers each, so that a batch is one gather.

    Args:
        capacity: states that are kept.
        observation_size, action_size: k and d.
        seed: of the sampling.
        turns: symmetries; each state of a batch is turned by one that is drawn for it.

    Attributes:
        position: the row that is written next.
        count: rows that are filled.
    """

    def __init__(
        self,
        capacity: int,
        *,
        observation_size: int,
        action_size: int,
        seed: int = 0,
        turns: Turns | None = None,
    ) -> None:
        self._rows = np.zeros((capacity, observation_size + action_size), np.float32)
        self._size, self.turns = observation_size, turns
        self._rng = np.random.default_rng(seed)
        self.position = self.count = 0

    def add(self, observation: np.ndarray, label: np.ndarray) -> None:
        """Keep states ``(n, k)`` with their labels ``(n, d)``; the oldest go."""
        capacity = len(self._rows)
        rows = np.concatenate([observation, label], axis=1, dtype=np.float32, casting="unsafe")
        rows = rows[-capacity:]
        self._rows[(self.position + np.arange(len(rows))) % capacity] = rows
        self.position = (self.position + len(rows)) % capacity
        self.count = min(self.count + len(rows), capacity)

    def sample(self, batch_size: int) -> tuple[np.ndarray, np.ndarray]:
        """States ``(B, k)`` and labels ``(B, d)``, drawn with replacement."""
        rows = self._rows[self._rng.integers(0, self.count, batch_size)]
        observation, label = rows[:, : self._size], rows[:, self._size :]
        if self.turns is not None:
            which = self._rng.integers(0, len(self.turns.elements), batch_size)
            observation = self.turns.observation(which, observation)
            label = self.turns.action(which, label)
        return observation, label

    def state_dict(self) -> dict[str, Any]:
        """All of it: the rows that are filled (a view, not a copy), and the random stream."""
        return {
            "rows": self._rows[: self.count],
            "position": self.position,
            "rng": self._rng.bit_generator.state,
        }

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Continue from what `state_dict` gave.

        Raises:
            InvalidInput: it is of a memory of another shape.
        """
        rows = np.asarray(saved["rows"])
        if rows.ndim != 2 or len(rows) > len(self._rows) or rows.shape[1] != self._rows.shape[1]:
            raise InvalidInput(
                f"the saved labels have shape {rows.shape}; expected up to {self._rows.shape}"
            )
        self._rows[: len(rows)] = rows
        self.position, self.count = int(saved["position"]), len(rows)
        self._rng.bit_generator.state = saved["rng"]
