"""Configurations from plain values and back, each value checked for its kind."""

from __future__ import annotations

import types
from collections.abc import Mapping
from dataclasses import MISSING, Field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin

import numpy as np

from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.settings.tree import hints, leaves

C = TypeVar("C")


def to_plain(config: Any) -> dict[str, Any]:
    """A configuration as JSON can hold it; `from_plain` makes it again."""
    return {one.name: _plain(getattr(config, one.name)) for one in fields(config) if one.compare}


def from_plain(kind: type[C], values: Mapping[str, Any], where: str = "") -> C:
    """The configuration that ``values`` describe; what they leave out has its default.

    A class says in ``MOVED`` which of its settings had another path, ``"table.name"``, in an
    earlier version; under that path they are read still.

    Args:
        kind: the class.
        values: by name, nested or by the leaves' own names; lists are tuples, whole numbers will
            do for numbers.
        where: what stands before the names in messages.

    Raises:
        UnknownName: no such setting.
        InvalidInput: a value of the wrong kind, out of range, or missing.
    """
    found = _arguments(kind, values, where)
    needed = [one.name for one in fields(cast(Any, kind)) if one.init and _has_no_default(one)]
    missing = [name for name in needed if name not in found]
    if missing:
        raise InvalidInput(f"{where or kind.__name__} lacks {', '.join(missing)}")
    return kind(**found)


def changed(config: C, values: Mapping[str, Any], where: str = "") -> C:
    """A copy of ``config`` with ``values``, which are as `from_plain` takes them.

    Raises:
        UnknownName, InvalidInput: see `from_plain`.
    """
    found = {}
    for name, value in _sorted_in(type(config), values, where).items():
        path = f"{where}.{name}" if where else name
        kind, before = hints(type(config))[name], getattr(config, name)
        if is_dataclass(kind) and isinstance(value, Mapping):
            found[name] = changed(before, value, path)
        else:
            found[name] = _value(kind, value, path)
    return replace(cast(Any, config), **found)


def by_path(kind: type, values: Mapping[str, Any], where: str = "") -> dict[str, Any]:
    """``values``, which are as `from_plain` takes them, by the dotted paths of ``kind``.

    So what two tables say of one setting can be put together, whichever name each has for it.

    Raises:
        UnknownName, InvalidInput: no such setting, or a value of the wrong kind. Whether it is in
            range, the configuration says that is made of it.
    """
    found: dict[str, Any] = {}
    for name, value in _sorted_in(kind, values, where).items():
        path, inner = f"{where}.{name}" if where else name, hints(kind)[name]
        if is_dataclass(inner) and isinstance(value, Mapping):
            below = by_path(cast(type, inner), value, path)
            found |= {f"{name}.{rest}": one for rest, one in below.items()}
        else:
            found[name] = _value(inner, value, path)
    return found


