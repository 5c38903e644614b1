"""What a training run wrote down, as columns of numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dexctl.exceptions import InvalidInput
from dexctl.state import Floats
from learning.settings import TrainConfig
from learning.training.run_folder import RunFolder


@dataclass(frozen=True, eq=False)
class TrainingLog:
    """The rows of ``progress.csv``.

    Attributes:
        columns: by name, ``(R,)``, NaN where a row has none; see `learning.training.log.COLUMNS`.
        config: of the run.
    """

    columns: Mapping[str, Floats]
    config: TrainConfig

    def __len__(self) -> int:
        return len(self.columns["step"])

    def has(self, name: str) -> bool:
        """Whether a column has any number."""
        return name in self.columns and bool(np.isfinite(self.columns[name]).any())

    @property
    def guides(self) -> tuple[str, ...]:
        """Names of the controllers that guided it."""
        return () if self.config.guidance.method == "rl" else self.config.controllers

    def shares(self) -> dict[str, Floats]:
        """Share of the steps that each controller did, ``(R,)``, by name.

        Runs of earlier versions have one share for all of them, here "controllers".
        """
        named = {name: self.columns[f"share_{name}"] for name in self.guides
                 if self.has(f"share_{name}")}  # fmt: skip
        if named or not self.has("controller_share"):
            return named
        one = self.guides[0] if len(self.guides) == 1 else "controllers"
        return {one: self.columns["controller_share"]} if self.guides else {}

    def to_dict(self) -> dict[str, Any]:
        """As JSON can hold it."""
        return {"rows": len(self), **self.columns}


def read_training(folder: Path) -> TrainingLog:
    """The log of the run in ``folder``.

    Raises:
        InvalidInput: there is none, or it cannot be read.
    """
    config, run = read_config(folder), RunFolder(folder)
    if not run.progress_path.exists():
        raise InvalidInput(f"there is no {run.progress_path.name} in {folder}")
    rows = run.progress()
    names = list(rows[0]) if rows else ["step"]
    return TrainingLog({name: np.array([row[name] for row in rows]) for name in names}, config)


def read_config(folder: Path) -> TrainConfig:
    """The configuration of the run in ``folder``, read without torch.

    Raises:
        InvalidInput: there is none, or it is wrong.
    """
    return TrainConfig.from_dict(RunFolder(folder).config_values())
