"""Draws docs/images/learning-curves.png from the logs of the shipped policies' trainings."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from dexctl.files import aside
from dexctl.report.style import FAINT, INK, drawing, new_figure
from learning.training.run_folder import RunFolder

ROOT = Path(__file__).resolve().parents[1]
RUNS = {
    "cylinder": ("on the cylinder", "#0072b2"),
    "easy": ("on five objects at once", "#d55e00"),
}
ROWS = (
    ("return", "return of an episode\n[rad/s], at most 500"),
    ("rotation", "rotation in an episode\n[rad]"),
    ("dropped", "share of episodes\nthat end in a drop"),
)


@dataclass(frozen=True, kw_only=True)
class Options:
    """What to draw, and where to."""

    runs: Path = ROOT / "benchmarks" / "results" / "learned"
    """Folder of the runs' configurations and logs."""
    out: Path = ROOT / "docs" / "images" / "learning-curves.png"
    """The picture."""


def read(folder: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """A run's configuration, and its log by column; NaN where a row has no number."""
    run = RunFolder(folder)
    rows = run.progress()
    names = ("step", *(name for name, _ in ROWS))
    return run.config_values(), {name: np.array([row[name] for row in rows]) for name in names}


def main() -> None:
    given = tyro.cli(Options, description=__doc__)
    with drawing():
        figure = new_figure(7.0, 6.0)
        grid = figure.subplots(len(ROWS), 1, sharex=True)
        for name, (label, colour) in RUNS.items():
            config, log = read(given.runs / name)
            there = np.isfinite(log["return"])
            for axes, (column, _) in zip(grid, ROWS, strict=True):
                axes.plot(log["step"][there] / 1e6, log[column][there], color=colour, label=label)
                stop = config["guidance"]["hard_stop"] / 1e6
                axes.axvline(stop, color=colour, lw=0.9, linestyle=(0, (4, 3)))
        for axes, (_, label) in zip(grid, ROWS, strict=True):
            axes.set_ylabel(label)
            axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
        grid[-1].set_xlabel("environment steps [million]; dashed: the guide is asked no more")
        grid[-1].set_xlim(left=0)
        grid[0].legend(loc="lower right", labelcolor=INK)
        grid[0].set_title("Episodes of 50 s while training, whoever acts in them")
        grid[1].axhline(2 * np.pi, color=FAINT, lw=0.9)
        grid[1].text(2.5, 2 * np.pi + 1.0, "a full turn", color=FAINT, fontsize=8, ha="right")
        with aside(given.out) as part:
            figure.savefig(part)
    print(given.out)


if __name__ == "__main__":
    main()
