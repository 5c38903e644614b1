"""How plots look: one colour per finger and per controller, everywhere, readable in print.

The hues are of Okabe and Ito's palette, which people with colour-vision deficiencies can tell
apart; controllers differ by line style as well.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any
from zlib import crc32

from dexctl import controllers
from dexctl.exceptions import MissingExtra, UnknownName

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, FAINT, GRID = "#1f2933", "#7b8794", "#d9dee3"
_LEGEND_LETTERS = 80  # of the labels that fit into one row
_FINGERS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#b8860b", "#56b4e9", "#5b3fa0", "#8c8c8c")
_CONTROLLERS = {
    "igm": ("#009e73", "-"),
    "switch": ("#b8860b", "-."),
    "gait": ("#cc4b7a", (0, (5, 2))),
    "coordinated": ("#0072b2", "-"),
    "goal": ("#56b4e9", (0, (5, 2))),
    "learned": ("#5b3fa0", "-"),
    "hold": ("#7b8794", ":"),
}
_OTHERS = ((0, (7, 1.5)), (0, (3, 1, 1, 1)), (0, (2, 1)))
_SETTINGS = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],  # comes with matplotlib: the same on every machine
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 9.0,
    "axes.labelcolor": INK,
    "axes.edgecolor": FAINT,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "xtick.color": INK,
    "ytick.color": INK,
    "text.color": INK,
    "lines.linewidth": 1.4,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "figure.facecolor": "white",
    "figure.constrained_layout.use": True,
    "svg.hashsalt": "dexctl",  # the same drawing gives the same file
    "savefig.dpi": 150,
}


def finger_colour(i: int) -> str:
    """Colour of finger i, counted from 0; they repeat after eight."""
    return _FINGERS[i % len(_FINGERS)]


def controller_line(name: str) -> dict[str, Any]:
    """``color`` and ``linestyle`` of a controller's lines, the same in every figure.

    Names without a line of their own have one by their letters, so that two can be told apart.
    """
    if name in _CONTROLLERS:
        colour, style = _CONTROLLERS[name]
    else:
        row, column = divmod(crc32(name.encode()) % (len(_OTHERS) * len(_FINGERS)), len(_FINGERS))
        colour, style = _FINGERS[column], _OTHERS[row]
    return {"color": colour, "linestyle": style}


def title_of(name: str) -> str:
    """What people read for a controller's name; of files in it the last part."""
    try:
        title = controllers.entry(name).title
    except UnknownName:
        return name
    after = [Path(one).name for one in name.partition(":")[2].split(",")]
    return f"{title} ({', '.join(after)})" if any(after) else title


@contextmanager
def drawing() -> Iterator[None]:
    """Plots drawn in this block look like ours; the user's matplotlib settings stay untouched.

    Raises:
        MissingExtra: there is no matplotlib.
    """
    with _matplotlib().rc_context(_SETTINGS):
        yield


def new_figure(width: float, height: float) -> Figure:
    """An empty figure [inch] that no window and no global state knows."""
    _matplotlib()
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height))


def legend_columns(labels: Sequence[str]) -> int:
    """Columns of a legend as wide as a figure: one row, two where it is long, more where one is."""
    fits = sum(map(len, labels)) <= _LEGEND_LETTERS
    columns = len(labels) if fits else (len(labels) + 1) // 2
    longest = max(map(len, labels), default=1)
    return max(1, min(columns, _LEGEND_LETTERS // max(longest, 1)))


def legend_above(axes: Axes) -> None:
    """The legend above the axes, where it covers nothing: one row, or two where it is long."""
    handles, labels = axes.get_legend_handles_labels()
    axes.legend(
        handles,
        labels,
        loc="lower left",
        bbox_to_anchor=(0, 1.0),
        ncols=legend_columns(labels),
        borderaxespad=0.2,
        handlelength=2.4,
        columnspacing=1.4,
    )


def _matplotlib() -> Any:
    try:
        import matplotlib
    except ImportError:
        raise MissingExtra("plotting", "viz") from None
    return matplotlib
