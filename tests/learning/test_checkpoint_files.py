"""Checkpoint files: whole or not there, and one clear line where they cannot be used."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("torch")
pytest.importorskip("stable_baselines3")

import torch

from learning import checkpoint

ROOT = Path(__file__).parents[2]


def test_there_and_back(tmp_path: Path) -> None:
    checkpoint.write(tmp_path, {"a": torch.arange(3), "b": [1.5, "x"]})
    checkpoint.write(tmp_path, {"a": torch.arange(4), "b": [2.5, "y"]})
    found = checkpoint.read(tmp_path)
    assert found["a"].tolist() == [0, 1, 2, 3] and found["b"] == [2.5, "y"]
    assert [path.name for path in tmp_path.iterdir()] == [checkpoint.NAME]


def test_none(tmp_path: Path) -> None:
    with pytest.raises(checkpoint.CheckpointError, match="there is no checkpoint in"):
        checkpoint.read(tmp_path)


def test_one_that_was_cut_short_is_not_read_and_not_kept(tmp_path: Path) -> None:
    checkpoint.write(tmp_path, {"a": 1})
    whole = (tmp_path / checkpoint.NAME).read_bytes()
    (tmp_path / checkpoint.PARTIAL).write_bytes(whole[: len(whole) // 2])  # as a kill leaves it
    assert checkpoint.read(tmp_path)["a"] == 1
    checkpoint.write(tmp_path, {"a": 2})
    assert checkpoint.read(tmp_path)["a"] == 2
    assert not (tmp_path / checkpoint.PARTIAL).exists()


@pytest.mark.parametrize("damage", ["cut", "empty", "text"])
def test_damaged(tmp_path: Path, damage: str) -> None:
    path = checkpoint.write(tmp_path, {"a": torch.zeros(1000)})
    whole = path.read_bytes()
    path.write_bytes({"cut": whole[:-500], "empty": b"", "text": b"not a checkpoint"}[damage])
    with pytest.raises(checkpoint.CheckpointError, match="cannot read the checkpoint") as caught:
        checkpoint.read(tmp_path)
    assert "\n" not in str(caught.value)


def test_other_format(tmp_path: Path) -> None:
    torch.save({"format": 99}, tmp_path / checkpoint.NAME)
    with pytest.raises(checkpoint.CheckpointError, match="has format 99; this version reads"):
        checkpoint.read(tmp_path)


FULL = """
import resource, signal, sys, torch
from pathlib import Path
from learning import checkpoint
folder = Path(sys.argv[1])
checkpoint.write(folder, {"a": 1})
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
try:
    checkpoint.write(folder, {"a": torch.zeros(100_000)})
except checkpoint.CheckpointError as error:
    print(error)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="file size limits are of Unix")
def test_full_disk_in_mid_write_keeps_the_one_before(tmp_path: Path) -> None:
    """A limit on the file's size stops the writing as a full disk does."""
    done = subprocess.run(
        [sys.executable, "-c", FULL, str(tmp_path)],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=100,
        check=True,
    )
    (line,) = done.stdout.splitlines()
    assert line.startswith("cannot write")
    assert line.endswith(f"{os.strerror(errno.EFBIG)}; the one before is kept")
    assert checkpoint.read(tmp_path)["a"] == 1
    assert [path.name for path in tmp_path.iterdir()] == [checkpoint.NAME]
