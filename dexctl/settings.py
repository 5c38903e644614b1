"""Settings: nested frozen dataclasses as plain values, as files have them, and by leaf name.

A configuration is a keyword-only frozen dataclass whose fields are numbers, texts, tuples, or
configurations in turn. The names of the leaves of one tree differ, so a setting can be given by
its own name wherever it stands: ``changed(train, {"axis": "x"})``. Two leaves of the same name
(the ``learning_rate`` of two algorithms) are told apart by the path, ``"ppo.learning_rate"``.
"""

from __future__ import annotations

import types
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import MISSING, Field, field, fields, is_dataclass, make_dataclass, replace
from functools import cache
from pathlib import Path
from typing import (
    Annotated,
    Any,
    Literal,
    NamedTuple,
    TypeVar,
    Union,
    cast,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np
import tyro

from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.files import is_path

C = TypeVar("C")
T = TypeVar("T")

FILE_OR_NAME = "a file, or a name"
"""Marks a text that may be the path of a file (`dexctl.files.is_path`); see `absolute`."""


class Located(NamedTuple):
    """Marks a setting with the names of files in it; see `absolute`.

    Attributes:
        absolute: from the value and the folder that its files are meant from, the value with
            absolute paths.
    """

    absolute: Callable[[Any, Path], Any]


BY_PATH = "settings by their paths"
"""Marks a nested configuration whose settings go by their paths only, so that their own names stay
those of others: the ``substeps`` of a way to plan and of the physics. See `leaves`."""

NESTED = tyro.conf.arg(name="")
"""Marks a nested configuration whose settings go without its name on the command line."""


def only(default: Any, *names: str, texts: Mapping[str, str] | None = None) -> Any:
    """Marks a nested configuration of which only some settings are options; else as `NESTED`.

    Args:
        default: a configuration; the other settings have its values, whatever is typed.
        names: of the settings, or of configurations in it; dotted for one setting of those.
        texts: what help says of settings that mean something else here, by name.
    """
    kind, heads = type(default), {name.partition(".")[0] for name in names}
    with_markers = get_type_hints(kind, include_extras=True)
    shown = []
    for one in fields(kind):
        hint, value = with_markers[one.name], getattr(default, one.name)
        below = [name.partition(".")[2] for name in names if name.startswith(f"{one.name}.")]
        if below:
            hint = Annotated[type(value), only(value, *below)]
        elif one.name not in heads:
            hint = Annotated[hint, tyro.conf.Fixed, tyro.conf.Suppress]
        elif texts and one.name in texts:
            hint = Annotated[hint, tyro.conf.arg(help=texts[one.name])]
        shown.append((one.name, hint, field(default=value)))
    narrow = make_dataclass(kind.__name__, shown, bases=(kind,), frozen=True, kw_only=True)
    return tyro.conf.arg(name="", constructor=narrow)


def _read_vector(words: list[str]) -> str | tuple[float, ...]:
    parts = words[0].split(",")
    if len(parts) == 1:
        return words[0]
    try:
        numbers = tuple(float(part) for part in parts)
    except ValueError:
        numbers = ()
    if len(numbers) != 3 or not np.isfinite(numbers).all():
        raise ValueError(f"{words[0]!r} is neither a name nor three finite numbers")
    return numbers


def _show_vector(value: str | tuple[float, ...]) -> list[str]:
    return [value if isinstance(value, str) else _commas(value)]


Vector = Annotated[
    str | tuple[float, float, float],
    tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar="NAME|X,Y,Z",
        instance_from_str=_read_vector,
        is_instance=lambda value: isinstance(value, str | tuple),
        str_from_instance=_show_vector,
    ),
]
"""A direction by name, or as three numbers; "x,y,z" on the command line."""


def _read_quaternion(words: list[str]) -> tuple[float, float, float, float]:
    try:
        w, x, y, z = (float(part) for part in words[0].split(","))
    except ValueError:
        raise ValueError(f"{words[0]!r} is no orientation; expected w,x,y,z") from None
    return w, x, y, z


def _comma_separated(metavar: str, read: Callable[[list[str]], Any]) -> Any:
    """How a tuple is one word of the command line."""
    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar=metavar,
        instance_from_str=read,
        is_instance=lambda value: isinstance(value, tuple),
        str_from_instance=lambda value: [_commas(value)],
    )


def _commas(values: Iterable[float | str]) -> str:
    return ",".join(one if isinstance(one, str) else f"{one:g}" for one in values)


Quaternion = Annotated[
    tuple[float, float, float, float], _comma_separated("W,X,Y,Z", _read_quaternion)
]
"""An orientation, wxyz; "w,x,y,z" on the command line."""

Quaternions = Annotated[
    tuple[tuple[float, float, float, float], ...],
    tyro.constructors.PrimitiveConstructorSpec(
        nargs="*",
        metavar="[W,X,Y,Z ...]",
        instance_from_str=lambda words: tuple(_read_quaternion([word]) for word in words),
        is_instance=lambda value: isinstance(value, tuple),
        str_from_instance=lambda value: [_commas(each) for each in value],
    ),
]
"""Several orientations, each as `Quaternion`."""


