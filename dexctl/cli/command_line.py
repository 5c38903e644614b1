"""From a command back to what was typed: reports say it, so that anyone can get the same again."""

from __future__ import annotations

import shlex
import types
from collections.abc import Iterator
from dataclasses import MISSING, Field, fields, is_dataclass
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import tyro
from tyro.constructors import PrimitiveConstructorSpec

from dexctl.cli.parsing import NONE, defaults_of, respelled

_POSITIONAL = get_args(tyro.conf.Positional[Any])[1]


def command_line(command: Any, name: str, leave_out: tuple[str, ...] = ("--json",)) -> str:
    """What to type to get ``command`` again: the options that differ from their defaults.

    Args:
        command: of a class that `dexctl.cli.parsing.parse` takes; one with ``defaults`` says on
            which options they depend (``deciding``).
        name: of the command, as typed after ``dexctl``.
        leave_out: options that change nothing of what is found.
    """
    kind = type(command)
    given = _options(command, None)
    deciding = {flag: given[flag] for flag in getattr(kind, "deciding", ()) if flag in given}
    words = [word for group in deciding.values() for word in group]
    given = deciding | _options(command, defaults_of(kind, words))
    spelled = {long: short for short, long in getattr(kind, "short", {}).items()}
    said = ["dexctl", *name.split()]
    # what goes without a flag must not follow an option that takes several words
    for flag in sorted(given, key=lambda flag: "".join(given[flag]).startswith("--")):
        if flag not in leave_out:
            said += [respelled(word, spelled) for word in given[flag]]
    return shlex.join(said)


def _options(config: Any, base: Any, prefix: str = "") -> dict[str, list[str]]:
    """The words for each option of ``config`` that differs from ``base``, by its flag."""
    found: dict[str, list[str]] = {}
    hints = get_type_hints(type(config), include_extras=True)
    for field in fields(config):
        if not field.init:
            continue
        value = getattr(config, field.name)
        before = _default(field) if base is None else getattr(base, field.name)
        marks = _marks(hints[field.name])
        names = (getattr(mark, "name", None) for mark in marks)  # of tyro.conf.arg
        named = next((name for name in names if name is not None), field.name).replace("_", "-")
        if is_dataclass(value):
            inner = before if isinstance(before, type(value)) else None
            found |= _options(value, inner, f"{prefix}{named}." if named else prefix)
        elif value != before:
            found[f"--{prefix}{named}"] = _words(prefix, named, value, marks)
    return found


def _marks(hint: Any) -> tuple[Any, ...]:
    """What a type is annotated with; of one that may be none, also what the other one is."""
    if get_origin(hint) is Annotated:
        return (*hint.__metadata__, *_marks(get_args(hint)[0]))
    if get_origin(hint) in (Union, types.UnionType):
        return tuple(mark for one in get_args(hint) for mark in _marks(one))
    return ()


def _default(field: Field[Any]) -> Any:
    """A field's default; MISSING, which equals nothing, where it has none."""
    return field.default if field.default_factory is MISSING else field.default_factory()


def _words(prefix: str, name: str, value: Any, marks: tuple[Any, ...]) -> list[str]:
    """An option as it is typed."""
    if isinstance(value, bool):
        return [f"--{prefix}{name}" if value else f"--{prefix}no-{name}"]
    texts = list(_texts(value, marks))
    if _POSITIONAL in marks:
        return texts
    dashed = len(texts) == 1 and texts[0].startswith("-")
    flag = f"--{prefix}{name}"
    return [f"{flag}={texts[0]}"] if dashed else [flag, *texts]


def _texts(value: Any, marks: tuple[Any, ...]) -> Iterator[str]:
    spec = next((mark for mark in marks if isinstance(mark, PrimitiveConstructorSpec)), None)
    if spec is not None and value is not None:
        yield from spec.str_from_instance(value)
    elif isinstance(value, tuple | list):
        yield from (str(one) for one in value)
    else:
        yield NONE if value is None else str(value)
