"""What commands print: results on stdout, everything else on stderr."""

from __future__ import annotations

import json
from collections.abc import Container, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table


def notes() -> Console:
    """Where progress and remarks go: stderr, so that stdout can be piped."""
    return Console(stderr=True, highlight=False, soft_wrap=True)


def results() -> Console:
    """Where tables go."""
    return Console(highlight=False)


def facts(rows: Iterable[tuple[str, str]]) -> Table:
    """A table of what, and its value."""
    table = Table(box=None, show_header=False, pad_edge=False, padding=(0, 3, 0, 0))
    for row in rows:
        table.add_row(*map(escape, row))
    return table


def columns(headings: Sequence[str], *, left: Container[str] = ()) -> Table:
    """A table without rows yet; numbers, flush right, but for the columns named in ``left``."""
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for heading in headings:
        table.add_column(escape(heading), justify="left" if heading in left else "right")
    return table


def print_json(result: Mapping[str, Any]) -> None:
    """Exactly one JSON object on stdout."""
    print(to_json(result))


def to_json(result: Mapping[str, Any]) -> str:
    """As JSON text; arrays become lists, and what is not finite becomes null."""
    return json.dumps(_plain(result), indent=2, allow_nan=False)


def progress(console: Console) -> Progress:
    """A progress bar with what it is about, the part done and the time left."""
    return Progress(
        TextColumn("{task.description:<34}"),
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
