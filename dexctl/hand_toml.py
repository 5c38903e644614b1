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
    """``config``, a dataclass, with what differs from nothing: None and empty tables are left out.

    Args:
        config: values are texts, numbers, paths, lists of those, tables by name, dataclasses.
        comments: what stands above a value or a table, by its dotted path; "" is the file's head.
    """
    lines = [*_comment(comments.get("", ""))]
    lines += _table(_values(config), "", comments)
    return "\n".join(lines).strip() + "\n"


def _values(config: Any) -> dict[str, Any]:
    return {
        one.name: getattr(config, one.name)
        for one in fields(config)
        if one.compare  # what is not compared is no setting
    }


def _table(values: Mapping[str, Any], path: str, comments: Mapping[str, str]) -> Iterator[str]:
    tables = {}
    for name, value in values.items():
        if is_dataclass(value):
            value = _values(value)
        if value is None or value == {} or value == "":
            continue
        where = f"{path}.{name}" if path else name
        if isinstance(value, Mapping):
            tables[where, name] = value
        else:
            yield from _comment(comments.get(where, ""))
            yield f"{_key(name)} = {_value(value)}"
    for (where, _), value in tables.items():
        body = list(_table(value, where, comments))
        if body:
            yield ""
            yield from _comment(comments.get(where, ""))
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
