"""The learning curves of a sweep, as PNG and SVG."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dexctl.files import aside
from dexctl.report.style import FAINT, INK, drawing, new_figure, title_of
from learning.sweep.config import SweepConfig
from learning.sweep.curves import Curve, curves
from learning.sweep.table import METHODS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

NAMES = ("curves.png", "curves.svg")
_LINES: dict[str, dict[str, Any]] = {  # Okabe and Ito's hues; they differ in width and dashes too
    "rl": {"color": FAINT, "lw": 1.2},
    "rl+bc": {"color": "#b8860b", "lw": 1.2},
    "fge": {"color": "#009e73", "lw": 1.4},
    "vge": {"color": "#0072b2", "lw": 1.9},
    "vge+bc": {"color": "#d55e00", "lw": 1.9},
}
_ROWS = (("return", "return [rad/s]"), ("rotation", "rotation [rad]"))
_SPARSE = (0, (2, 1.5))  # dashes, where only some of the seeds are


def draw(config: SweepConfig, out: Path, folder: Path | None = None) -> list[Path]:
    """Draw what the runs in ``out`` have logged so far.

    Args:
        config: the sweep.
        out: its folder.
        folder: where the files go; None: the same.

    Returns:
        The files, each whole; none where no run has logged anything.

    Raises:
        MissingExtra: there is no matplotlib.
    """
    found = {column: curves(config, out, column) for column, _ in _ROWS}
    if not any(len(curve.step) for those in found.values() for curve in those):
        return []
    paths = [(folder or out) / name for name in NAMES]
    with drawing():
        figure = _figure(found)
        for path in paths:
            metadata = {"Date": None, "Creator": None} if path.suffix == ".svg" else None
            with aside(path) as part:
                figure.savefig(part, metadata=metadata)
    return paths


def _figure(found: dict[str, list[Curve]]) -> Figure:
    """A column for each group of controllers; what has none stands in all of them."""
    first = found[_ROWS[0][0]]
    groups = list(dict.fromkeys(c.cell.controllers for c in first if c.cell.controllers)) or [()]
    figure = new_figure(max(5.6, 2.5 * len(groups) + 0.6), 5.4)
    grid = figure.subplots(len(_ROWS), len(groups), sharex=True, sharey="row", squeeze=False)
    for axes_row, (column, label) in zip(grid, _ROWS, strict=True):
        for axes, group in zip(axes_row, groups, strict=True):
            for curve in found[column]:
                if curve.cell.controllers in (group, ()):
                    _draw(axes, curve)
        axes_row[0].set_ylabel(label)
    for axes, group in zip(grid[0], groups, strict=True):
        axes.set_title("\n+ ".join(title_of(name) for name in group) or "no controllers")
    for axes in grid[-1]:
        axes.xaxis.set_major_formatter(_steps)
        axes.set_xlim(left=0)
    figure.supxlabel("environment steps", fontsize=9, color=INK)
    _legend(figure, first)
    return figure


def _draw(axes: Axes, curve: Curve) -> None:
    """The mean over seeds and the band of all; dashed where some of them are not there."""
    if not len(curve.step):
        return
    line = _LINES[curve.cell.method]
    full = int((curve.count == curve.count.max()).nonzero()[0][-1]) + 1
    step, mean = curve.step, curve.mean
    axes.fill_between(step, curve.low, curve.high, color=line["color"], alpha=0.15, lw=0)
    axes.plot(step[:full], mean[:full], **line)
    axes.plot(step[full - 1 :], mean[full - 1 :], **line, linestyle=_SPARSE)
    if len(step) == 1:
        axes.plot(step, mean, "o", ms=3, color=line["color"])


def _legend(figure: Figure, found: Sequence[Curve]) -> None:
    from matplotlib.lines import Line2D

    there = [curve for curve in found if len(curve.step)]
    methods = dict.fromkeys(curve.cell.method for curve in there)
    handles = [
        Line2D([], [], **_LINES[one], label=f"{METHODS[one]} ({_seeds(one, there)})")
        for one in methods
    ]
    if any(curve.count.min() < curve.count.max() for curve in there):
        handles.append(Line2D([], [], color=INK, linestyle=_SPARSE, label="some of the seeds"))
    figure.legend(
        handles=handles,
        loc="outside upper left",
        ncols=min(len(handles), 3),
        title="Episodes while training, whoever acts in them:\n"
        "mean over seeds, band from the least to the greatest",
        alignment="left",
    )


def _seeds(method: str, found: Sequence[Curve]) -> str:
    counts = sorted({int(c.count.max()) for c in found if c.cell.method == method})
    planned = sorted({c.planned for c in found if c.cell.method == method})
    shown = " to ".join(str(one) for one in dict.fromkeys((counts[0], counts[-1])))
    if counts == planned:
        return f"{shown} seed{'' if counts == [1] else 's'}"
    return f"{shown} of {planned[-1]} seeds"


def _steps(value: float, _: object = None) -> str:
    """1.5 M, 200 k."""
    for size, unit in ((1e6, " M"), (1e3, " k")):
        if abs(value) >= size:
            return f"{np.round(value / size, 2):g}{unit}"
    return f"{value:g}"
