"""Run folders: what they hold, who works in them, and what is said of files that are no use."""

from __future__ import annotations

import csv
import json
import math
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

import dexctl
from dexctl.exceptions import InvalidInput
from dexctl.sim import SceneConfig
from learning.training.checkpoint import CheckpointError
from learning.training.log import RunLog
from learning.training.run_folder import RunFolder

ROOT = Path(__file__).parents[3]


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    """The folder of a run that has just begun."""
    folder = RunFolder(tmp_path / "runs" / "one")
    folder.create({"steps": 100})
    return folder


def test_a_new_one(tmp_path: Path) -> None:
    run = RunFolder(tmp_path / "runs" / "one")
    assert not RunFolder.is_run(run.path) and not run.path.exists()
    assert run.progress() == [] and run.read_checkpoint() is None
    run.create({"steps": 100, "env": {"object": ["cube"]}})
    assert RunFolder.is_run(run.path)
    assert run.config_values() == {"steps": 100, "env": {"object": ["cube"]}}
    assert [path.name for path in run.path.iterdir()] == ["config.json"]
    with pytest.raises(InvalidInput, match="holds a run already"):
        run.create({"steps": 100})
    (tmp_path / "file").touch()
    with pytest.raises(InvalidInput, match="cannot make the folder"):
        RunFolder(tmp_path / "file" / "one").create({})


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, r"there is no run in .*one: no config\.json"),
        (b"{", r"config\.json is not JSON: "),
        (b'{"a": "\xff"}', r"config\.json is not UTF-8: byte 7"),
        (b"[1]", r"config\.json is not a JSON object: it is list"),
        (b"[" * 100_000, r"config\.json is nested too deeply"),
    ],
)
def test_configurations_that_are_none(run: RunFolder, content: bytes | None, said: str) -> None:
    if content is None:
        run.config_path.unlink()
    else:
        run.config_path.write_bytes(content)
    with pytest.raises(InvalidInput, match=said) as caught:
        run.config_values()
    assert "\n" not in str(caught.value)


def test_checkpoints(run: RunFolder) -> None:
    run.write_checkpoint({"steps": 3})
    assert run.read_checkpoint() == {"steps": 3}
    assert run.checkpoint_path.exists()
    run.checkpoint_path.write_bytes(pickle.dumps({"steps": 3}))
    with pytest.raises(CheckpointError, match=r"one.checkpoint\.bin: it is no checkpoint"):
        run.read_checkpoint()
    run.checkpoint_path.rename(run.path / "checkpoint.pt")
    with pytest.raises(CheckpointError, match=r"checkpoint\.pt is of an earlier version, which"):
        run.read_checkpoint()


def test_one_process_at_a_time(run: RunFolder) -> None:
    code = (
        "import sys; from pathlib import Path; from learning.training.run_folder import RunFolder\n"
        "with RunFolder(Path(sys.argv[1])).lock():\n print('held', flush=True); input()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, str(run.path)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    ) as other:  # fmt: skip
        assert other.stdout is not None
        assert other.stdout.readline() == b"held\n"
        with (
            pytest.raises(InvalidInput, match=f"another process is at work in {run.path}"),
            run.lock(wait=0.2),
        ):
            pass
        other.kill()
        with run.lock(wait=60):  # its lock has gone with it
            pass


def test_what_killed_runs_leave_is_removed(run: RunFolder) -> None:
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    of_gone, of_living, of_us = (
        run.path / f".checkpoint.{number}.part.bin" for number in (gone.pid, 1, os.getpid())
    )
    others = run.path / ".notes.12.txt", run.path / "checkpoint.12.part.bin"
    for path in (of_gone, of_living, of_us, *others):
        path.touch()
    run.clean()
    assert not of_gone.exists() and of_living.exists() and of_us.exists()
    with run.lock():  # nobody else is at work here, whatever the numbers of processes are
        run.clean()
    assert not of_living.exists() and not of_us.exists()
    assert run.config_path.exists() and all(path.exists() for path in others)
    RunFolder(run.path / "none").clean()


def test_progress(run: RunFolder) -> None:
    run.progress_path.write_text("step,return,seconds\n10,,1.5\n20,-3,2.5\n30,4,\n40,5,3")
    first, second = run.progress()  # the last two were cut short
    assert second == {"step": 20.0, "return": -3.0, "seconds": 2.5}
    assert math.isnan(first.pop("return")) and first == {"step": 10.0, "seconds": 1.5}
    run.progress_path.write_text("")
    assert run.progress() == []


def resume(run: RunFolder) -> None:
    RunLog(run.progress_path, run.tensorboard_path, resume_at=10)


@pytest.mark.parametrize("use", [RunFolder.progress, resume])
@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"step,return,seconds\n10,\xff,1\n", "byte 23 is not UTF-8"),
        (b"step,return,seconds\n10,much,1\n", "could not convert string to float: 'much'"),
        (b"step,return,seconds\n,2,1\n", "could not convert"),
        (b"step,return,seconds\n10,2,1,5\n", "the row of step 10 has more columns"),
        (b"return,seconds\n10,2\n", "no column step"),
        (b'step,seconds\n10,"' + b"1" * 200_000 + b'"\n', "field larger than"),
    ],
)
def test_progress_that_is_none(
    run: RunFolder, content: bytes, said: str, use: Callable[[RunFolder], None]
) -> None:
    run.progress_path.write_bytes(content)
    with pytest.raises(InvalidInput, match=rf"progress\.csv is not a training log: .*{said}") as it:
        use(run)
    assert "\n" not in str(it.value)
    assert run.progress_path.read_bytes() == content


