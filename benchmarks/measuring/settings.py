"""What every script takes from the command line, and lines for whoever waits."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TypeVar

import tyro

from dexctl.exceptions import DexctlError
from dexctl.validation import check_name

RESULTS = Path(__file__).resolve().parent.parent / "results"


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What a script takes from the command line; the defaults are the full measurement."""

    seed: int = 0
    """First seed; trial i has the seed seed + i."""
    out: Path = RESULTS
    """Folder for the result."""
    resume: bool = False
    """Keep the rows of an interrupted run with the same settings, where a script has rows."""


S = TypeVar("S", bound=Settings)


def settings(kind: type[S], description: str | None) -> S:
    """The command line's settings; what is wrong with them is said in one line from here on."""
    sys.excepthook = _say
    return tyro.cli(kind, description=description)


def _say(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    if isinstance(error, DexctlError):
        progress(str(error))
    elif isinstance(error, KeyboardInterrupt):
        progress("interrupted; where a script has rows, the same command with --resume goes on")
    else:
        sys.__excepthook__(kind, error, trace)


def check_chosen(what: str, chosen: Iterable[str], known: Iterable[str]) -> None:
    """Raise UnknownName where one of ``chosen`` is none of ``known``."""
    known = list(known)
    for name in chosen:
        check_name(what, name, known)


def progress(text: str) -> None:
    """A line for whoever waits."""
    print(text, file=sys.stderr, flush=True)
