"""What `dexctl sweep` shows while it runs: one line for each run at work, and counts."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from rich.console import Group
from rich.live import Live
from rich.text import Text

from dexctl.cli.output import notes, table
from learning.sweep.curves import read_rows
from learning.sweep.jobs import Job, Outcome

_COLUMNS = ("run", "", "steps", "return", "turned, rad", "dropped", "left")
_FIGURES = ("return", "rotation", "dropped")
_RECENT = 6  # rows that the speed is taken from


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
    rows = read_rows(folder)
    if not rows:
        return Progress(0, total, {}, None)
    last = rows[-1]
    figures = {name: last[name] for name in _FIGURES if not math.isnan(last.get(name, math.nan))}
    points = [(0.0, 0.0), *((row["step"], row["seconds"]) for row in rows)]
    (step, seconds), (before, then) = points[-1], points[max(len(points) - 1 - _RECENT, 0)]
    speed = (step - before) / (seconds - then) if seconds > then else 0.0
    left = max(total - step, 0.0) / speed if speed > 0 else None
    return Progress(int(step), total, figures, left)


class Display:
    """The lines, on stderr; where that is no terminal, a remark for each job that ends.

    Args:
        total: how many jobs there are.
    """

    def __init__(self, total: int) -> None:
        self._total = total
        self._console = notes()
        self._live = Live(console=self._console, auto_refresh=False, transient=True)
        self._known: dict[str, Outcome] | None = None

    def __enter__(self) -> Self:
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def show(self, running: list[Job], ended: Mapping[str, Outcome]) -> None:
        """Called whenever something may have changed."""
        before = self._known
        self._known = dict(ended)
        if before is None:
            done = sum(found.state == "finished" for found in ended.values())
            self._say(f"{done} of {self._total} done before") if done else None
            before = {name: one for name, one in ended.items() if one.state == "finished"}
        for name, found in ended.items():
            if name not in before:
                what = f"failed: {found.error}" if found.state == "failed" else found.state
                self._say(f"{name} {what}")
        if self._console.is_terminal:
            self._live.update(self._lines(running, ended), refresh=True)

    def _say(self, text: str) -> None:
        self._console.print(f"dexctl: {text}")

    def _lines(self, running: list[Job], ended: Mapping[str, Outcome]) -> Group:
        lines = table(*_COLUMNS, right=_COLUMNS[2:], gap=2)
        for job in running:
            lines.add_row(*line(job.name, progress(job)))
        finished = sum(found.state == "finished" for found in ended.values())
        counts = f"{finished} of {self._total} finished, {len(running)} at work"
        failed = len(ended) - finished
        return Group(lines, Text(counts + (f", {failed} failed" if failed else "")))


def line(name: str, now: Progress) -> tuple[str, ...]:
    """A job as a row under the headings; what is not known is a dash."""

    def known(key: str, form: str, factor: float = 1.0, unit: str = "") -> str:
        return f"{factor * now.figures[key]:{form}}{unit}" if key in now.figures else "-"

    return (
        name,
        now.doing,
        f"{now.step:,} / {now.total:,}" if now.total else "-",
        known("return", ".1f"),
        known("rotation", ".2f"),
        known("dropped", ".0f", 100.0, " %"),
        _clock(now.seconds_left) if now.doing == "training" else "-",
    )


def _clock(seconds: float | None) -> str:
    if seconds is None:
        return "-"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}"
