"""What settings are marked with: files, names that stay in a path, options of a command line."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import field, fields, make_dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple, get_type_hints

import tyro

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

NESTED = tyro.conf.arg(name="", help="")
"""Marks a nested configuration whose settings go without its name on the command line."""


class Text(NamedTuple):
    """What help says of a setting that means something else than where it is defined.

    Attributes:
        help: the text.
        values: what can be typed for it; None: what its type says.
    """

    help: str
    values: str | None = None


def only(default: Any, *names: str, texts: Mapping[str, Text] | None = None) -> Any:
    """Marks a nested configuration of which only some settings are options; else as `NESTED`.

    Args:
        default: a configuration; the other settings have its values, whatever is typed.
        names: of the settings, or of configurations in it; dotted for one setting of those.
        texts: what help says of settings that mean something else here, by name; dotted too.
    """
    texts = texts or {}
    kind, heads = type(default), {name.partition(".")[0] for name in names}
    with_markers = get_type_hints(kind, include_extras=True)
    shown = []
    for one in fields(kind):
        hint, value = with_markers[one.name], getattr(default, one.name)
        inside = f"{one.name}."
        below = [name.removeprefix(inside) for name in names if name.startswith(inside)]
        said = {n.removeprefix(inside): t for n, t in texts.items() if n.startswith(inside)}
        if said and not below and one.name in heads:
            below = [inner.name for inner in fields(value)]
        if below:
            hint = Annotated[type(value), only(value, *below, texts=said)]
        elif one.name not in heads:
            hint = Annotated[hint, tyro.conf.Fixed, tyro.conf.Suppress]
        elif one.name in texts:
            text = texts[one.name]
            hint = Annotated[hint, tyro.conf.arg(help=text.help, metavar=text.values)]
        shown.append((one.name, hint, field(default=value)))
    narrow = make_dataclass(kind.__name__, shown, bases=(kind,), frozen=True, kw_only=True)
    return tyro.conf.arg(name="", help="", constructor=narrow)
