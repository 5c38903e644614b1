"""What commands print: results on stdout, everything else on stderr.

Text is printed as it is: names, paths and messages of others may hold square brackets, which rich
would take for markup, leave out or raise an error about. What stands out has a style instead.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Mapping
from types import TracebackType
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from dexctl.exceptions import DexctlError


def notes() -> Console:
    """Where progress and remarks go: stderr, so that stdout can be piped."""
    return Console(stderr=True, highlight=False, markup=False, emoji=False, soft_wrap=True)


def results() -> Console:
    """Where tables go."""
    return Console(highlight=False, markup=False, emoji=False)


def print_json(result: Mapping[str, Any]) -> None:
    """Exactly one JSON object on stdout."""
    print(to_json(result))


def to_json(result: Mapping[str, Any]) -> str:
    """As JSON text; arrays become lists, and what is not finite becomes null."""
    return json.dumps(_plain(result), indent=2, allow_nan=False)


def table(*headings: str, right: Collection[str] = (), gap: int = 3, wrap: bool = True) -> Table:
    """A table without lines; without headings it has no line of them.

    Args:
        headings: plain text, a column each.
        right: those whose columns are flush right.
        gap: between columns [letters].
        wrap: whether cells may become several lines where the terminal is narrow.
    """
    made = Table(box=None, show_header=bool(headings), pad_edge=False, padding=(0, gap, 0, 0))
    for heading in headings:
        justify = "right" if heading in right else "left"
        made.add_column(heading, justify=justify, no_wrap=not wrap)
    return made


def facts(rows: Iterable[tuple[str, str]]) -> Table:
    """A table of what, and its value."""
    made = table()
    for row in rows:
        made.add_row(*row)
    return made


class Bar(Progress):
    """A progress bar that is gone after a DexctlError: what went wrong stands alone."""

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if kind is not None and issubclass(kind, DexctlError):
            self.live.transient = True
            self.live.stop()  # without the empty line that a pipe gets after a bar
        else:
            super().__exit__(kind, error, traceback)


def progress(console: Console) -> Progress:
    """A progress bar with what it is about, the part done and the time left."""
    return Bar(
        TextColumn("{task.description:<34}", markup=False),
        BarColumn(bar_width=28),
        TextColumn("{task.percentage:>4.0f} %"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=console,
    )


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