def _read_range(words: list[str]) -> tuple[float, float]:
    try:
        low, high = (float(part) for part in words[0].split(","))
    except ValueError:
        raise ValueError(f"{words[0]!r} is no range; expected two numbers, low,high") from None
    return low, high


Range = Annotated[tuple[float, float], _comma_separated("LOW,HIGH", _read_range)]
"""From a low to a high number; "low,high" on the command line."""


def _read_named_ranges(words: list[str]) -> dict[str, tuple[float, float]]:
    found: dict[str, tuple[float, float]] = {}
    for word in words:
        name, _, numbers = word.partition("=")
        if not (name and numbers):
            raise ValueError(f"{word!r} is no range with a name; expected name=low,high")
        if name in found:
            raise ValueError(f"{name!r} is given twice")
        found[name] = _read_range([numbers])
    return found


NamedRanges = Annotated[
    dict[str, tuple[float, float]],
    tyro.constructors.PrimitiveConstructorSpec(
        nargs="*",
        metavar="[NAME=LOW,HIGH ...]",
        instance_from_str=_read_named_ranges,
        is_instance=lambda value: isinstance(value, dict),
        str_from_instance=lambda value: [f"{name}={_commas(one)}" for name, one in value.items()],
    ),
]
"""Ranges by name; "name=low,high", several of them, on the command line."""


def _read_names(words: list[str]) -> tuple[str, ...]:
    return tuple(filter(None, words[0].split(",")))


Names = Annotated[tuple[str, ...], _comma_separated("NAME,NAME", _read_names)]
"""Names that may begin with a minus; "x,-y" on the command line."""


def to_plain(config: Any) -> dict[str, Any]:
    """A configuration as JSON can hold it; `from_plain` makes it again."""
    return {one.name: _plain(getattr(config, one.name)) for one in fields(config) if one.compare}


def from_plain(kind: type[C], values: Mapping[str, Any], where: str = "") -> C:
    """The configuration that ``values`` describe; what they leave out has its default.

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
        kind, before = _hints(type(config))[name], getattr(config, name)
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
        path, inner = f"{where}.{name}" if where else name, _hints(kind)[name]
        if is_dataclass(inner) and isinstance(value, Mapping):
            below = by_path(cast(type, inner), value, path)
            found |= {f"{name}.{rest}": one for rest, one in below.items()}
        else:
            found[name] = _value(inner, value, path)
    return found


@cache
def leaves(kind: type) -> Mapping[str, str]:
    """The dotted path of each setting below ``kind``, by its own name.

    Repeated names are out, and what is marked with `BY_PATH`.
    """
    found: dict[str, list[str]] = {}
    for path in paths(kind):
        if not path.startswith(_by_path(kind)):
            found.setdefault(path.rpartition(".")[2], []).append(path)
    return {name: those[0] for name, those in found.items() if len(those) == 1}


def paths(kind: type) -> Iterator[str]:
    """The dotted path of every setting below ``kind``."""
    for name, hint in _hints(kind).items():
        if is_dataclass(hint):
            yield from (f"{name}.{path}" for path in paths(cast(type, hint)))
        else:
            yield name


def get(config: Any, path: str) -> Any:
    """The setting at a dotted path."""
    for name in path.split("."):
        config = getattr(config, name)
    return config


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
def _by_path(kind: type) -> tuple[str, ...]:
    """How the dotted paths begin that are below a configuration marked with `BY_PATH`."""
    found: list[str] = []
    for name, hint in get_type_hints(kind, include_extras=True).items():
        if get_origin(hint) is Annotated and BY_PATH in get_args(hint):
            found.append(f"{name}.")
        elif is_dataclass(inner := _hints(kind).get(name)):
            found += (f"{name}.{below}" for below in _by_path(cast(type, inner)))
    return tuple(found)


@cache
def _marked(kind: type) -> Mapping[str, tuple[Any, ...]]:
    """What the settings that are `Annotated` are marked with, by their dotted paths."""
    found = {}
    for name, hint in get_type_hints(kind, include_extras=True).items():
        plain = _hints(kind).get(name)
        if is_dataclass(plain):
            below = _marked(cast(type, plain))
            found |= {f"{name}.{path}": marks for path, marks in below.items()}
        elif get_origin(hint) is Annotated:
            found[name] = get_args(hint)[1:]
    return found


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


@cache
def _hints(kind: type) -> Mapping[str, Any]:
    """The kinds of the settings, without what is only for the command line.

    A field that is not compared is no setting: it says where the others came from.
    """
    hints = get_type_hints(kind)
    return {one.name: hints[one.name] for one in fields(kind) if one.init and one.compare}


def _arguments(kind: type, values: Mapping[str, Any], where: str) -> dict[str, Any]:
    found = {}
    for name, value in _sorted_in(kind, values, where).items():
        path = f"{where}.{name}" if where else name
        found[name] = _value(_hints(kind)[name], value, path)
    return found


def _sorted_in(kind: type, values: Mapping[str, Any], where: str) -> dict[str, Any]:
    """``values`` by the fields of ``kind``: leaves and paths from below go into their tables."""
    own, below = _hints(kind), leaves(kind)
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
    return found


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


_WORDS = {
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    str: "a text",
    Path: "a path",
    type(None): "none",
}


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
