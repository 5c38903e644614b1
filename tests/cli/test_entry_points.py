"""Commands that other packages add: listed without being loaded, loaded when run."""

from __future__ import annotations

import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from dexctl.cli import commands, main

MODULE = '''"""Drive the hand."""
from dataclasses import dataclass

import sys
sys.modules["loaded_by_the_plug_in"] = sys

@dataclass
class Train:
    """Train a policy.

    More about it.
    """

    steps: int = 10
    """How many."""

    def run(self):
        print(f"training for {self.steps} steps")

@dataclass
class Fails:
    """Never works."""
    def run(self):
        return 1

COMMANDS = {"train": Train, "fails": Fails}
'''


@pytest.fixture(autouse=True)
def plug_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "some_plug_in"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "entry.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("loaded_by_the_plug_in", "some_plug_in", "some_plug_in.entry"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    points = [
        EntryPoint("train", "some_plug_in.entry:Train", commands.GROUP),
        EntryPoint("hardware", "some_plug_in.entry:COMMANDS", commands.GROUP),
        EntryPoint("demo", "some_plug_in.entry:Fails", commands.GROUP),
        EntryPoint("gone", "no_such_package:Gone", commands.GROUP),
    ]
    monkeypatch.setattr(commands, "entry_points", lambda group: points)


def test_they_are_listed_without_being_loaded(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    said = capsys.readouterr().out
    assert "train         Train a policy.\n" in said
    assert "hardware      Drive the hand.\n" in said
    assert "loaded_by_the_plug_in" not in sys.modules


def test_they_run(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", "--steps", "3"]) == 0
    assert main(["hardware", "train"]) == 0
    assert main(["hardware", "fails"]) == 1
    assert capsys.readouterr().out == "training for 3 steps\ntraining for 10 steps\n"


def test_groups_explain_themselves(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["hardware", "--help"]) == 0
    assert "fails         Never works." in capsys.readouterr().out
    assert main(["hardware", "fly"]) == 2
    assert "unknown dexctl hardware command 'fly'; known: train, fails" in capsys.readouterr().err


def test_own_commands_cannot_be_taken_over() -> None:
    assert commands.find("demo").target == "dexctl.cli.demo:Demo"


def test_a_command_whose_package_is_gone(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    capsys.readouterr()
    assert main(["gone"]) == 1
    assert "no_such_package" in capsys.readouterr().err
