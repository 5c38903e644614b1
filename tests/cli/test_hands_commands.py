"""`dexctl hands add` and `dexctl hands check`: what they write, say and refuse."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import dexctl
from dexctl.cli import main
from dexctl.cli.hand_checks import check_hand
from dexctl.cli.hands_add import Add
from dexctl.exceptions import SimulationError
from dexctl.hand_config import HandConfig, HeldObject
from dexctl.sim.offscreen import opengl_backend

RING = Path(__file__).resolve().parents[1] / "hands" / "ring.urdf"
try:
    opengl_backend()
    PICTURES = 4  # of the hand by itself
except SimulationError:
    PICTURES = 0


def test_add_without_a_grasp(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["hands", "add", str(RING), "--out", "mine.toml", "--no-grasp", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["fingertips"] == [f"f{i}_tip" for i in range(1, 6)]
    assert found["unlimited"] == ""
    # the hand by itself, stretched and open, from two sides
    drawn = [Path(one) for one in found["pictures"] if one.endswith(".png")]
    assert len(drawn) == PICTURES
    assert all("the_hand" in one.name and one.is_file() for one in drawn)
    config = HandConfig.read("mine.toml")
    assert config.object.mass == 0.1 and "mass = 0.1" in Path("mine.toml").read_text()
    assert config.palm.axis == (1.0, 0.0, 0.0) and config.name == "mine"
    assert "# Proposed by `dexctl hands add ring.urdf`" in Path("mine.toml").read_text()
    # the hand in its own frame is dex5, but for the tips, which stand for another point
    hand = dexctl.HandModel.load("mine.toml")
    tips = hand.fingertip_positions(np.zeros(15))
    assert tips[:, 2].min() > 0.15 and np.ptp(tips[:, 2]) < 1e-3


def test_limits_that_the_file_does_not_say_are_asked_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, toml = tmp_path / "ring.urdf", tmp_path / "mine.toml"
    file.write_text(re.sub(r' (effort|velocity)="[^"]*"', "", RING.read_text()))
    assert main(["hands", "add", str(file), "--out", str(toml), "--no-grasp", "--json"]) == 0
    out, err = capsys.readouterr()
    said = "The file has no torque limit: any joint; no speed limit: any joint. What motors can do"
    assert json.loads(out)["unlimited"].startswith(said) and said in " ".join(err.split())
    assert said in " ".join(toml.read_text().replace("#", " ").split())


@pytest.mark.parametrize("words", ["--no-grasp", ""])
def test_gains_are_written_where_there_is_no_grasp(
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """They were written with the grasp that was found, and not without one."""

    def nothing(*_: object, **__: object) -> None:
        raise SimulationError("nothing holds")

    monkeypatch.setattr("dexctl.cli.hands_add.suggestions", nothing)
    toml = tmp_path / "mine.toml"
    told = ["hands", "add", str(RING), "--out", str(toml), "--json", *words.split()]
    assert main(told) == (0 if words else 1)
    out, err = capsys.readouterr()
    found, config = json.loads(out), HandConfig.read(toml)
    assert isinstance(config.servos.stiffness, dict) and len(config.servos.stiffness) == 15
    assert isinstance(config.servos.damping, dict) and min(config.servos.damping.values()) > 0
    assert any("position servos added" in note for note in found["notes"])
    assert "position servos added" in " ".join(err.split())
    assert "# The file has no position servos" in toml.read_text()
    assert ("no grasp: nothing holds" in err) == (not words)


def test_what_the_simulator_mends_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also of a hand that has its servos: it was said of none but those that got some."""
    text = dexctl.hands.load("dex5").path.read_text()
    toy = '<body name="toy"><freejoint/><geom size="0.02"/></body></worldbody>'
    file, toml = tmp_path / "with_a_toy.xml", tmp_path / "mine.toml"
    file.write_text(text.replace("</worldbody>", toy))
    told = ["hands", "add", str(file), "--out", str(toml), "--no-grasp", "--json"]
    assert main([*told, "--fingertips", *dexctl.hands.load("dex5").fingertip_names]) == 0
    out, err = capsys.readouterr()
    said = "loose bodies of the file left out: toy"
    assert json.loads(out)["notes"] == [said] and said in err
    assert f"The simulator says: {said}." in " ".join(toml.read_text().replace("#", " ").split())


