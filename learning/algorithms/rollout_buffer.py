"""The steps between two updates of an on-policy algorithm, and what their actions gained."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from dexctl.exceptions import InvalidInput


def advantages(
    reward: np.ndarray,
    value: np.ndarray,
    next_value: np.ndarray,
    terminated: np.ndarray,
    ended: np.ndarray,
    *,
    gamma: float,
    gae_lambda: float,
) -> np.ndarray:
    """Generalised advantage estimates (Schulman et al. 2016).

    Nothing follows where an episode terminated. Where it was cut by its time limit, the value of
    the observation that it ended with follows, and nothing of the next episode.

    Args:
        reward, value, terminated, ended: of each step, ``(T, N)``.
        next_value: of what each step led to, ``(T, N)``.
        gamma: discount.
        gae_lambda: 0 trusts the values, 1 the rewards.

    Returns:
        ``(T, N)``; added to ``value``, they are the returns.
    """
    delta = reward + gamma * next_value * ~terminated - value
    going_on = gamma * gae_lambda * ~ended
    found, after = np.zeros_like(delta), np.zeros_like(delta[0])
    for t in range(len(delta) - 1, -1, -1):
        after = delta[t] + going_on[t] * after
        found[t] = after
    return found


class RolloutBuffer:
    """T steps of N environments, as arrays ``(T, N, ...)`` by name.

    Args:
        steps, num_envs: T and N.
        widths: numbers of each entry; 0: a single one, without an axis of its own.
    """

    def __init__(self, steps: int, num_envs: int, widths: Mapping[str, int]) -> None:
        self.arrays = {
            name: np.zeros((steps, num_envs, *((width,) if width else ())), np.float32)
            for name, width in widths.items()
        }
        self._steps, self.position = steps, 0

    @property
    def full(self) -> bool:
        """Whether an update is due."""
        return self.position == self._steps

    def add(self, **step: np.ndarray) -> None:
        """Keep one step of all environments: every entry by name."""
        for name, array in self.arrays.items():
            array[self.position] = step[name]
        self.position += 1

    def state_dict(self) -> dict[str, Any]:
        """The steps so far (views, not copies)."""
        return {"arrays": {name: array[: self.position] for name, array in self.arrays.items()}}

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Continue from what `state_dict` gave.

        Raises:
            InvalidInput: it is of a buffer of another shape.
        """
        found = {name: np.asarray(array) for name, array in saved["arrays"].items()}
        shapes = {name: array.shape[1:] for name, array in found.items()}
        expected = {name: array.shape[1:] for name, array in self.arrays.items()}
        lengths = {len(array) for array in found.values()}
        if shapes != expected or len(lengths) != 1 or max(lengths) > self._steps:
            raise InvalidInput(f"the saved rollout has entries {shapes}; expected {expected}")
        (self.position,) = lengths
        for name, array in found.items():
            self.arrays[name][: self.position] = array
