"""Learning curves: the logs of a sweep's runs, brought to common steps over the seeds of a cell."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dexctl.exceptions import InvalidInput
from dexctl.state import Floats
from learning.sweep.config import Cell, SweepConfig
from learning.sweep.jobs import run_folder
from learning.training.run_folder import RunFolder


class Log(NamedTuple):
    """A column of a run's progress.csv, where it has numbers.

    Attributes:
        step: environment steps so far, ``(r,)``.
        value: ``(r,)``.
    """

    step: Floats
    value: Floats


class Curve(NamedTuple):
    """A cell's seeds at common steps.

    Attributes:
        cell: which.
        step: environment steps, ``(r,)``.
        mean, low, high: mean, least and greatest over the seeds that are there, ``(r,)``.
        count: how many those are, ``(r,)``.
        planned: seeds in the sweep.
    """

    cell: Cell
    step: Floats
    mean: Floats
    low: Floats
    high: Floats
    count: np.ndarray
    planned: int


def read_log(folder: Path, column: str) -> Log:
    """A column of the log of the run in ``folder``; empty where there is none yet."""
    rows = read_rows(folder)
    array = np.array([(row["step"], row.get(column, np.nan)) for row in rows]).reshape(-1, 2)
    array = array[~np.isnan(array[:, 1])]
    return Log(array[:, 0], array[:, 1])


def read_rows(folder: Path) -> list[dict[str, float]]:
    """The rows of the log; none where it is damaged, which stops the run and not the others."""
    try:
        return RunFolder(folder).progress()
    except InvalidInput:
        return []


def over_seeds(cell: Cell, logs: Sequence[Log], planned: int) -> Curve:
    """Mean, least and greatest of logs at every step that one of them has a row at.

    A log counts between its first and its last row, with straight lines between its rows; beyond,
    the figures are of those that are left, and ``count`` says so.
    """
    logs = [log for log in logs if len(log.step)]
    step = np.unique(np.concatenate([np.zeros(0), *(log.step for log in logs)]))
    values = np.full((len(logs), len(step)), np.nan)
    for row, log in zip(values, logs, strict=True):
        inside = (log.step[0] <= step) & (step <= log.step[-1])
        row[inside] = np.interp(step[inside], log.step, log.value)
    count = np.isfinite(values).sum(axis=0)
    if not len(step):
        return Curve(cell, step, step, step, step, count, planned)
    return Curve(
        cell,
        step,
        np.nanmean(values, axis=0),
        np.nanmin(values, axis=0),
        np.nanmax(values, axis=0),
        count,
        planned,
    )


def curves(config: SweepConfig, out: Path, column: str) -> list[Curve]:
    """One for each cell; those without a row yet have no steps."""
    found = []
    for cell in config.cells:
        own = [run for run in config.runs if run.cell == cell]
        logs = [read_log(run_folder(out, run), column) for run in own]
        found.append(over_seeds(cell, logs, len(own)))
    return found
