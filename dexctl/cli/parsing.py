"""From arguments to a command.

A command is a dataclass, and the configurations nested in it are its options. Their booleans are
pairs, ``--overlap`` and ``--no-overlap``; a `Switch` of the command itself is ``--json`` alone. A
command class may have three things more:

- ``short: ClassVar[Mapping[str, str]]``: other spellings of options, ``{"--method":
  "--guidance.method"}``;
- a classmethod ``defaults(arguments)``: the command whose values hold where ``arguments`` say
  nothing, for those whose defaults depend on another option;
- with it, ``deciding: ClassVar[tuple[str, ...]]``: the options that they depend on, where
  `dexctl.cli.command_line.command_line` is asked of it.
"""

from __future__ import annotations

import io
import os
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, redirect_stderr
from types import NoneType
from typing import Annotated, Any, TypeVar, get_args

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from dexctl.exceptions import InvalidInput

C = TypeVar("C")
Switch = Annotated[bool, tyro.conf.FlagCreatePairsOff]
"""A boolean of a command that is False until it is given, without a ``--no-`` beside it."""

_BORDER = "╭╮╰╯│─ "
_HELP = ("-h", "--help")
_DIRECTION = re.compile(r"-([xyz]|[\d.].*,.*)")  # a value that looks like an option: -z, -1,0,0
_AXIS = re.compile(r"-[xyz]")
NONE = "none"
"""What is typed for an option that may be none."""


def parse(kind: type[C], title: str, arguments: Sequence[str]) -> C | None:
    """The command that ``arguments`` describe; None where they only asked for help.

    Raises:
        InvalidInput: they are not right; one line, where tyro draws a box.
        UnknownName, InvalidInput: a configuration refuses a value.
    """
    short: Mapping[str, str] = getattr(kind, "short", {})
    words = _spelled_out(arguments, short)
    defaults = defaults_of(kind, words)
    box = io.StringIO()
    try:
        with redirect_stderr(box), nullcontext() if set(words) & set(_HELP) else _wide():
            return tyro.cli(
                kind,
                prog=title,
                args=words,
                default=tyro.MISSING_NONPROP if defaults is None else defaults,
                registry=_REGISTRY,
            )
    except SystemExit as stop:
        if not stop.code:
            if short:
                print("short:", *(f"  {a}  is  {b}" for a, b in short.items()), sep="\n")
            return None
        line = _one_line(box.getvalue())
        if line.startswith("Unrecognized") and any(_AXIS.fullmatch(word) for word in words):
            line += "; several axes are one word, with commas between: x,-x"
        raise InvalidInput(f"{line} (see {title} --help)") from None
    finally:
        if sys.exc_info()[0] is None:
            sys.stderr.write(box.getvalue())  # a warning, if anything


def defaults_of(kind: Any, words: Sequence[str]) -> Any:
    """The command whose values hold where ``words`` say nothing; None: those of its fields."""
    if not hasattr(kind, "defaults"):
        return None
    try:
        return kind.defaults(list(words))
    except InvalidInput:
        if any(word in _HELP for word in words):
            return kind.defaults([])
        raise


def _spelled_out(arguments: Sequence[str], short: Mapping[str, str]) -> list[str]:
    """Short spellings as long ones, and ``--axis -z`` as ``--axis=-z``."""
    words: list[str] = []
    for argument in arguments:
        last = words[-1] if words else ""
        if _DIRECTION.fullmatch(argument) and last.startswith("--") and "=" not in last:
            words[-1] = f"{last}={argument}"
        else:
            words.append(respelled(argument, short))
    return words


def said(kind: type[C], arguments: Sequence[str]) -> C | None:
    """What ``arguments`` say by themselves, for defaults that depend on it.

    None where they are not right; that shows when they are parsed.
    """
    words = [word for word in arguments if word not in _HELP]
    try:
        return tyro.cli(kind, args=words, registry=_REGISTRY, console_outputs=False)
    except SystemExit:
        return None


def is_given(arguments: Sequence[str], option: str) -> bool:
    """Whether ``option`` is among them, with a value or without."""
    return any(word.partition("=")[0] == option for word in arguments)


def check_conditions(arguments: Sequence[str], conditions: Sequence[str]) -> None:
    """Raise InvalidInput where ``--conditions`` is among ``arguments`` with nothing behind it."""
    if is_given(arguments, "--conditions") and not conditions:
        raise InvalidInput("--conditions has nothing behind it; expected names, or a .toml file")


def given(arguments: Sequence[str], option: str) -> str | None:
    """The value that ``option`` is given, for a default that depends on it; None: it is not."""
    for i, word in enumerate(arguments):
        flag, equals, value = word.partition("=")
        if flag == option:
            return value if equals else next(iter(arguments[i + 1 : i + 2]), None)
    return None


def respelled(word: str, table: Mapping[str, str]) -> str:
    """An option as ``table`` spells it; ``--option=value`` too."""
    flag, equals, value = word.partition("=")
    return f"{table.get(flag, flag)}{equals}{value}"


def _optional(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """How what may be none is typed: as that word, which the help does not show as syntax."""
    kinds = get_args(info.type)
    others = [kind for kind in kinds if kind is not NoneType]
    if len(others) != 1 or len(others) == len(kinds) or info.type_origin is Annotated:
        return None
    inside = PrimitiveTypeInfo.make(raw_annotation=others[0], parent_markers=info.markers)
    spec = ConstructorRegistry.get_primitive_spec(inside)
    if not isinstance(spec, PrimitiveConstructorSpec) or spec.nargs not in (1, "*"):
        return None

    def read(words: list[str]) -> Any:
        return None if [word.lower() for word in words] == [NONE] else spec.instance_from_str(words)

    def show(value: Any) -> list[str]:
        return [NONE] if value is None else spec.str_from_instance(value)

    return PrimitiveConstructorSpec(
        nargs=spec.nargs,
        metavar=spec.metavar,
        instance_from_str=read,
        is_instance=lambda value: value is None or spec.is_instance(value),
        str_from_instance=show,
        choices=None if spec.choices is None else (*spec.choices, NONE),
    )


# the configuration's own message names the setting; an option's name stays
_TYRO_SAYS = re.compile(r"^Error parsing (\w[\w.-]*: )?")
_REGISTRY = ConstructorRegistry()
_REGISTRY.primitive_rule(_optional)


@contextmanager
def _wide() -> Iterator[None]:
    """No line of a box is broken: tyro does that at commas too, where no space was."""
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = "9999"
    try:
        yield
    finally:
        if before is None:
            del os.environ["COLUMNS"]
        else:
            os.environ["COLUMNS"] = before


def _one_line(box: str) -> str:
    """What stands in tyro's box above its first rule.

    Where the terminal knows no more than ASCII, the box has no frame, and a rule below its title.
    """
    parts: list[list[str]] = [[]]
    for line in box.splitlines():
        if line.startswith(("╭", "╰")) or not line.strip(_BORDER + "-"):
            parts.append([])
        else:
            parts[-1].append(line.strip(_BORDER))
    found = [part for part in parts if part]
    framed = "╭" in box
    said = next(iter(found if framed else found[1:]), [])
    return _TYRO_SAYS.sub("", " ".join(said)) or "bad arguments"
