"""Sweeps that really train: killed and continued, with a failing run among others, and on Ray."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("torch")

from dexctl import hands
from dexctl.cli.parsing import parse
from dexctl.cluster import ClusterError
from dexctl.exceptions import InvalidInput
from dexctl.locking import locked
from learning.cli.sweep import Sweep
from learning.policies import load
from learning.sweep.cluster import RayPool, run_here
from learning.sweep.jobs import Job, jobs, outcome
from learning.sweep.process import LocalPool
from learning.sweep.reading import load_sweep, parse_sweep
from learning.sweep.worker import do
from learning.training.run_folder import RunFolder

ROOT = Path(__file__).parents[3]
TEXT = """
methods = ["rl", "vge"]
controllers = ["hold"]
[train]
steps = 800
num_envs = 4
log_every = 100
checkpoint_every = 100
device = "cpu"
[train.sac]
network = [16]
batch_size = 16
gradient_steps = 1
learning_starts = 40
buffer_size = 200
[train.env]
object = "cylinder"
episode_steps = 50
[method.vge]
steps = 100
[evaluation]
episodes = 2
seconds = 0.5
"""
RUN = (
    "import sys; from dexctl.cli.parsing import parse; from learning.cli.sweep import Sweep; "
    "parse(Sweep, 'dexctl sweep', sys.argv[1:]).run()"
)


def run(*arguments: str) -> int:
    """`dexctl sweep` in this process."""
    command = parse(Sweep, "dexctl sweep", arguments)
    assert command is not None
    return command.run()


def start(file: Path, out: Path) -> subprocess.Popen[bytes]:
    """`dexctl sweep` in a process of its own."""
    return subprocess.Popen(
        [sys.executable, "-c", RUN, str(file), "--out", str(out), "--jobs", "2"],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )


def wait_for(path: Path, process: subprocess.Popen[bytes]) -> None:
    """Until a process has made ``path``."""
    deadline = time.monotonic() + 100
    while not path.exists():
        assert process.poll() is None, process.communicate()[1].decode()
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "sweep.toml"
    path.write_text(TEXT)
    return path


def hold(tmp_path: Path, name: str = "hold") -> Job:
    """The evaluation of a controller: the quickest job that there is."""
    config = parse_sweep(
        {
            "methods": ["rl"],
            "train": {"env": {"object": "cylinder"}},
            "evaluation": {"episodes": 1, "seconds": 0.1, "controllers": ["hold"]},
        }
    )
    job = next(jobs(config, tmp_path))
    return replace(job, name=name, folder=job.folder.with_name(name))


@pytest.mark.slow  # test_a_killed_sweep_continues is quick
def test_killed_and_started_again(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One run is killed half way, another cannot begin; then the third start has all of it."""
    out = tmp_path / "out"
    rl, vge = out / "runs" / "rl-0", out / "runs" / "vge-hold-0"
    vge.mkdir(parents=True)
    (vge / "config.json").write_text("{")
    prepared = load_sweep(file)
    (out / "sweep.json").write_text(json.dumps({"format": 2, **prepared.to_dict()}))
    sweep = start(file, out)
    try:
        wait_for(rl, sweep)
        with pytest.raises(InvalidInput, match="another process is at work in"):
            run(str(file), "--out", str(out))
        wait_for(rl / "checkpoint.bin", sweep)
    finally:
        sweep.kill()
        sweep.communicate()
    with locked(rl, wait=60):  # its process held the folder, and has gone with the sweep
        pass
    assert outcome(rl).state == "unfinished"

    assert run(str(file), "--out", str(out), "--jobs", "2") == 1
    said = capsys.readouterr()
    assert "dexctl: runs/vge-hold-0 failed: " in said.err and "config.json is not JSON" in said.err
    assert "goes on from its checkpoint" in (rl / "worker.log").read_text()
    found = json.loads((out / "results.json").read_text())
    assert [run["state"] for run in found["runs"]] == ["finished", "failed"]
    assert [cell["rotation_iqm_rad"] is None for cell in found["cells"]] == [False, True]
    assert "0 of 1 (1 failed)" in (out / "table.md").read_text()
    assert (out / "curves.png").stat().st_size > 10_000

    done = (rl / "result.json").stat().st_mtime_ns
    (vge / "config.json").unlink()
    assert run(str(out)) == 0  # the folder knows its sweep
    assert (rl / "result.json").stat().st_mtime_ns == done  # what is finished stays
    dex5 = hands.config("dex5")
    config = {run.name: run.config.with_mass(dex5) for run in prepared.runs}
    for folder, steps in ((rl, 800), (vge, 100)):
        assert RunFolder(folder).config() == config[folder.name]  # a run as any other
        assert load(folder).card["steps"] == steps
        result = json.loads((folder / "result.json").read_text())
        assert result["steps"] == steps
        assert len(result["episodes"]["cylinder"]["rotation_rad"]) == 2
    file.write_text(TEXT.replace("[train.sac]", "[train.sac]\ngamma = 0.9"))
    with pytest.raises(InvalidInput, match="other settings: runs.rl-0.sac.gamma was 0.99, is 0.9;"):
        run(str(file), "--out", str(out))


