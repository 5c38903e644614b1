"""The files in a configuration, as absolute paths."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import is_dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast, get_args, get_origin, get_type_hints

from dexctl.files import is_path
from dexctl.settings.marks import FILE_OR_NAME, Located
from dexctl.settings.plain import changed
from dexctl.settings.tree import get, hints, paths

C = TypeVar("C")


def absolute(config: C, folder: Path) -> C:
    """``config`` with its files as absolute paths, which ``folder`` is where they are meant from.

    So what is written down holds wherever it is read. A path that may be a name too is one where
    nothing is at that place and it has no suffix or slash.
    """
    found: dict[str, Any] = {}
    marked = _marked(type(config))
    for path in paths(type(config)):
        value, marks = get(config, path), marked.get(path, ())
        located = [mark for mark in marks if isinstance(mark, Located)]
        if located:
            found[path] = located[0].absolute(value, folder)
        elif isinstance(value, Path):
            place = (folder / value.expanduser()).resolve()
            named = FILE_OR_NAME in marks and not is_path(str(value))
            if place.exists() or not named:
                found[path] = place
        elif isinstance(value, str) and is_path(value) and FILE_OR_NAME in marks:
            found[path] = str((folder / Path(value).expanduser()).resolve())
    return changed(config, found)


@cache
def _marked(kind: type) -> Mapping[str, tuple[Any, ...]]:
    """What the settings that are `Annotated` are marked with, by their dotted paths."""
    found = {}
    for name, hint in get_type_hints(kind, include_extras=True).items():
        plain = hints(kind).get(name)
        if is_dataclass(plain):
            below = _marked(cast(type, plain))
            found |= {f"{name}.{path}": marks for path, marks in below.items()}
        elif get_origin(hint) is Annotated:
            found[name] = get_args(hint)[1:]
    return found
