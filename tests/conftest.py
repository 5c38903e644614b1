"""Fixtures and settings that all tests share."""

from __future__ import annotations

import os

# One thread a process for linear algebra, set before numpy is loaded: the matrices are small, and
# pytest-xdist already keeps the cores busy.
os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"

from pathlib import Path

import hypothesis
import pytest

import dexctl

ROOT = Path(__file__).resolve().parents[1]

# The same examples on every run, and no time limit: a busy machine must not fail a test.
hypothesis.settings.register_profile(
    "dexctl", derandomize=True, deadline=None, database=None, max_examples=50
)
hypothesis.settings.load_profile("dexctl")


def menagerie_folder() -> Path | None:
    """The folder that holds the MuJoCo menagerie's ``wonik_allegro``, if there is one."""
    chosen = os.environ.get("DEXCTL_MENAGERIE")
    folder = Path(chosen) if chosen else ROOT.parent / "shared" / "hands"
    return folder if (folder / "wonik_allegro" / "right_hand.xml").is_file() else None


@pytest.fixture(scope="session")
def menagerie() -> Path:
    """The menagerie folder; skips where there is none."""
    folder = menagerie_folder()
    if folder is None:
        pytest.skip("no wonik_allegro: set DEXCTL_MENAGERIE to a folder that holds it")
    return folder


@pytest.fixture(scope="session")
def dex5() -> dexctl.HandModel:
    """The built-in hand."""
    return dexctl.hands.load("dex5")


@pytest.fixture(scope="session")
def allegro(menagerie: Path) -> dexctl.HandModel:
    """The Allegro hand of the menagerie; skips where it is not to be had."""
    return dexctl.hands.load("wonik_allegro", folder=menagerie)
