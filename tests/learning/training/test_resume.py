"""A run that was killed and resumed equals the one that never was, bit by bit."""

from __future__ import annotations

import csv
import json
import os
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch")

from dexctl.cli.parsing import parse
from learning.cli.train import Train
from learning.training import checkpoint

ROOT = Path(__file__).parents[3]
OPTIONS = shlex.split(
    "--object cylinder --num-envs 6 --env.episode-steps 40 --seed 3 --log-every 60 "
    "--checkpoint-every 120 --device cpu --recipe thesis "
    + " ".join(
        f"--{name}.network 32 32 --{name}.batch-size 32 --{name}.learning-starts 60 "
        f"--{name}.buffer-size 240"
        for name in ("sac", "td3")
    )
    + " --ppo.network 32 --ppo.rollout-steps 10"
    + " --dagger.network 32 --dagger.batch-size 32 --dagger.buffer-size 240"
    + " --dagger.learning-rate-end none"
)
RUN = (
    "import sys; from dexctl.cli.parsing import parse; from learning.cli.train import Train; "
    "parse(Train, 'dexctl train', sys.argv[1:]).run()"
)


def run(*arguments: str) -> None:
    """`dexctl train` in this process."""
    command = parse(Train, "dexctl train", arguments)
    assert command is not None
    assert command.run() == 0


def start(*arguments: str) -> subprocess.Popen[bytes]:
    """`dexctl train` as a process of its own, installed or not."""
    return subprocess.Popen(
        [sys.executable, "-c", RUN, *arguments],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )


def numbers(folder: Path) -> list[dict[str, str]]:
    """The rows of the log, without the time that they took."""
    with (folder / "progress.csv").open(newline="") as file:
        return [
            {k: v for k, v in row.items() if "seconds" not in k} for row in csv.DictReader(file)
        ]


def same(a: Any, b: Any, where: str = "") -> None:
    """Everything in two checkpoints, to the bit."""
    import torch

    assert type(a) is type(b), where
    if isinstance(a, dict):
        assert a.keys() == b.keys(), where
        for key in a:
            if key not in ("seconds", "cpu_seconds", "config"):
                same(a[key], b[key], f"{where}/{key}")
    elif isinstance(a, list | tuple):
        assert len(a) == len(b), where
        for i, (x, y) in enumerate(zip(a, b, strict=True)):
            same(x, y, f"{where}/{i}")
    elif isinstance(a, torch.Tensor):
        assert torch.equal(a, b), where
    elif isinstance(a, np.ndarray):
        assert np.array_equal(a, b, equal_nan=True), where
    else:
        assert a == b, where


def equal_runs(first: Path, second: Path) -> None:
    a, b = checkpoint.read(first / "checkpoint.bin"), checkpoint.read(second / "checkpoint.bin")
    steps = a["algorithm"]["steps"]
    same(a, b)
    assert numbers(first) == numbers(second) != []
    with np.load(first / "policy.npz") as x, np.load(second / "policy.npz") as y:
        names = [name for name in x.files if name != "card"]
        assert all(np.array_equal(x[name], y[name]) for name in names)
    assert json.loads((second / "policy.json").read_text())["steps"] == steps


def test_killed_and_resumed_equals_uninterrupted(tmp_path: Path) -> None:
    options = [*OPTIONS, "--method", "vge+bc", "--controller", "gait", "igm"]
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    process = start(*options, "--steps", "1000000", "--out", str(killed))
    deadline = time.monotonic() + 100
    while not (killed / "checkpoint.bin").exists():
        assert process.poll() is None, process.communicate()[1].decode()
        assert time.monotonic() < deadline
        time.sleep(0.002)
    time.sleep(0.05)  # into the steps after the first checkpoint
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    steps = checkpoint.read(killed / "checkpoint.bin")["algorithm"]["steps"] + 180
    run("--resume", str(killed), "--steps", str(steps))
    run(*options, "--steps", str(steps), "--out", str(whole))
    equal_runs(whole, killed)


@pytest.mark.slow
def test_killed_and_resumed_with_the_fast_recipe(tmp_path: Path) -> None:
    """Returns of several steps, a mean of actors, a rate that falls with the steps, a history."""
    options = ["fast" if option == "thesis" else option for option in OPTIONS]
    options += ["--method", "vge+bc", "--controller", "coordinated", "--env.history", "1", "4"]
    options += ["--hard-stop", "700", "--sac.decay-start", "0.2", "--steps", "1200"]
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    process = start(*options, "--out", str(killed))
    deadline = time.monotonic() + 100
    while not (killed / "checkpoint.bin").exists():
        assert process.poll() is None, process.communicate()[1].decode()
        assert time.monotonic() < deadline
        time.sleep(0.002)
    time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert checkpoint.read(killed / "checkpoint.bin")["algorithm"]["steps"] < 1200
    run("--resume", str(killed))
    run(*options, "--out", str(whole))
    equal_runs(whole, killed)
    saved = checkpoint.read(whole / "checkpoint.bin")
    assert saved["algorithm"]["networks"]["averaged_actor"]
    (group,) = saved["algorithm"]["optimizers"]["actor"]["param_groups"]
    assert 1e-4 <= group["lr"] < 2e-4  # nearly fallen to its end


@pytest.mark.parametrize(
    ("algorithm", "method", "controller"),
    [
        ("sac", "rl", "gait"),
        pytest.param("td3", "rl+bc", "igm", marks=pytest.mark.slow),
        pytest.param("sac", "fge", "coordinated", marks=pytest.mark.slow),
        ("td3", "vge", "switch"),
        ("ppo", "rl", "gait"),
        ("dagger", "rl+bc", "coordinated"),
    ],
)
def test_stopped_half_way_equals_uninterrupted(
    tmp_path: Path, algorithm: str, method: str, controller: str
) -> None:
    options = [*OPTIONS, "--algorithm", algorithm, "--method", method, "--controller", controller]
    whole, halved = tmp_path / "whole", tmp_path / "halved"
    run(*options, "--out", str(whole), "--steps", "360")
    run(*options, "--out", str(halved), "--steps", "180")
    run("--resume", str(halved), "--steps", "360")
    equal_runs(whole, halved)


def test_a_policy_that_the_last_checkpoint_had_no_time_for(tmp_path: Path) -> None:
    """Killed between the two files of the end: the run is done, its policy is not there."""
    folder = tmp_path / "run"
    run(*OPTIONS, "--method", "rl", "--steps", "120", "--out", str(folder))
    with np.load(folder / "policy.npz") as file:
        weights = file["weight_0"]
    card = json.loads((folder / "policy.json").read_text())
    (folder / "policy.npz").unlink()
    run("--resume", str(folder))
    with np.load(folder / "policy.npz") as file:
        assert np.array_equal(file["weight_0"], weights)
    assert json.loads((folder / "policy.json").read_text()) == card
