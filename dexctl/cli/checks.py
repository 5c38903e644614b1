"""Checks of the options that several commands have; each names the option."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from dexctl.exceptions import InvalidInput
from dexctl.validation import DAY


def check_seconds(seconds: float, control_period: float) -> float:
    """``seconds`` if it is at least one control period, and a day at most."""
    if not control_period <= seconds <= DAY:
        raise InvalidInput(
            f"--seconds is {seconds}; expected a finite number of at least {control_period}, a day "
            "at most"
        )
    return seconds


def check_count(option: str, value: int) -> int:
    """``value`` if it is above 0."""
    if value < 1:
        raise InvalidInput(f"{option} is {value}; expected a whole number above 0")
    return value


_made: list[Path] = []
"""Folders that `make_folder` has made, those within others last."""


@contextmanager
def no_empty_folders() -> Iterator[None]:
    """A block, such as a command, that leaves nothing empty that `make_folder` made in it."""
    before = len(_made)
    try:
        yield
    finally:
        while len(_made) > before:
            with suppress(OSError):  # what holds something stays, and all above it
                _made.pop().rmdir()


def make_folder(path: Path, option: str = "--out") -> Path:
    """``path``, made where it is not there.

    Raises:
        InvalidInput: it cannot be made or written to.
    """
    path = path.expanduser()
    missing = [one for one in (path, *path.parents) if not one.exists()]
    _made.extend(reversed(missing))
    try:
        path.mkdir(parents=True, exist_ok=True)
        probe = path / ".dexctl-probe"
        probe.touch()
        probe.unlink()
    except OSError as error:
        reason = error.strerror or str(error)
        raise InvalidInput(f"{option} is {str(path)!r}; cannot write there: {reason}") from None
    return path
