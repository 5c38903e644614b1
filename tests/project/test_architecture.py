"""The rooms of docs/architecture.md: who may import whom, and which engine has which door."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from statistics import median

from dexctl.cli.commands import commands

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("dexctl", "learning", "hardware")
FILES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
# the package's own __init__ names every room, for type checkers and for lazy loading
MODULES = [path for path in FILES if path != ROOT / "dexctl" / "__init__.py"]

# The rooms inside dexctl that are not the base. Every other module is of the base, which may
# import nothing but itself.
ROOMS = {
    "grasp": "grasp",
    "igm": "igm",
    "switch": "switch",
    "gait": "gait",
    "sim": "sim",
    "planning": "planning",
    "controllers": "controllers",
    "cli": "application",
    "report": "application",
    "__main__": "application",
}
INSIDE = {"base", *ROOMS.values()} - {"application", "controllers"}
ALLOWED = {
    "base": {"base"},
    "grasp": {"base", "grasp"},
    "igm": {"base", "grasp", "igm"},
    "switch": {"base", "grasp", "switch"},
    "gait": {"base", "grasp", "igm", "switch", "gait"},
    "sim": {"base", "grasp", "sim"},
    "planning": {*INSIDE, "planning"} - {"controllers"},
    "controllers": {*INSIDE, "dexctl", "controllers"},  # by name
    "application": {*INSIDE, "application", "dexctl", "controllers"},
    "learning": {*INSIDE, "dexctl", "controllers", "learning"},
    # learning/cli/, and the pages that only its commands write: learning/inspection/report/
    "learning commands": {
        *INSIDE,
        "application",
        "dexctl",
        "controllers",
        "learning",
        "learning commands",
    },
    # its commands print and report
    "hardware": {*INSIDE, "application", "dexctl", "controllers", "hardware"},
}
DOORS = {
    "pinocchio": ["dexctl/hand.py"],
    "casadi": ["dexctl/switch/"],
    "numba": ["dexctl/igm/compiled.py"],
    "mujoco": ["dexctl/sim/", "dexctl/description/"],
    "mujoco_menagerie": ["dexctl/hands/"],
    # environments, configurations and trained policies do without torch
    "torch": ["learning/algorithms/", "learning/training/"],
    "gymnasium": ["learning/__init__.py", "learning/envs/"],
    # peers that tests and benchmarks compare with
    "mink": [],
    "stable_baselines3": [],
    "ray": ["dexctl/cluster.py"],
    "networkx": ["dexctl/planning/tree.py"],
    "dynamixel_sdk": ["hardware/"],
    "serial": ["hardware/"],
}


def none(violations: Iterable[str]) -> None:
    """All of them at once, where there are any."""
    found = list(violations)
    assert not found, "\n".join(["", *found])


def name(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@cache
def imports(path: Path) -> frozenset[str]:
    """The dotted names that a file imports anywhere, those for type checkers included."""
    return frozenset(_imports(path))


def _imports(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{name(path)} line {node.lineno}: relative import"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def room(dotted: str) -> str | None:
    """The room of a module (``dexctl.grasp.contacts`` -> grasp); None for other packages."""
    package, *rest = dotted.split(".")
    if package == "learning" and rest and (rest[0] == "cli" or "report" in rest):
        return "learning commands"
    if package in ("learning", "hardware"):
        return package
    if package != "dexctl":
        return None
    if rest and rest[0] in ROOMS:
        return ROOMS[rest[0]]
    inside = ROOT / "dexctl" / "/".join(rest[:1])
    is_module = bool(rest) and (inside.is_dir() or inside.with_suffix(".py").is_file())
    return "base" if is_module else "dexctl"  # dexctl itself, or a name out of its __init__


def test_dependency_direction() -> None:
    wrong = []
    for path in MODULES:
        own = room(".".join(path.relative_to(ROOT).with_suffix("").parts))
        assert own is not None
        for dotted in sorted(imports(path)):
            other = room(dotted)
            if other is not None and other not in ALLOWED[own]:
                wrong.append(f"{name(path)}, of {own}, imports {dotted}, of {other}")
    none(wrong)


def test_engines_come_in_through_their_doors() -> None:
    none(
        f"{name(path)} imports {engine}; its doors: {', '.join(doors) or 'none'}"
        for engine, doors in DOORS.items()
        for path in FILES
        if any(dotted.split(".")[0] == engine for dotted in imports(path))
        and not any(name(path).startswith(door) for door in doors)
    )


def test_the_doors_are_there() -> None:
    doors = [door for doors in DOORS.values() for door in doors]
    assert [door for door in doors if not (ROOT / door).exists()] == []


def test_the_page_names_the_doors_and_the_commands() -> None:
    page = (ROOT / "docs" / "architecture.md").read_text()
    rows = [line for line in page.splitlines() if line.startswith("| ")]
    wrong = []
    for engine, doors in DOORS.items():
        own = [row for row in rows if engine.replace("_", "-") in row.split("|")[1].lower()]
        shown = "".join(own)
        wrong += [
            f"{engine} comes in through {door}"
            for door in doors
            if f"`{door.removeprefix('dexctl/')}`" not in shown
        ]
    (line,) = (
        line for line in page.splitlines() if "cli/  " in line and "`dexctl` command:" in line
    )
    known = [entry for entry in commands().values() if entry.target.startswith("dexctl.cli.")]
    none([*wrong, *(f"dexctl {entry.name}" for entry in known if entry.name not in line)])


def test_environments_know_nothing_of_who_learns_in_them() -> None:
    none(
        f"{name(path)} imports {dotted}"
        for path in sorted((ROOT / "learning" / "envs").glob("*.py"))
        for dotted in sorted(imports(path))
        if room(dotted) == "learning" and not dotted.startswith("learning.envs.")
    )


def test_modules_say_what_they_are() -> None:
    none(name(path) for path in FILES if not ast.get_docstring(ast.parse(path.read_text())))


def test_modules_are_small() -> None:
    lines = [len(path.read_text().splitlines()) for path in FILES if path.name != "__init__.py"]
    assert median(lines) <= 160
