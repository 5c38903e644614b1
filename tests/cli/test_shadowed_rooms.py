"""A package of somebody else's that has the name of one of ours, in real processes."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from dexctl.cli import commands

ROOT = Path(__file__).parents[2]

pytestmark = pytest.mark.skipif(
    "train" not in commands.commands(), reason="dexctl is not installed: no entry points"
)


@pytest.fixture(params=["folder", "file"])
def theirs(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """What shadows ours, in a folder of its own."""
    for name in ("learning", "hardware"):
        path = tmp_path / f"{name}.py"
        if request.param == "folder":
            (tmp_path / name).mkdir()
            path = tmp_path / name / "__init__.py"
        path.write_text('"""Theirs."""\nprint("theirs is loaded")\n')
    return tmp_path


@pytest.fixture(params=["PYTHONPATH", "working directory"])
def python(theirs: Path, request: pytest.FixtureRequest):
    """Runs Python where ``theirs`` is found before ours."""

    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        # without `site`, all that is searched is what stands here, in this order
        first = [theirs] if request.param == "PYTHONPATH" else []
        path = os.pathsep.join(map(str, [*first, ROOT, *filter(None, sys.path)]))
        (theirs / "elsewhere").mkdir(exist_ok=True)
        return subprocess.run(
            [sys.executable, "-S", *arguments],
            cwd=theirs / "elsewhere" if first else theirs,
            env={**os.environ, "PYTHONPATH": path},
            capture_output=True,
            text=True,
            check=False,
            timeout=120,
        )

    return run


def line(said: str, theirs: Path, room: str) -> None:
    """That ``said`` is one line, which names both places."""
    assert said.count("\n") == 1, said
    assert f"{theirs / room}" in said
    assert f"shadows dexctl's own package '{room}'" in said
    assert str(ROOT / room) in said


@pytest.mark.parametrize(
    ("arguments", "room"),
    [
        (["train", "--help"], "learning"),
        (["hardware", "--help"], "hardware"),
        (["rotate", "--controller", "learned", "--seconds", "0.1"], "learning"),
        (["rotate", "--controller", "dex5-cylinder", "--seconds", "0.1"], "learning"),
    ],
)
def test_commands_say_what_shadows_what(python, theirs: Path, arguments, room: str) -> None:
    done = python("-m", "dexctl", *arguments)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("dexctl: ")
    line(done.stderr, theirs, room)


def test_the_overview_is_ours(python) -> None:
    done = python("-m", "dexctl", "--help")
    assert done.returncode == 0, done.stderr
    for name in ("train", "hardware"):
        summary = commands.find(name).summary
        assert summary
        assert f"  {name:<13} {summary}\n" in done.stdout
    assert "theirs" not in done.stdout


def test_the_library_says_so_too(python, theirs: Path) -> None:
    code = (
        "import dexctl\n"
        "hand = dexctl.hands.load('dex5')\n"
        "for find in (dexctl.controllers.make, dexctl.controllers.resolve):\n"
        "    try: find('learned', hand)\n"
        "    except dexctl.DexctlError as error: print(error)\n"
    )
    done = python("-c", f"import dexctl.controllers\n{code}")
    assert done.returncode == 0, done.stderr
    for said in done.stdout.splitlines(keepends=True):
        line(said, theirs, "learning")
    assert done.stdout.count("\n") == 2
