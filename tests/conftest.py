"""Fixtures and settings that all tests share."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Sequence
from functools import cache
from importlib.metadata import EntryPoint

# One thread a process for linear algebra, set before numpy is loaded: the matrices are small, and
# pytest-xdist already keeps the cores busy.
os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"

from pathlib import Path
from typing import TYPE_CHECKING

import hypothesis
import numpy as np
import pytest

import dexctl
from dexctl.controllers import GROUP, POLICIES, table

if TYPE_CHECKING:
    from dexctl.sim import GraspStates

FOUR_FINGERS = Path(__file__).resolve().parent / "hands" / "four_fingers.xml"

# The same examples on every run, and no time limit: a busy machine must not fail a test.
hypothesis.settings.register_profile(
    "dexctl", derandomize=True, deadline=None, database=None, max_examples=50
)
hypothesis.settings.load_profile("dexctl")


@pytest.fixture(scope="session")
def dex5() -> dexctl.HandModel:
    """The built-in hand."""
    return dexctl.hands.load("dex5")


@pytest.fixture(scope="session")
def at_rest() -> Callable[[dexctl.HandModel, dexctl.GraspState, Sequence[str]], GraspStates]:
    """Makes grasp states of a hand's state ``(S,)``, with the name of each one's object."""
    from dexctl.sim import GraspStates

    def made(
        hand: dexctl.HandModel, state: dexctl.GraspState, objects: Sequence[str]
    ) -> GraspStates:
        assert state.object_position is not None
        assert state.object_quaternion is not None
        return GraspStates(
            hand=hand.name,
            q=state.q,
            q_target=state.q_target,
            object_position=state.object_position,
            object_quaternion=state.object_quaternion,
            object=np.array(objects),
            joint_names=np.array(hand.joint_names),
        )

    return made


@pytest.fixture
def registered(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Has only these entry points be the controllers that packages have registered."""

    def register(*points: EntryPoint) -> None:
        monkeypatch.setattr(table, "entry_points", lambda group: points)
        monkeypatch.setattr(table, "known_entries", cache(table.known_entries.__wrapped__))

    return register


@pytest.fixture
def learned(registered: Callable[..., None]) -> None:
    """The name of the policies, known without an installation too."""
    registered(EntryPoint(POLICIES, "learning.policies:learned", GROUP))


@pytest.fixture(scope="session")
def menagerie(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder like the menagerie's, with our own hand of four fingers in the Allegro's place."""
    folder = tmp_path_factory.mktemp("menagerie")
    (folder / "wonik_allegro").mkdir()
    shutil.copy(FOUR_FINGERS, folder / "wonik_allegro" / "right_hand.xml")
    return folder


@pytest.fixture(scope="session")
def four_fingers(menagerie: Path) -> dexctl.HandModel:
    """Our own hand of four fingers with four joints each; see ``tests/hands``."""
    return dexctl.hands.load("wonik_allegro", folder=menagerie)


def of_menagerie(name: str) -> dexctl.HandModel:
    """A hand of the menagerie; skips where its files are not here.

    They come from the folder DEXCTL_MENAGERIE, else from what the package mujoco-menagerie has got
    before: no test downloads anything.
    """
    if not os.environ.get("DEXCTL_MENAGERIE"):
        package = pytest.importorskip("mujoco_menagerie", reason="no mujoco-menagerie installed")
        cache = package.Cache()
        if cache.root is None and not cache.is_cached(package.get(name)):
            pytest.skip(f"mujoco-menagerie has not downloaded {name} yet")
    try:
        return dexctl.hands.load(name)
    except dexctl.HandModelError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="session")
def allegro() -> dexctl.HandModel:
    """The menagerie's Allegro hand, for what is true of that hand only."""
    return of_menagerie("wonik_allegro")


@pytest.fixture(scope="session")
def hand_of() -> Callable[[str], dexctl.HandModel]:
    """Loads a hand by name; skips where its files are not here."""
    return lambda name: dexctl.hands.load(name) if name == "dex5" else of_menagerie(name)
