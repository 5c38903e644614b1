"""What a training run wrote down, as columns of numbers."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dexctl.exceptions import InvalidInput
from dexctl.state import Floats
from learning.settings import TrainConfig

CSV_NAME = "progress.csv"


@dataclass(frozen=True, eq=False)
class TrainingLog:
    """The rows of ``progress.csv``.

    Attributes:
        columns: by name, ``(R,)``, NaN where a row has none; see `learning.run_log.COLUMNS`.
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
    config, path = read_config(folder), folder / CSV_NAME
    try:
        with path.open(newline="", encoding="utf-8") as stream:
            # a row that a kill cut short lacks its last column
            rows = [row for row in csv.DictReader(stream) if row.get("seconds")]
    except FileNotFoundError:
        raise InvalidInput(f"there is no {CSV_NAME} in {folder}") from None
    names = list(rows[0]) if rows else ["step"]
    try:
        columns = {
            name: np.array([float(row[name]) if row[name] else np.nan for row in rows])
            for name in names
        }
    except (ValueError, KeyError, TypeError) as error:
        raise InvalidInput(f"{path} is not a training log: {error}") from None
    if "step" not in columns:
        raise InvalidInput(f"{path} is not a training log: it has no column step")
    return TrainingLog(columns, config)


def read_config(folder: Path) -> TrainConfig:
    """The configuration of the run in ``folder``, read without torch.

    Raises:
        InvalidInput: there is none, or it is wrong.
    """
    path = folder / "config.json"
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InvalidInput(f"there is no run in {folder}: no config.json") from None
    except ValueError as error:
        raise InvalidInput(f"{path} is not JSON: {error}") from None
    return TrainConfig.from_dict(values)
