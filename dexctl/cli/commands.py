"""Which commands there are, found without loading what they need.

dexctl's own commands stand in a table. Other packages add theirs through the entry-point group
``dexctl.commands``: the name is the command's, the object is either a class as `Command`
describes, or a mapping of names to such classes (``dexctl hardware scan``); the name "" is what
runs without one (``dexctl plan``, beside ``dexctl plan show``). An entry point is loaded when its
command is run, not before: the overview reads the first line of the class's docstring from the
source file.
"""

from __future__ import annotations

import ast
from collections.abc import Mapping
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple, Protocol

from dexctl.exceptions import DexctlError, RoomShadowed, UnknownName
from dexctl.rooms import check_room, home

GROUP = "dexctl.commands"


class CommandUnavailable(DexctlError):
    """A command is known, but what it needs is not installed."""


class Command(Protocol):
    """A command: tyro makes its options from the constructor, and its help from the docstrings."""

    def run(self) -> int | None:
        """Do it. None or 0: it went well; raise DexctlError or return 1 where it did not."""
        ...


class CommandEntry(NamedTuple):
    """Where a command is found.

    Attributes:
        name: as typed.
        target: ``module:attribute``.
        summary: one line, "" where it cannot be read.
    """

    name: str
    target: str
    summary: str

    def load(self) -> type[Command] | Mapping[str, type[Command]]:
        """The command's class, or a mapping of names to classes.

        Raises:
            CommandUnavailable: what it needs cannot be imported, or is shadowed by another package.
        """
        point = EntryPoint(self.name, self.target, GROUP)
        try:
            check_room(point.module)
            return point.load()
        except RoomShadowed as error:
            raise CommandUnavailable(
                f"the command {self.name!r} cannot be loaded: {error}"
            ) from None
        except (ImportError, AttributeError) as error:
            raise CommandUnavailable(
                f"the command {self.name!r} cannot be loaded from {self.target}: {error}"
            ) from error


_OWN = (
    CommandEntry(
        "demo",
        "dexctl.cli.demo:Demo",
        "Turn a cube with each controller; table, video and report.",
    ),
    CommandEntry(
        "rotate",
        "dexctl.cli.rotate:Rotate",
        "Turn an object with one controller, many trials at once.",
    ),
    CommandEntry(
        "check-grasp",
        "dexctl.cli.check_grasp:CheckGrasp",
        "Settle a grasp and say how good it is.",
    ),
    CommandEntry(
        "plan",
        "dexctl.cli.plan:COMMANDS",
        "Grow a tree of grasps that turn an object; `plan show` films and draws one.",
    ),
    CommandEntry(
        "hands",
        "dexctl.cli.hands:COMMANDS",
        "List the hands that are known; `hands add` takes a new one, `hands check` tries one.",
    ),
)


def commands() -> dict[str, CommandEntry]:
    """All commands by name; a name of dexctl's own cannot be taken over by another package."""
    found = {entry.name: entry for entry in _OWN}
    for point in sorted(entry_points(group=GROUP), key=lambda point: point.name):
        if point.name not in found:
            found[point.name] = CommandEntry(point.name, point.value, _summary(point))
    return found


def find(name: str) -> CommandEntry:
    """The command ``name``.

    Raises:
        UnknownName: no such command.
    """
    known = commands()
    if name not in known:
        raise UnknownName("command", name, known)
    return known[name]


def _summary(point: EntryPoint) -> str:
    """First line of the docstring of what ``point`` names (a mapping: of its module)."""
    try:
        tree = ast.parse(_source(point.module).read_text(encoding="utf-8"))
    except (OSError, SyntaxError, ValueError, ImportError):
        return ""
    for node in tree.body:
        if isinstance(node, (ast.ClassDef, ast.FunctionDef)) and node.name == point.attr:
            return _first_line(ast.get_docstring(node))
    return _first_line(ast.get_docstring(tree))


def _source(module: str) -> Path:
    """The file of a module; only the top-level package is looked up, and nothing is imported.

    The packages that come with dexctl are read where they are, whatever shadows them.
    """
    package, *rest = module.split(".")
    folder = home(package)
    if folder is None:
        spec = find_spec(package)
        if spec is None or spec.origin is None:
            raise ImportError(f"no package {package!r}")
        if not rest:
            return Path(spec.origin)
        folder = Path(spec.origin).parent
    path = folder.joinpath(*rest)
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def _first_line(docstring: str | None) -> str:
    return docstring.strip().splitlines()[0] if docstring and docstring.strip() else ""
