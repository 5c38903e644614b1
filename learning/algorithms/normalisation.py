"""Running mean and deviation of observations, and how they go into a policy's first layer."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from dexctl.exceptions import InvalidInput


class Normalisation:
    """(x - mean) / deviation of all that was seen so far (Chan et al. 1979).

    Nothing is cut off: then the first layer of a policy can take it over, see `fold`.

    Args:
        size: numbers of an observation.
    """

    def __init__(self, size: int) -> None:
        self.mean, self.squares, self.count = np.zeros(size), np.zeros(size), 0

    @property
    def deviation(self) -> np.ndarray:
        """Standard deviation ``(size,)``, at least 0.01; 1 before anything was seen."""
        if not self.count:
            return np.ones_like(self.mean)
        return np.maximum(np.sqrt(self.squares / self.count), 1e-2)

    def see(self, observation: np.ndarray) -> None:
        """Take observations ``(N, size)`` into account."""
        rows = observation.astype(float)
        mean, count = rows.mean(axis=0), len(rows)
        shift, total = mean - self.mean, self.count + count
        self.squares += ((rows - mean) ** 2).sum(axis=0)
        self.squares += shift**2 * (self.count * count / total)
        self.mean += shift * (count / total)
        self.count = total

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Normalised observations, float32."""
        return ((observation - self.mean) / self.deviation).astype(np.float32)

    def fold(self, weight: np.ndarray, bias: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The layer that does to observations what (weight, bias) does to normalised ones."""
        scaled = weight / self.deviation
        return scaled.astype(np.float32), (bias - scaled @ self.mean).astype(np.float32)

    def state_dict(self) -> dict[str, Any]:
        """What was seen, as arrays and a count."""
        return {"mean": self.mean, "squares": self.squares, "count": self.count}

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Continue from what `state_dict` gave."""
        if np.shape(saved["mean"]) != self.mean.shape:
            raise InvalidInput(
                f"the saved normalisation has {len(saved['mean'])} numbers; "
                f"expected {len(self.mean)}"
            )
        self.mean, self.squares = np.array(saved["mean"]), np.array(saved["squares"])
        self.count = int(saved["count"])