def test_a_resumed_log_forgets_what_came_after_the_checkpoint(run: RunFolder) -> None:
    log = RunLog(run.progress_path, run.tensorboard_path)
    for step in (10, 20, 30):
        log.write({"step": step, "return": step / 3, "seconds": 1.0})
    log.close()
    with run.progress_path.open("a") as file:
        file.write("40,1,2")  # a row that a kill cut short
    RunLog(run.progress_path, run.tensorboard_path, resume_at=20).close()
    with run.progress_path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["step"], row["return"]) for row in rows] == [("10", "3.33333"), ("20", "6.66667")]


def test_the_hand_of_a_run_may_not_change(run: RunFolder, tmp_path: Path) -> None:
    known = dexctl.hands.load("dex5")
    path = tmp_path / "mine.xml"
    path.write_text(known.path.read_text())
    scene = SceneConfig()
    run.note_hand(replace(known.config, description=path).build(), scene)
    run.note_hand(replace(known.config, description=path, name="renamed").build(), scene)
    path.write_text(known.path.read_text().replace("0.014", "0.015"))
    with pytest.raises(InvalidInput, match="files of the hand mine have changed since the run"):
        run.note_hand(replace(known.config, description=path, name="mine").build(), scene)
    run.hand_path.write_text("{")
    with pytest.raises(InvalidInput, match=r"cannot read .*hand\.json"):
        run.note_hand(known, scene)


def test_the_objects_of_a_run_stay_as_wide(run: RunFolder) -> None:
    """A run went on with another width in the hand's toml, without a word."""
    known = dexctl.hands.load("dex5").config

    def hand(width: float) -> dexctl.HandModel:
        return replace(known, object=replace(known.object, sizes={"cube": width})).build()

    scene = SceneConfig(object=("cube", "sphere"))
    run.note_hand(hand(0.09), scene)
    run.note_hand(hand(0.09), scene)
    assert run.hand_widths() == {"cube": 0.09, "sphere": known.object.size}
    with pytest.raises(InvalidInput, match="dex5 now holds a cube of 0.08 m; expected 0.09 m, as"):
        run.note_hand(hand(0.08), scene)
    run.note_hand(hand(0.08), replace(scene, object_size=0.09))  # the run says it itself
    run.note_hand(hand(0.08), replace(scene, object=("sphere",)))
    unknown = replace(known, object=replace(known.object, size=None)).build()
    nowhere = RunFolder(run.path / "unknown")
    nowhere.path.mkdir()
    for _ in range(2):  # what is not known is not kept
        nowhere.note_hand(unknown, scene)
    assert nowhere.hand_widths() == {}
    kept = json.loads(run.hand_path.read_text())
    for wrong in ("none", {"cube": "wide"}):
        run.hand_path.write_text(json.dumps(kept | {"widths": wrong}))
        with pytest.raises(InvalidInput, match=r"cannot read .*hand\.json"):
            run.note_hand(hand(0.09), scene)
    kept.pop("widths")  # as in folders of earlier versions
    run.hand_path.write_text(json.dumps(kept))
    run.note_hand(hand(0.08), scene)
