"""What a training run wrote down, as columns of numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from dexctl.state import Floats
from learning.config import TrainConfig
from learning.training.run_folder import RunFolder


@dataclass(frozen=True, eq=False)
class TrainingLog:
    """The log of a run.

    Attributes:
        columns: by name, ``(R,)``, NaN where a row has none; see `learning.training.log.columns`.
        config: of the run.
    """

    columns: Mapping[str, Floats]
    config: TrainConfig

    def __len__(self) -> int:
        return len(self.columns["step"])

    def has(self, name: str) -> bool:
        """Whether a column has any number."""
        return name in self.columns and bool(np.isfinite(self.columns[name]).any())

    def shares(self) -> dict[str, Floats]:
        """Share of the steps that each controller did, ``(R,)``, by name."""
        found = {name: f"share_{name}" for name in self.config.guides}
        return {name: self.columns[key] for name, key in found.items() if self.has(key)}

    def to_dict(self) -> dict[str, Any]:
        """As JSON can hold it."""
        return {"rows": len(self), **self.columns}


def read_training(folder: RunFolder) -> TrainingLog:
    """The log of a run; it has no rows where nothing is written yet.

    Raises:
        InvalidInput: it cannot be read.
    """
    rows = folder.progress()
    names = list(rows[0]) if rows else ["step"]
    columns = {name: np.array([row[name] for row in rows]) for name in names}
    return TrainingLog(columns, folder.config())
