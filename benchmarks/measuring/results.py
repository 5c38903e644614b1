"""Results: JSON written whole, and rows that another run has left.

A result holds `figures`, each a line of README's table with its goal beside it, and the numbers
they were made from.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from dexctl.exceptions import InvalidInput
from dexctl.files import write_text
from dexctl.report.machine import machine
from measuring.settings import Settings

FIXED = ("seed", "trials", "seconds")  # settings that rows of one result have in common
# settings that a result does not tell: where things are
_UNSAID = ("out", "resume", "picture", "peer", "runs")
_ROWS = ("trials", "runs")  # what of a result are rows
WITH = "measured_with"
"""What a row calls the settings of the run that measured it; in a file, their place in the list
of that name. None: in a result from before rows had it, nobody knows."""


@dataclass(frozen=True)
class Figure:
    """One measured figure.

    Attributes:
        what: what was measured.
        measured: the number, with unit, for people.
        goal: what was asked for; empty where nothing was.
        met: whether the goal is reached; None where there is none.
    """

    what: str
    measured: str
    goal: str = ""
    met: bool | None = None


def write(
    name: str,
    given: Settings,
    figures: Sequence[Figure],
    tables: Sequence[dict[str, Any]] = (),
    *,
    say: bool = True,
    **numbers: Any,
) -> Path:
    """Write ``name.json`` with settings and machine, aside first and then renamed.

    ``settings`` are those of the last run. Rows that it has taken over from others (`earlier`)
    keep theirs: ``measured_with`` has the settings that rows were measured with, each once, and
    every row its place there.

    Args:
        name: of the script.
        given: its settings.
        figures: lines of README's table.
        tables: further tables for README, each with title, header and rows.
        say: whether to print what is written.
        **numbers: what the figures were made from.
    """
    given.out.mkdir(parents=True, exist_ok=True)
    path = given.out / f"{name}.json"
    chosen = {key: value for key, value in asdict(given).items() if key not in _UNSAID}
    known = _number_rows(numbers, json.loads(json.dumps(chosen, default=str)))
    where = machine()
    where["versions"]["numba"] = version("numba") if find_spec("numba") else "not installed"
    where["load"] = round(os.getloadavg()[0], 2)
    result = {
        "benchmark": name,
        "figures": [asdict(figure) for figure in figures],
        "tables": list(tables),
        **numbers,
        **({WITH: known} if known else {}),
        "settings": chosen,
        "machine": where,
    }
    write_text(path, json.dumps(result, indent=1, default=str) + "\n")
    if not say:
        return path
    for figure in figures:
        mark = {True: "reached", False: "NOT reached", None: ""}[figure.met]
        goal = f"  (goal: {figure.goal}) {mark}" if figure.goal else ""
        print(f"{figure.what}: {figure.measured}{goal}")
    for table in tables:
        print(table["title"], *(" | ".join(row) for row in table["rows"]), sep="\n")
    print(f"written: {path}")
    return path


def _number_rows(numbers: dict[str, Any], now: dict[str, Any]) -> list[dict[str, Any]]:
    """The settings that rows were measured with, each once; rows get their place in the list."""
    known: list[dict[str, Any]] = []
    for name in _ROWS:
        if name not in numbers:
            continue
        numbered = []
        for row in numbers[name]:
            own = row.get(WITH, now)
            if own is not None and own not in known:
                known.append(own)
            numbered.append({**row, WITH: None if own is None else known.index(own)})
        numbers[name] = numbered
    return known


def read(path: Path) -> dict[str, Any]:
    """A result whose rows have the settings that they were measured with, or None.

    Raises:
        InvalidInput: it is damaged.
    """
    try:
        found = json.loads(path.read_text())
        known = found.get(WITH, [])
        for row in (row for name in _ROWS for row in found.get(name, [])):
            number = row.get(WITH)
            row[WITH] = None if number is None else known[number]
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise InvalidInput(f"{path} is no result to go on with: {error}") from error
    return found


def earlier(name: str, given: Settings, fixed: Sequence[str] = FIXED) -> list[dict[str, Any]]:
    """Rows that an interrupted run has left, none without ``--resume``.

    Each has the settings that it was measured with (``measured_with``), as `write` wants them.

    Raises:
        InvalidInput: the result is damaged, or was measured with other ``fixed`` settings: going
            on with none of its rows would write over them.
    """
    path = given.out / f"{name}.json"
    if not (given.resume and path.is_file()):
        return []
    found = read(path)
    try:
        rows, had = found["trials"], {key: found["settings"][key] for key in fixed}
    except (LookupError, TypeError) as error:
        raise InvalidInput(f"{path} is no result to go on with: {error}") from error
    other = [key for key in fixed if had[key] != getattr(given, key)]
    if other:
        wanted = " ".join(f"--{key.replace('_', '-')} {had[key]}" for key in other)
        raise InvalidInput(
            f"{path} cannot be gone on with, it was measured with {wanted}; expected these, or no "
            "--resume, which writes over it"
        )
    return rows
