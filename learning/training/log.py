"""What a training run writes down as it goes: one CSV file, and TensorBoard beside it."""

from __future__ import annotations

import csv
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

CSV_NAME = "progress.csv"
TENSORBOARD_FOLDER = "tensorboard"
COLUMNS = {
    "step": "environment steps so far",
    "updates": "updates of the critic so far",
    "episodes": "episodes ended since the row before",
    "return": "mean return of these episodes, sums of rewards [rad/s]",
    "length": "mean length of them [control steps]",
    "rotation": "mean rotation of them [rad]",
    "dropped": "share of them that ended with a drop",
    "diverged": "share of them whose simulation broke down",
    "reward": "mean reward of a step since the row before [rad/s]",
    "controller_share": "share of steps since the row before that controllers did",
    "p_psi": "mean probability of any controller at the choices since the row before",
    "critic_loss": "of the last updates",
    "actor_loss": "of the last updates",
    "bc_loss": "behaviour cloning, before its weight beta",
    "q_mean": "mean value of the policy's actions",
    "beta": "weight of behaviour cloning",
    "seconds": "training so far, interruptions left out [s]",
}
"""What the columns of the CSV file are; numbers that there are none of are empty."""


def columns(controllers: Sequence[str] = ()) -> dict[str, str]:
    """The columns of a run's CSV file: `COLUMNS`, with two more for each controller."""
    more = {}
    for name in controllers:
        more[f"share_{name}"] = f"share of steps since the row before that {name} did"
        more[f"p_{name}"] = f"mean probability of {name} at the choices since the row before"
    *others, last = COLUMNS  # "seconds" stays last: a row without it was cut short
    return {name: COLUMNS[name] for name in others} | more | {last: COLUMNS[last]}


def who_acted(
    acted: np.ndarray, chances: np.ndarray, choices: int, controllers: Sequence[str]
) -> dict[str, float]:
    """Who acted since the row before, by column; see `Guide.take_counts`."""
    steps = max(int(acted.sum()), 1)
    row = {f"share_{name}": float(acted[i] / steps) for i, name in enumerate(controllers, start=1)}
    if choices:
        row["p_psi"] = float(chances[1:].sum() / choices)
        for i, name in enumerate(controllers, start=1):
            row[f"p_{name}"] = float(chances[i] / choices)
    return row


class Tally:
    """What happened since the last row: sums, over steps and over the episodes that ended."""

    _SUMS: tuple[str, ...] = (
        "episodes",
        "return",
        "length",
        "rotation",
        "dropped",
        "diverged",
        "steps",
        "reward",
    )

    def __init__(self) -> None:
        self.sums: dict[str, float] = dict.fromkeys(self._SUMS, 0.0)

    def add(self, reward: np.ndarray, ended: np.ndarray, info: Mapping[str, Any]) -> None:
        """Add a step of all environments; ``ended`` are those whose episode it ended."""
        self.sums["steps"] += len(reward)
        self.sums["reward"] += float(reward.sum())
        if not len(ended):
            return
        self.sums["episodes"] += len(ended)
        for name, key in (
            ("return", "episode_return"),
            ("length", "episode_length"),
            ("rotation", "rotation"),
            ("dropped", "dropped"),
            ("diverged", "diverged"),
        ):
            self.sums[name] += float(np.asarray(info[key])[ended].sum())

    def row(self) -> dict[str, float]:
        """Means, and a new beginning."""
        sums = self.sums
        self.sums = _nothing()
        episodes, steps = sums["episodes"], sums["steps"]
        found: dict[str, float] = {"episodes": int(episodes)}
        if episodes:
            found |= {
                name: sums[name] / episodes
                for name in ("return", "length", "rotation", "dropped", "diverged")
            }
        if steps:
            found["reward"] = sums["reward"] / steps
        return found


def _nothing() -> dict[str, float]:
    names = ("episodes", "return", "length", "rotation", "dropped", "diverged", "steps", "reward")
    return {name: 0.0 for name in names}  # noqa: C420 (of floats, for the type checker)


class RunLog:
    """The CSV file and the TensorBoard log of a run.

    Args:
        folder: of the run.
        resume_at: continue logs that were written up to this step; what they have beyond it, of
            a run that was killed after its last checkpoint, is taken out. None begins anew.
        controllers: those that have columns of their own.
    """

    def __init__(
        self, folder: Path, resume_at: int | None = None, controllers: Sequence[str] = ()
    ) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self.path = folder / CSV_NAME
        names = columns(controllers)
        rows = [] if resume_at is None else self._rows_until(resume_at)
        partial = self.path.with_suffix(".csv.partial")
        with partial.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, names, restval="", lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
        partial.replace(self.path)
        self._file = self.path.open("a", newline="", encoding="utf-8")
        self._csv = csv.DictWriter(self._file, names, restval="", lineterminator="\n")
        self._board = SummaryWriter(
            str(folder / TENSORBOARD_FOLDER),
            purge_step=0 if resume_at is None else resume_at + 1,
        )

    def _rows_until(self, step: int) -> list[dict[str, str]]:
        if not self.path.exists():
            return []
        with self.path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        # a row cut short by the kill has no number in its last column
        return [row for row in rows if row.get("seconds") and int(row["step"]) <= step]

    def write(self, row: Mapping[str, float]) -> None:
        """Add a row; its step is ``row["step"]``."""
        self._csv.writerow(
            {
                name: f"{value:.6g}" if isinstance(value, float) else value
                for name, value in row.items()
            }
        )
        self._file.flush()
        for name, value in row.items():
            if name != "step" and np.isfinite(value):
                group = "train" if name in _TRAIN else "rollout"
                self._board.add_scalar(f"{group}/{name}", value, row["step"])

    def sync(self) -> None:
        """Bring everything to the disk, before a checkpoint says that it is there."""
        self._file.flush()
        os.fsync(self._file.fileno())
        self._board.flush()

    def close(self) -> None:
        """Close both logs."""
        self._file.close()
        self._board.close()


_TRAIN = ("updates", "critic_loss", "actor_loss", "bc_loss", "q_mean", "beta", "seconds")