def describe(kind: Any) -> str:
    """What is expected of a value of ``kind``, for people."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):
        return " or ".join(describe(one) for one in inner)
    if origin is Literal:
        return " or ".join(repr(one) for one in inner)
    if origin is tuple:
        if inner[-1] is Ellipsis:
            return f"a list, each {describe(inner[0])}"
        return f"{len(inner)} values, each {describe(inner[0])}"
    if origin is dict:
        return f"a table by name, each {describe(inner[1])}"
    if is_dataclass(kind):
        return "a table of settings"
    return _WORDS.get(kind, getattr(kind, "__name__", str(kind)))


_WORDS = {
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    str: "a text",
    Path: "a path",
    type(None): "none",
}


def _plain(value: Any) -> Any:
    if is_dataclass(value):
        return to_plain(value)
    if isinstance(value, Mapping):
        return {key: _plain(one) for key, one in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(one) for one in value]
    return str(value) if isinstance(value, Path) else value


def _has_no_default(one: Field[Any]) -> bool:
    return one.default is MISSING and one.default_factory is MISSING


def _arguments(kind: type, values: Mapping[str, Any], where: str) -> dict[str, Any]:
    found = {}
    for name, value in _sorted_in(kind, values, where).items():
        path = f"{where}.{name}" if where else name
        found[name] = _value(hints(kind)[name], value, path)
    return found


def _sorted_in(kind: type, values: Mapping[str, Any], where: str) -> dict[str, Any]:
    """``values`` by the fields of ``kind``: leaves and paths from below go into their tables."""
    own, below = hints(kind), leaves(kind)
    found: dict[str, Any] = {}
    if not isinstance(values, Mapping):
        raise InvalidInput(f"{where or 'the configuration'} is {values!r}; expected a table")
    for name, value in values.items():
        path = name if name in own else below.get(name, name)
        first, _, rest = str(path).partition(".")
        if first not in own or (rest and not is_dataclass(own[first])):
            known = (*own, *(leaf for leaf in below if leaf not in own))
            raise UnknownName(f"setting of {where}" if where else "setting", name, known)
        if not rest:
            both = isinstance(found.get(first), Mapping) and isinstance(value, Mapping)
            found[first] = {**found[first], **value} if both else value
        else:
            table = found.setdefault(first, {})
            if isinstance(table, Mapping):
                found[first] = {**table, rest: value}
    for before, now in getattr(kind, "MOVED", {}).items():
        _move(found, before.split("."), now.split("."))
    return found


def _move(found: dict[str, Any], before: list[str], now: list[str]) -> None:
    """What an earlier version wrote into one table of ``found`` goes into the one it is in now."""
    (table, name), (other, own) = before, now
    held, there = found.get(table), found.get(other, {})
    if isinstance(held, Mapping) and name in held and isinstance(there, Mapping):
        found[table] = {key: value for key, value in held.items() if key != name}
        found[other] = {own: held[name], **there}


def _value(kind: Any, value: Any, where: str) -> Any:
    fits, found = _fit(kind, value, where)
    if not fits:
        raise InvalidInput(f"{where} is {value!r}; expected {describe(kind)}")
    return found


def _fit(kind: Any, value: Any, where: str) -> tuple[bool, Any]:
    """Whether ``value`` is of ``kind``, and the value as that kind has it."""
    origin, inner = get_origin(kind), get_args(kind)
    if kind is Any:
        return True, value
    if origin in (Union, types.UnionType):
        for one in inner:
            fits, found = _fit(one, value, where)
            if fits:
                return True, found
        return False, value
    if kind is type(None):
        return value is None, None
    if origin is Literal:
        return any(
            value is one or (type(value) is type(one) and value == one) for one in inner
        ), value
    if is_dataclass(kind):
        if isinstance(value, cast(type, kind)):
            return True, value
        if not isinstance(value, Mapping):
            return False, value
        return True, from_plain(cast(type, kind), value, where)
    if origin is tuple:
        return _fit_tuple(inner, value, where)
    if origin is dict:  # by names that the owner chooses
        if not isinstance(value, Mapping):
            return False, value
        return True, {name: _value(inner[1], one, f"{where}.{name}") for name, one in value.items()}
    return _fit_scalar(kind, value)


def _fit_tuple(inner: tuple[Any, ...], value: Any, where: str) -> tuple[bool, Any]:
    if isinstance(value, str) and inner[0] is str and inner[-1] is Ellipsis:
        return True, (value,)
    if not isinstance(value, list | tuple | np.ndarray):
        return False, value
    kinds = [inner[0]] * len(value) if inner[-1] is Ellipsis else list(inner)
    if len(kinds) != len(value):
        return False, value
    made = [_fit(kind, one, where) for kind, one in zip(kinds, value, strict=True)]
    return all(fits for fits, _ in made), tuple(one for _, one in made)


def _fit_scalar(kind: Any, value: Any) -> tuple[bool, Any]:
    truth = isinstance(value, bool | np.bool_)
    if kind is bool:
        return truth, bool(value) if truth else value
    if kind is int:
        whole = isinstance(value, int | np.integer) and not truth
        return whole, int(value) if whole else value
    if kind is float:
        number = isinstance(value, int | float | np.number) and not truth
        return number, float(value) if number else value
    if kind is Path:
        return isinstance(value, str | Path), Path(value) if isinstance(value, str) else value
    return isinstance(value, kind), value
