"""What decides a controller's actions, as one digest: by it, kept evaluations are found again."""

from __future__ import annotations

import hashlib
import inspect
import sys
from collections.abc import Mapping, Sequence, Set
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dexctl.controller import Controller
from dexctl.exceptions import InvalidInput
from dexctl.hand import HandModel

_OWN = ("dexctl", "learning", "hardware")  # packages whose code the version of dexctl stands for


def fingerprint(controller: Controller) -> str | None:
    """A digest of what decides a controller's actions; None where nobody can tell.

    That is its class and everything that it was made with: settings, weights, other controllers
    with all of theirs, and what is in files. A class that is not dexctl's counts by the file it
    stands in, too. What was changed in a controller after it had been made does not count.
    """
    try:
        return _of(controller)
    except _Unknown:
        return None


def of_file(file: Path) -> str:
    """A digest of what is in a file.

    Raises:
        InvalidInput: it cannot be read.
    """
    try:
        return hashlib.sha256(file.read_bytes()).hexdigest()
    except OSError as error:
        raise InvalidInput(f"cannot read {file}: {error.strerror or error}") from None


class _Unknown(Exception):
    """Something of which nobody can tell whether it is the same."""


def _of(value: Any) -> str:
    """A digest of a value and of all that is in it, or _Unknown."""
    if value is None or isinstance(value, (bool, int, float, complex, bytes, np.generic)):
        return _joined(type(value).__name__, repr(value))
    if isinstance(value, (str, Path)):
        return _joined("text", str(value), *([of_file(Path(value))] if _is_file(value) else []))
    if isinstance(value, HandModel):
        return _joined("hand", value.digest)
    if isinstance(value, np.ndarray) and value.dtype != object:
        inside = hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()
        return _joined("array", str(value.dtype), str(value.shape), inside)
    if isinstance(value, Controller):
        return _joined(_kind(value), *map(_of, value.made_with))
    if is_dataclass(value) and not isinstance(value, type):
        return _joined(_kind(value), *(_of(getattr(value, one.name)) for one in fields(value)))
    if isinstance(value, Mapping):
        pairs = sorted((_of(key), _of(inside)) for key, inside in value.items())
        return _joined("mapping", *(one for pair in pairs for one in pair))
    if isinstance(value, Set):
        return _joined("set", *sorted(map(_of, value)))
    if isinstance(value, Sequence):
        return _joined("sequence", *map(_of, value))
    raise _Unknown


def _kind(value: Any) -> str:
    """A class by its name and, where it is not dexctl's own, by the file that it stands in."""
    kind = type(value)
    name = f"{kind.__module__}.{kind.__qualname__}"
    if kind.__module__.partition(".")[0] in _OWN:
        return name
    try:
        file = inspect.getsourcefile(sys.modules[kind.__module__])
    except (KeyError, TypeError):  # typed in, or compiled
        file = None
    if file is None or not _is_file(file):
        raise _Unknown
    return _joined(name, of_file(Path(file)))


def _is_file(path: str | Path) -> bool:
    try:
        return Path(path).is_file()
    except (OSError, ValueError):  # too long for a name, or with a null in it
        return False


def _joined(*parts: str) -> str:
    return hashlib.sha256(repr(parts).encode()).hexdigest()