def test_a_fingertip_whose_mesh_is_missing_is_not_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The link before it was taken for the fingertip, and the toml said so."""
    text = RING.read_text()
    tip = text.index('<link name="f2_tip"')
    end = text.index("</link>", tip)
    lost = re.sub(
        r"<geometry>.*?</geometry>", '<geometry><mesh filename="package://none/tip.stl"/></geometry>',
        text[tip:end], flags=re.S,
    )  # fmt: skip
    file, toml = tmp_path / "ring.urdf", tmp_path / "mine.toml"
    file.write_text(text[:tip] + lost + text[end:])
    assert main(["hands", "add", str(file), "--out", str(toml), "--no-grasp"]) == 1
    said = capsys.readouterr().err
    assert "link 'f2_tip': no mesh 'package://none/tip.stl' that can be read" in said
    assert said.count("\n") == 1 and not toml.exists()
    # what is only drawn may be missing where the link has a shape to touch with
    drawn = '<visual><geometry><mesh filename="package://none/nail.dae"/></geometry></visual>'
    file.write_text(text[:tip] + text[tip:end] + drawn + text[end:])
    assert main(["hands", "add", str(file), "--out", str(toml), "--no-grasp", "--json"]) == 0
    assert "f2_tip" in json.loads(capsys.readouterr().out)["fingertips"]


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        ("none.urdf", 1, "none.urdf: no such file"),
        ("there.toml --out new.toml", 1, "there.toml: a toml; expected the MJCF or URDF file of a"),
        (". --out new.toml", 1, ".: a folder; expected an MJCF or URDF file"),
        ("RING --out here.txt", 2, "--out is 'here.txt'; expected the name of a .toml"),
        ("RING --out there.toml", 2, "there.toml is there already; give another --out, or --repl"),
        ("RING --object anvil", 2, "unknown object 'anvil'"),
        ("RING --object mesh", 2, "unknown object 'mesh'; known: cube"),
        ("RING --object-size -1", 2, "--object-size is -1"),
        ("RING --object-mass 0", 2, "--object-mass is 0.0; expected kilograms above 0"),
        ("RING --base arm", 2, "unknown body 'arm'; known: mount, palm"),
        ("RING --seed -1", 2, "seed is -1; expected a whole number from 0 on"),
    ],
)
def test_what_add_refuses(
    words: str,
    code: int,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("there.toml").write_text("mine")
    assert main(["hands", "add", *words.replace("RING", str(RING)).split()]) == code
    lines = capsys.readouterr().err.splitlines()
    assert said in lines[-1]
    assert Path("there.toml").read_text() == "mine"
    assert not Path("ring.toml").exists()


def test_add_that_is_interrupted_leaves_no_toml_and_an_earlier_one_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Add, "_with_grasp", interrupted)
    monkeypatch.chdir(tmp_path)
    Path("there.toml").write_text("mine")
    assert main(["hands", "add", str(RING), "--out", "mine.toml"]) == 130
    assert main(["hands", "add", str(RING), "--out", "there.toml", "--replace"]) == 130
    assert capsys.readouterr().err.splitlines()[-1] == "dexctl: interrupted"
    assert [one.name for one in tmp_path.iterdir()] == ["there.toml"]
    assert Path("there.toml").read_text() == "mine"


def test_check_by_name(capsys: pytest.CaptureFixture[str]) -> None:
    words = "hands check dex5 --object sphere --seconds 1 --trials 2 --json"
    assert main(words.split()) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["sha256"] == dexctl.hands.load("dex5").digest
    assert {one["name"]: one["good"] for one in found["checks"]} == {
        "joint limits": True, "Jacobians": True, "simulator": True, "fingertips": True,
        "touch geometry": True, "reach": True, "holds, palm up": True, "holds, palm down": True,
    }  # fmt: skip


def test_checks_that_fail(dex5: dexctl.HandModel, capsys: pytest.CaptureFixture[str]) -> None:
    far = dict.fromkeys(dex5.fingertip_names, (0.0, 0.0, 0.1))
    away = replace(dex5.config, fingertips=far).build()
    found = {one.name: one for one in check_hand(away, seconds=0.1, trials=1)}
    assert not found["touch geometry"].good
    assert "f1_tip by" in found["touch geometry"].said
    held = HeldObject(centre=(0.0, 0.0, 0.6), size=0.1)
    high = replace(dex5.config, object=held).build()
    found = {one.name: one for one in check_hand(high, seconds=0.1, trials=1)}
    assert not found["reach"].good and "f1_tip by" in found["reach"].said
    assert not found["holds, palm up"].good
    assert main(["hands", "check", "nobody"]) == 2
    assert "unknown hand 'nobody'; known: dex5" in capsys.readouterr().err
    assert main(["hands", "check", "dex5", "--seed", "-1"]) == 2
    assert "seed is -1; expected a whole number from 0 on" in capsys.readouterr().err


def test_the_list_still_has_its_own_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["hands", "list", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    assert main(["hands", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == listed


def test_joints_of_a_urdf_are_counted(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ring = HandConfig(description=RING, fingertips={"f1_tip": (0.0, 0.0, 0.0)})
    monkeypatch.setattr("dexctl.hands.names", lambda: ("ring",))
    monkeypatch.setattr("dexctl.hands.config", lambda name: ring)
    assert main(["hands", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["hands"]["ring"]["joints"] == 15
    assert main(["hands"]) == 0
    assert "joints in file" in capsys.readouterr().out
    away = HandConfig(description=Path("menagerie:a/b.xml"), fingertips=ring.fingertips)
    monkeypatch.setenv("DEXCTL_MENAGERIE", "nowhere")
    monkeypatch.setattr("dexctl.hands.config", lambda name: away)
    assert main(["hands"]) == 0
    listed = capsys.readouterr().out
    assert "not downloaded" in listed and "?" not in listed


def test_where_no_place_is_found_the_hand_is_drawn_and_each_fingertip_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    words = f"hands add {RING} --object cube --object-size 5 --turning.grasps 0 --json"
    assert main(words.split()) == 1
    found = json.loads(capsys.readouterr().out)
    assert sum(one.endswith(".png") for one in found["pictures"]) == PICTURES
    assert all(f"f{i}_tip " in found["failure"] for i in range(1, 6))
    assert "the palm " in found["failure"] and "smaller object_size" in found["failure"]
