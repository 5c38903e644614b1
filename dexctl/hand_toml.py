"""A configuration as the text of a TOML file, with comments; tomllib only reads."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

WIDTH = 96


def to_toml(config: Any, comments: Mapping[str, str]) -> str:
    """``config``, a dataclass, without what is as it is by default and has no comment.

    Args:
        config: values are texts, numbers, paths, lists of those, tables by name, dataclasses.
        comments: what stands above a value or a table, by its dotted path; "" is the file's head.
    """
    lines = [*_comment(comments.get("", "")), *_table(_values(config, "", comments), "", comments)]
    return "\n".join(lines).strip() + "\n"


def _values(config: Any, path: str, comments: Mapping[str, str]) -> dict[str, Any]:
    found = {}
    for one in fields(config):
        value, where = getattr(config, one.name), f"{path}.{one.name}" if path else one.name
        # what is not compared is no setting
        if one.compare and (value != one.default or where in comments):
            found[one.name] = value
    return found


def _table(
    values: Mapping[str, Any], path: str, comments: Mapping[str, str], by_name: bool = False
) -> Iterator[str]:
    """The lines of a table; ``by_name`` where its owner chose the names, each of which counts."""
    tables = {}
    for name, value in values.items():
        where = f"{path}.{name}" if path else name
        if is_dataclass(value):
            tables[where] = _values(value, where, comments), by_name, False
        elif isinstance(value, Mapping):
            tables[where] = value, False, True
        elif value is not None:
            yield from _comment(comments.get(where, ""))
            yield f"{_key(name)} = {_value(value)}"
    for where, (value, even_empty, names) in tables.items():
        body = list(_table(value, where, comments, names))
        if not (body or even_empty):
            continue
        yield ""
        yield from _comment(comments.get(where, ""))
        if body and not body[0]:  # the empty line above a table of tables
            yield from body[1:]
        else:
            yield f"[{'.'.join(_key(part) for part in _parts(where, path))}]"
            yield from body


def _parts(where: str, path: str) -> list[str]:
    """The names of a dotted path; only the last may itself hold a dot."""
    return [*path.split("."), where[len(path) + 1 :]] if path else [where]


def _comment(text: str) -> Iterator[str]:
    for line in text.splitlines():
        yield from (f"# {part}" for part in textwrap.wrap(line, WIDTH - 2))


def _key(name: str) -> str:
    bare = name.isascii() and name.replace("_", "").replace("-", "").isalnum()
    return name if bare else _text(name)


def _text(value: str) -> str:
    escaped = value.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(c if c.isprintable() else f"\\u{ord(c):04x}" for c in escaped) + '"'


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str | Path):
        return _text(str(value))
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_value, value))}]"
    if isinstance(value, np.generic):
        value = value.item()
    return repr(value)  # of a number, with all its digits: inf and nan are TOML's words, too
