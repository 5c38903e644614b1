"""The leaves of a tree of configurations: their paths, own names and values, and what differs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from typing import Annotated, Any, cast, get_args, get_origin, get_type_hints

from dexctl.settings.marks import BY_PATH


@cache
def leaves(kind: type) -> Mapping[str, str]:
    """The dotted path of each setting below ``kind``, by its own name.

    Repeated names are out, and what is marked with `BY_PATH`.
    """
    found: dict[str, list[str]] = {}
    for path in paths(kind):
        if not path.startswith(marked_by_path(kind)):
            found.setdefault(path.rpartition(".")[2], []).append(path)
    return {name: those[0] for name, those in found.items() if len(those) == 1}


def paths(kind: type) -> Iterator[str]:
    """The dotted path of every setting below ``kind``."""
    for name, hint in hints(kind).items():
        if is_dataclass(hint):
            yield from (f"{name}.{path}" for path in paths(cast(type, hint)))
        else:
            yield name


def get(config: Any, path: str) -> Any:
    """The setting at a dotted path."""
    for name in path.split("."):
        config = getattr(config, name)
    return config


def differing(a: Any, b: Any) -> list[str]:
    """The dotted paths of the settings that two configurations of one kind have otherwise."""
    return [path for path in paths(type(a)) if get(a, path) != get(b, path)]


def difference(a: Any, b: Any, where: str = "") -> str | None:
    """The first place where two plain values differ, with both; None where they do not."""
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        for key in dict.fromkeys([*a, *b]):
            found = difference(a.get(key), b.get(key), f"{where}.{key}" if where else str(key))
            if found is not None:
                return found
        return None
    return None if a == b else f"{where} was {a!r}, is {b!r}"


@cache
def hints(kind: type) -> Mapping[str, Any]:
    """The kinds of the settings, without what is only for the command line.

    A field that is not compared is no setting: it says where the others came from.
    """
    hints = get_type_hints(kind)
    return {one.name: hints[one.name] for one in fields(kind) if one.init and one.compare}


@cache
def marked_by_path(kind: type) -> tuple[str, ...]:
    """How the dotted paths begin that are below a configuration marked with `BY_PATH`."""
    found: list[str] = []
    for name, hint in get_type_hints(kind, include_extras=True).items():
        if get_origin(hint) is Annotated and BY_PATH in get_args(hint):
            found.append(f"{name}.")
        elif is_dataclass(inner := hints(kind).get(name)):
            found += (f"{name}.{below}" for below in marked_by_path(cast(type, inner)))
    return tuple(found)
