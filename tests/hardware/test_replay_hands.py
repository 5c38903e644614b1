"""Which hand a log is of: replayed and identified as that one, wherever the log is read."""

from __future__ import annotations

import shutil
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

import dexctl
from dexctl.cli import commands, main
from hardware.cli import run as commands_run
from hardware.cli.run import LOG
from hardware.log import LogWriter, hand_of, read_log

pytest.importorskip("dynamixel_sdk", reason="needs the extra 'hardware'")
pytest.importorskip("mcap", reason="needs the extra 'hardware'")
FILE = Path(__file__).resolve().parents[1] / "hands" / "four_fingers.xml"
TICKS = 30


@pytest.fixture(autouse=True)
def group(monkeypatch: pytest.MonkeyPatch) -> None:
    point = EntryPoint("hardware", "hardware.cli:COMMANDS", commands.GROUP)
    monkeypatch.setattr(commands, "entry_points", lambda group: [point])


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    """A hand of the user's with four fingers."""
    shutil.copy(FILE, tmp_path / "mine.xml")
    tips = "\n".join(f"{name} = [0.0, 0.0, 0.0267]" for name in ("ff_tip", "mf_tip", "rf_tip"))
    path = tmp_path / "mine.toml"
    path.write_text(f"description = 'mine.xml'\n[fingertips]\n{tips}\nth_tip = [0, 0, 0.0267]\n")
    return path


def write_log(path: Path, hand: dexctl.HandModel, **said: object) -> Path:
    """Half a second of a hand that stands still in the middle of its range."""
    q = 0.5 * (hand.lower + hand.upper)
    with LogWriter(path) as log:
        log.write("/run", {
            "joints": list(hand.joint_names),
            "limits": {"speed_limit": 0.6, "torque_limit": 0.5}, **said,
        })  # fmt: skip
        for i in range(TICKS):
            log.write("/tick", {
                "time": 0.02 * i, "state": "run", "q": q, "q_target": q, "velocity": 0 * q,
                "torque": 0 * q, "fresh": np.ones(hand.nq, bool), "age": 0.0, "lateness": 0.0,
                "in_contact": [False] * hand.n_fingers, "contact_force": [0.0] * hand.n_fingers,
            })  # fmt: skip
    return path


def test_a_log_is_replayed_on_its_own_hand(mine: Path, tmp_path: Path) -> None:
    model = dexctl.hands.load(str(mine))
    path = write_log(tmp_path / "a.mcap", model, scene={"hand": str(mine)})
    out = tmp_path / "out"
    # a busy machine may hold the hand: 1
    words = ["replay", str(path), "--out", str(out), "--patience", "10"]
    assert main(["hardware", *words]) in (0, 1)
    again = read_log(out / LOG)
    assert again.run["joints"] == list(model.joint_names)
    assert again.run["rate_hz"] == pytest.approx(50.0)
    assert hand_of(again) == str(mine)  # so that it can be identified and replayed in turn
    assert again.run["scene"]["object"] == ["none"]


@pytest.mark.parametrize("asked", [None, "dex5"])
def test_a_log_of_another_hand_is_refused(
    asked: str | None, mine: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = dexctl.hands.load(str(mine))
    of = write_log(tmp_path / "a.mcap", model, scene={"hand": str(mine) if asked else "dex5"})
    words = ["replay", str(of), "--out", str(tmp_path / "out")]
    assert main(["hardware", *words, *(["--hand", asked] if asked else [])]) == 2
    said = capsys.readouterr().err
    assert "has 16 joints, and dex5 has 15; expected --hand with the hand of the log" in said


def test_joints_in_another_order_are_refused(
    mine: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = dexctl.hands.load(str(mine))
    names = [model.joint_names[1], model.joint_names[0], *model.joint_names[2:]]
    path = write_log(tmp_path / "a.mcap", model, scene={"hand": str(mine)}, joints=names)
    assert main(["hardware", "replay", str(path), "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert f"joint 1 of {path} is ffj1, and that of mine is ffj0; expected --hand" in said


def test_a_log_that_names_no_hand(
    mine: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_log(tmp_path / "a.mcap", dexctl.hands.load(str(mine)))
    assert main(["hardware", "replay", str(path), "--out", str(tmp_path / "out")]) == 2
    assert "a.mcap does not say which hand it is of; expected --hand" in capsys.readouterr().err


def test_what_a_log_does_not_say(
    dex5: dexctl.HandModel, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_log(tmp_path / "a.mcap", dex5, limits={"torque_limit": 0.5})
    words = ["hardware", "replay", str(path), "--hand", "dex5", "--out", str(tmp_path / "out")]
    assert main(words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith("a.mcap holds no speed_limit of its run; the log is damaged")
    assert not (tmp_path / "out").exists()
    page = ["hardware", "report", str(path), "--out"]
    assert main([*page, str(tmp_path)]) == 2
    assert "cannot write there: Is a directory" in capsys.readouterr().err


def test_a_log_with_a_hand_file_is_read_from_any_folder(
    mine: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(mine.parent)
    out = tmp_path / "out"

    class Runs(Exception):
        """In place of a run: what is logged first is there by then."""

    def runner(*given: object, **named: object) -> None:
        raise Runs

    monkeypatch.setattr(commands_run, "Runner", runner)
    with pytest.raises(Runs):
        main(["hardware", "run", "sine", "--emulate", "--hand", "mine.toml", "--out", str(out)])
    monkeypatch.chdir("/")
    log = read_log(out / LOG)
    assert log.run["scene"]["hand"] == str(mine)
    assert dexctl.hands.load(hand_of(log)).nq == 16


def test_an_older_log_with_a_relative_file(
    mine: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = dexctl.hands.load(str(mine))
    path = write_log(
        tmp_path / "a.mcap", model, scene={"hand": "mine.toml"}, hand_files={"toml": str(mine)}
    )
    monkeypatch.chdir("/")
    assert hand_of(read_log(path)) == str(mine)
    assert hand_of(read_log(path), "dex5") == "dex5"
