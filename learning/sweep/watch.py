"""How far a run is, from the log that it writes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from learning.sweep.jobs import Job
from learning.training.run_folder import RunFolder

RECENT = 6  # rows that the speed is taken from


@dataclass(frozen=True)
class Progress:
    """Of one job.

    Attributes:
        step: environment steps so far.
        total: that it was planned for; 0 for a job that only evaluates.
        figures: the last row's "return" [rad/s], "rotation" [rad] and "dropped", as far as known.
        seconds_left: of training; None where nobody knows yet.
    """

    step: int
    total: int
    figures: Mapping[str, float]
    seconds_left: float | None

    @property
    def doing(self) -> str:
        """What, in a word."""
        if self.total and self.step < self.total:
            return "training" if self.step else "starting"
        return "evaluating"


def progress(job: Job) -> Progress:
    """Where a job is."""
    if job.config is None:
        return Progress(0, 0, {}, None)
    return of_rows(job.folder, int(job.config["steps"]))


def of_rows(folder: Path, total: int) -> Progress:
    """Where the run in ``folder`` is, of ``total`` steps."""
    rows = RunFolder(folder).progress()
    if not rows:
        return Progress(0, total, {}, None)
    last = rows[-1]
    figures = {
        name: last[name]
        for name in ("return", "rotation", "dropped")
        if not math.isnan(last.get(name, math.nan))
    }
    points = [(0.0, 0.0), *((row["step"], row["seconds"]) for row in rows)]
    (step, seconds), (before, then) = points[-1], points[max(len(points) - 1 - RECENT, 0)]
    speed = (step - before) / (seconds - then) if seconds > then else 0.0
    left = max(total - step, 0.0) / speed if speed > 0 else None
    return Progress(int(step), total, figures, left)
