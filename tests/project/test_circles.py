"""No two modules import each other, not even by way of others or for type checkers only."""

from __future__ import annotations

import ast
from collections.abc import Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("dexctl", "learning", "hardware")
ONE_MATTER = [
    # a scene finds its own settled grasp, and where nobody says it, the place of that; the
    # searches for them need nothing but the scene
    {"dexctl.sim.scene", "dexctl.sim.settle", "dexctl.sim.suggest"},
    # a hand's configuration builds the hand, which knows it, and is loaded by its name
    {
        "dexctl.hand",
        "dexctl.hand_config",
        "dexctl.hands.registry",
        "dexctl.hands.proposals",  # for a bare file
        "dexctl.hands.identity",  # the hand's digest, over its configuration
    },
]


def dotted(path: Path, root: Path) -> str:
    parts = path.relative_to(root).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports(root: Path, packages: tuple[str, ...]) -> dict[str, set[str]]:
    """Each module of the packages with those of them that it imports, anywhere in its text."""
    files = {dotted(path, root): path for one in packages for path in (root / one).rglob("*.py")}
    found: dict[str, set[str]] = {}
    for name, path in files.items():
        names: set[str] = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                names |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                whole = [f"{node.module}.{alias.name}" for alias in node.names]
                # a submodule, or a name out of the module itself
                names |= {one if one in files else str(node.module) for one in whole}
        found[name] = (names & files.keys()) - {name}
    return found


def circles(graph: Mapping[str, set[str]]) -> list[set[str]]:
    """Sets of modules that each lead to all others of the set."""
    reach = {name: set(nexts) for name, nexts in graph.items()}
    for middle in reach:
        for name in reach:
            if middle in reach[name]:
                reach[name] |= reach[middle]
    found: list[set[str]] = []
    for name in reach:
        circle = {other for other in reach[name] if name in reach[other]}
        if circle and circle not in found:
            found.append(circle)
    return found


def test_there_are_no_circles() -> None:
    assert [one for one in circles(imports(ROOT, PACKAGES)) if one not in ONE_MATTER] == []


def test_a_circle_is_found(tmp_path: Path) -> None:
    (tmp_path / "p" / "room").mkdir(parents=True)
    for name, text in {
        "p/__init__.py": "",
        "p/a.py": "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from p import b",
        "p/b.py": "def f():\n    import p.room.c",
        "p/room/__init__.py": "from p.room import c",
        "p/room/c.py": "from p.a import Thing",
        "p/d.py": "from p import a, room\nimport p.d",
    }.items():
        (tmp_path / name).write_text(text)
    assert circles(imports(tmp_path, ("p",))) == [{"p.a", "p.b", "p.room.c"}]
