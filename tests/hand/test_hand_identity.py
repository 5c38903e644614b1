"""The digest of a hand's files: what changes it and what does not."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from dexctl import HandModel
from dexctl.description.files import files_of
from dexctl.hands.identity import identity

MJCF = """<mujoco><compiler meshdir="meshes"/>
<asset><mesh name="m" file="tip.obj"/></asset>
<worldbody><body name="palm"><geom size="0.01"/><include file="finger.xml"/></body></worldbody>
</mujoco>"""
FINGER = """<mujocoinclude><body name="tip"><joint name="j" axis="0 1 0"/>
<geom type="mesh" mesh="m"/></body></mujocoinclude>"""
MESH = "v 0 0 0\nv 0.01 0 0\nv 0 0.02 0\nv 0 0 0.03\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
TOML = 'description = "hand.xml"\n[fingertips]\ntip = [0, 0, 0.03]\n'


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "meshes").mkdir()
    for name, text in (
        ("hand.xml", MJCF), ("finger.xml", FINGER), ("meshes/tip.obj", MESH), ("mine.toml", TOML),
    ):  # fmt: skip
        (tmp_path / name).write_text(text)
    return tmp_path


def digest(folder: Path, name: str = "mine.toml") -> str:
    return HandModel.load(folder / name).digest


def test_all_files_of_a_hand(folder: Path) -> None:
    found = files_of(folder / "hand.xml")
    assert [file.name for file in found] == ["hand.xml", "finger.xml", "tip.obj"]


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        ("hand.xml", "0.01", "0.02"),
        ("finger.xml", "0 1 0", "1 0 0"),
        ("meshes/tip.obj", "v 0 0 0.03", "v 0 0 0.04"),
        ("mine.toml", "[0, 0, 0.03]", "[0, 0, 0.02]"),
        ("mine.toml", "[fingertips]", "[servos]\nstiffness = 3\n[fingertips]"),
    ],
)
def test_what_changes_the_digest(folder: Path, file: str, old: str, new: str) -> None:
    before = digest(folder)
    path = folder / file
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    assert digest(folder) != before


def test_names_places_comments_and_objects_do_not(folder: Path, tmp_path: Path) -> None:
    before = digest(folder)
    path = folder / "mine.toml"
    path.write_text("# a comment\n" + path.read_text())
    path.rename(folder / "other.toml")
    with (folder / "other.toml").open("a") as stream:
        stream.write("\n[object]\ntravel = 0.6\nmass = 0.05\n[object.sizes]\ncube = 0.05\n")
    moved = folder.rename(folder.with_name("moved"))
    assert digest(moved, "other.toml") == before


def test_what_a_card_says(folder: Path) -> None:
    hand = HandModel.load(folder / "mine.toml")
    said = identity(hand)
    assert said["name"] == "mine" and said["toml"] == str(folder / "mine.toml")
    assert said["description"] == str(folder / "hand.xml")
    assert said["sha256"] == hand.digest and len(hand.digest) == 64


@pytest.mark.parametrize("name", ["dex5", "leap_hand", "wonik_allegro", "shadow_hand"])
def test_files_of_the_package_are_told_by_their_names(
    name: str, hand_of: Callable[[str], HandModel]
) -> None:
    said = identity(hand_of(name))
    assert said["toml"] == f"{name}.toml"
    assert said["description"] in ("dex5.xml", f"menagerie:{name}/right_hand.xml")
