"""Checks of the options that several commands have; each names the option."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from dexctl.exceptions import InvalidInput


def check_seconds(seconds: float, control_period: float) -> float:
    """``seconds`` if it is finite and at least one control period."""
    if not (math.isfinite(seconds) and seconds >= control_period):
        raise InvalidInput(
            f"--seconds is {seconds}; expected a finite number of at least {control_period}"
        )
    return seconds


def check_count(option: str, value: int) -> int:
    """``value`` if it is above 0."""
    if value < 1:
        raise InvalidInput(f"{option} is {value}; expected a whole number above 0")
    return value


@contextmanager
def new_folder(path: Path, option: str = "--out") -> Iterator[Path]:
    """`make_folder` for this block, after which nothing empty that was made for it is left.

    Raises:
        InvalidInput: as `make_folder`.
    """
    wanted = path.expanduser()
    missing = [one for one in (wanted, *wanted.parents) if not one.exists()]
    try:
        yield make_folder(wanted, option)
    finally:
        with suppress(OSError):  # what holds something stays, and all above it
            for one in missing:
                one.rmdir()


def make_folder(path: Path, option: str = "--out") -> Path:
    """``path``, made where it is not there.

    Raises:
        InvalidInput: it cannot be made or written to.
    """
    path = path.expanduser()
    try:
        path.mkdir(parents=True, exist_ok=True)
        probe = path / ".dexctl-probe"
        probe.touch()
        probe.unlink()
    except OSError as error:
        reason = error.strerror or str(error)
        raise InvalidInput(f"{option} is {str(path)!r}; cannot write there: {reason}") from None
    return path
