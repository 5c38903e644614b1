"""From arguments to a command, and the checks that options of several commands share."""

from __future__ import annotations

import io
import math
import sys
from collections.abc import Sequence
from contextlib import redirect_stderr
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro

from dexctl.exceptions import InvalidInput

C = TypeVar("C")
_BORDER = "╭╮╰╯│─ "

Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff]
"""A switch: there is no --no-... of it."""


def parse(kind: type[C], title: str, arguments: Sequence[str]) -> C | None:
    """The command that ``arguments`` describe; None where they only asked for help.

    Raises:
        InvalidInput: they are not right; one line, where tyro draws a box.
    """
    box = io.StringIO()
    defaults = getattr(kind, "defaults", None)
    default: Any = tyro.MISSING if defaults is None else defaults(arguments)
    try:
        with redirect_stderr(box):
            return tyro.cli(
                kind,
                prog=title,
                args=list(arguments),
                default=default,
                config=(tyro.conf.FlagCreatePairsOff,),
            )
    except SystemExit as stop:
        if not stop.code:
            return None
        raise InvalidInput(f"{_one_line(box.getvalue())} (see {title} --help)") from None
    finally:
        if sys.exc_info()[0] is None:
            sys.stderr.write(box.getvalue())  # a warning, if anything


def given(arguments: Sequence[str], option: str) -> str | None:
    """The value of ``option`` in ``arguments``, or None where it is not there."""
    for i, word in enumerate(arguments):
        name, equals, value = word.partition("=")
        if name.replace("_", "-") == option:
            return value if equals else next(iter(arguments[i + 1 :]), "")
    return None


def _one_line(box: str) -> str:
    """What stands in tyro's box above its first rule."""
    said = []
    for line in box.splitlines():
        inside = line.strip(_BORDER)
        if line.startswith(("╭", "╰")) or not inside:
            if said:
                break
            continue
        said.append(inside)
    return " ".join(said) or "bad arguments"


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


def parse_gravity(text: str) -> str | tuple[float, ...]:
    """Numbers [m/s^2] of "x,y,z"; "up" and "down" stay, the simulator knows them."""
    return parse_vector("--gravity", text, "up, down, or three numbers x,y,z in m/s^2")


def parse_vector(
    option: str, text: str, expected: str = "x, y, z, or three numbers x,y,z"
) -> str | tuple[float, ...]:
    """Three finite numbers of "x,y,z"; one word stays as it is."""
    parts = text.split(",")
    if len(parts) == 1:
        return text
    try:
        vector = tuple(float(part) for part in parts)
    except ValueError:
        vector = ()
    if len(vector) != 3 or not all(math.isfinite(number) for number in vector):
        raise InvalidInput(f"{option} is {text!r}; expected {expected}")
    return vector


def make_folder(path: Path) -> Path:
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
        raise InvalidInput(f"--out is {str(path)!r}; cannot write there: {reason}") from None
    return path