def test_killed_workers_and_bad_jobs_are_recorded(tmp_path: Path) -> None:
    """The others are done, and a second start does what was not."""
    good, killed, bad = hold(tmp_path), hold(tmp_path, "igm"), hold(tmp_path, "walk")
    with LocalPool(3) as pool:
        for job in (good, killed, bad):
            pool.start(job)
        pool._workers[1].process.kill()
        ended: list[Job] = []
        while pool.running:
            ended += pool.wait(0.5)
    assert {job.name for job in ended} == {"hold", "igm", "walk"}
    found = outcome(good.folder)
    assert found.state == "finished" and found.result is not None
    assert found.result["objects"]["cylinder"]["share_dropped"]["value"] == 0.0
    assert outcome(killed.folder).error == "its process was killed by SIGKILL (out of memory?)"
    error = outcome(bad.folder).error
    assert error is not None and error.startswith("unknown controller 'walk'; known: igm")
    failure = json.loads((bad.folder / "failure.json").read_text())
    assert "Traceback" in failure["traceback"]


def test_stopped_in_order_is_no_failure(tmp_path: Path) -> None:
    job = hold(tmp_path)
    with LocalPool(1) as pool:
        pool.start(job)
    assert outcome(job.folder).state == "unfinished"
    with locked(job.folder):
        pass


@pytest.mark.slow
def test_a_sweep_that_is_told_to_stop_saves_and_says_how_it_goes_on(
    file: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    run_folder = RunFolder(out / "runs" / "rl-0")
    file.write_text(TEXT.replace("steps = 800", "steps = 100_000"))
    sweep = start(file, out)
    wait_for(run_folder.checkpoint_path, sweep)
    sweep.terminate()
    _, said = sweep.communicate(timeout=100)
    assert sweep.returncode != 0
    assert f"interrupted: what was begun is saved; `dexctl sweep {out}` goes on" in said.decode()
    with run_folder.lock():  # nobody is left
        assert outcome(run_folder.path).state == "unfinished"
        assert run_folder.read_checkpoint() is not None


def test_controllers_are_made_for_the_axis_that_was_trained(tmp_path: Path) -> None:
    """About x, an object of the size that was trained with; about z, igm turns it elsewhere."""
    given = {
        "methods": ["rl"],
        "train": {"axis": "x", "object_size": 0.07},
        "evaluation": {"episodes": 2, "seconds": 1, "controllers": ["igm"]},
    }
    job = next(jobs(parse_sweep(given), tmp_path))
    do(job)
    result = outcome(job.folder).result
    assert result is not None
    # 0.5 rad/s for a second, less what the fingers need to get going
    assert min(result["episodes"]["cube"]["rotation_rad"]) > 0.3
    assert result["evaluation"]["task"]["turning"]["axis"] == "x"
    assert result["evaluation"]["scene"]["object_size"] == 0.07


@pytest.mark.slow
def test_a_task_of_ray_is_the_same_process(tmp_path: Path) -> None:
    """What runs on the cluster's machines, without a cluster."""
    job = hold(tmp_path)
    with pytest.raises(ClusterError, match="is not the same folder on this machine; --out must"):
        run_here(job.to_json(), "marker")
    (tmp_path / "controllers").mkdir()
    (tmp_path / "controllers" / ".sweep").write_text("marker")
    run_here(job.to_json(), "marker")
    assert outcome(job.folder).state == "finished"


def start_ray(attempts: int = 3) -> Any:
    """A cluster on this machine; on a busy one, Ray's own processes may be too slow for Ray."""
    from ray.cluster_utils import Cluster

    for attempt in range(attempts):
        try:
            return Cluster(
                initialize_head=True, head_node_args={"num_cpus": 2, "include_dashboard": False}
            )
        except Exception:
            if attempt + 1 == attempts:
                raise
    return None


@pytest.mark.slow
def test_on_a_ray_cluster(file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("ray")
    out = tmp_path / "out"
    poisoned = out / "runs" / "vge-hold-0"
    poisoned.mkdir(parents=True)
    (poisoned / "config.json").write_text("{")
    prepared = load_sweep(file, steps=100)
    (out / "sweep.json").write_text(json.dumps({"format": 2, **prepared.to_dict()}))
    cluster = start_ray()
    try:
        given = [str(file), "--steps", "100", "--out", str(out), "--ray", cluster.address]
        assert run(*given) == 1
        assert "runs/vge-hold-0 failed: " in capsys.readouterr().err
        (poisoned / "config.json").unlink()
        assert run(*given) == 0
    finally:
        cluster.shutdown()
    found = json.loads((out / "results.json").read_text())
    assert [run["state"] for run in found["runs"]] == ["finished", "finished"]


def test_no_cluster(tmp_path: Path) -> None:
    pytest.importorskip("ray")
    with pytest.raises(ClusterError, match="no Ray cluster at nonsense"):
        RayPool("nonsense")


def test_bad_input(file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InvalidInput, match="--jobs is 0; expected a whole number above 0"):
        run(str(file), "--jobs", "0")
    with pytest.raises(InvalidInput, match="there is no sweep in .*: no sweep.json"):
        run(str(tmp_path))
    with pytest.raises(InvalidInput, match="--out, --steps and --seed go with a file"):
        run(str(tmp_path), "--steps", "3")
    with pytest.raises(InvalidInput, match="--seed is -1"):
        run(str(file), "--seed", "-1")
    (tmp_path / "other" / "runs").mkdir(parents=True)
    with pytest.raises(InvalidInput, match="holds something else; take another --out"):
        run(str(file), "--out", str(tmp_path / "other"))
    with pytest.raises(InvalidInput, match="there is no sweep in"):
        run(str(file), "--out", str(tmp_path / "none"), "--report-only")
