"""The log of a run: one CSV file, and TensorBoard beside it."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from dexctl.exceptions import InvalidInput
from dexctl.files import aside

COLUMNS = {
    "step": "environment steps so far",
    "updates": "updates of the critic so far",
    "episodes": "episodes ended since the row before",
    "return": "mean return of these episodes, sums of rewards [rad/s]",
    "length": "mean length of them [control steps]",
    "rotation": "mean rotation of them [rad]",
    "goals": "mean number of goals reached in them, where the task has goals",
    "dropped": "share of them that ended with a drop",
    "diverged": "share of them whose simulation broke down",
    "reward": "mean reward of a step since the row before [rad/s]",
    "controller_share": "share of steps since the row before that controllers did",
    "p_psi": "mean probability of any controller at the choices since the row before",
    "held": "share of the policy's own episodes that would hold, by its drops a step",
    "level": "how much of the scene's ranges new episodes are drawn from",
    "critic_loss": "of the last updates",
    "actor_loss": "of the last updates",
    "bc_loss": "behaviour cloning, before its weight beta",
    "q_mean": "mean value of the policy's actions",
    "beta": "weight of behaviour cloning",
    "cpu_seconds": "processor time of the process in it, all threads [s]",
    "seconds": "training so far, interruptions left out [s]",
}
"""What the columns of the CSV file are; a cell is empty where there is no number."""


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
        if "goals" in info:
            self.sums["goals"] = self.sums.get("goals", 0.0) + float(info["goals"][ended].sum())
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
        self.sums = dict.fromkeys(self._SUMS, 0.0)
        episodes, steps = sums["episodes"], sums["steps"]
        found: dict[str, float] = {"episodes": int(episodes)}
        if episodes:
            found |= {
                name: sums[name] / episodes
                for name in ("return", "length", "rotation", "goals", "dropped", "diverged")
                if name in sums
            }
        if steps:
            found["reward"] = sums["reward"] / steps
        return found


def read_rows(path: Path) -> list[dict[str, str]]:
    """The rows of a run's CSV file, as texts: of a number, or empty; none where there is no file.

    A row that is being written, or that a kill cut short, is left out.

    Raises:
        InvalidInput: the file is no such log.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return []
    except OSError as error:
        raise InvalidInput(f"cannot read {path}: {error.strerror or error}") from None
    except UnicodeDecodeError as error:
        raise InvalidInput(
            f"{path} is not a training log: byte {error.start} is not UTF-8"
        ) from None
    reader = csv.DictReader(io.StringIO(text[: text.rfind("\n") + 1]))  # up to the last whole line
    try:
        rows = [row for row in reader if row.get("seconds")]
        if reader.fieldnames is not None and "step" not in reader.fieldnames:
            raise ValueError("it has no column step")
        for row in rows:
            float(row["step"])
            if None in row:
                raise ValueError(f"the row of step {row['step']} has more columns than the first")
            for value in filter(None, row.values()):
                float(value)
    except (ValueError, csv.Error) as error:
        raise InvalidInput(f"{path} is not a training log: {error}") from None
    return rows


class RunLog:
    """The CSV file and the TensorBoard log of a run.

    Args:
        path: of the CSV file.
        board: the folder of TensorBoard's.
        resume_at: continue logs that were written up to this step; what they have beyond it, of
            a run that was killed after its last checkpoint, is taken out. None begins anew.
        controllers: those that have columns of their own.

    Raises:
        InvalidInput: the log to be continued is none.
    """

    def __init__(
        self,
        path: Path,
        board: Path,
        resume_at: int | None = None,
        controllers: Sequence[str] = (),
    ) -> None:
        self.path = path
        names = columns(controllers)
        rows = [] if resume_at is None else read_rows(self.path)
        with (
            aside(self.path) as part,
            part.open("w", newline="", encoding="utf-8") as file,
        ):
            writer = _writer(file, names)
            writer.writeheader()
            writer.writerows(row for row in rows if float(row["step"]) <= (resume_at or 0))
        from torch.utils.tensorboard import SummaryWriter

        self._file = self.path.open("a", newline="", encoding="utf-8")
        self._csv = _writer(self._file, names)
        self._board = SummaryWriter(
            str(board),
            purge_step=0 if resume_at is None else resume_at + 1,
        )

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


def _writer(file: TextIO, names: Collection[str]) -> csv.DictWriter[str]:
    """Of rows that may lack columns, or have some that the log does not."""
    return csv.DictWriter(file, names, restval="", extrasaction="ignore", lineterminator="\n")
