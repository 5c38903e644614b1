"""A series of evaluations that is killed goes on where it stopped, and mixes nothing up."""

from __future__ import annotations

import copy
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike

import dexctl
from dexctl import controllers
from dexctl.controller import BatchController
from dexctl.settings import changed, get, paths
from dexctl.sim.conditions import CONDITIONS
from dexctl.state import GraspState
from learning.evaluation import Protocol, evaluate
from learning.evaluation import store as stores
from learning.evaluation.fingerprint import fingerprint
from learning.evaluation.robustness import robustness
from learning.evaluation.store import EvaluationStore

SHORT = changed(Protocol(), {"episodes": 2, "seconds": 0.1, "threads": 1})
LEVELS = {"joint_noise": (0.1,), "push_force": (0.5, 1.0)}


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What was really evaluated."""
    made: list[str] = []

    def counted(who, protocol=None, *, object="", progress=None):  # noqa: A002
        made.append(object)
        return evaluate(who, protocol, object=object, progress=progress)

    monkeypatch.setattr(stores, "evaluate", counted)
    return made


def test_what_is_finished_is_not_done_again(
    dex5: dexctl.HandModel, tmp_path: Path, calls: list[str]
) -> None:
    hold = controllers.make("hold", dex5)
    first = robustness(hold, SHORT, LEVELS, run=EvaluationStore(tmp_path / "points"))
    assert len(calls) == 4
    files = sorted((tmp_path / "points").iterdir())
    assert [path.name.rpartition("-")[0] for path in files] == [
        "cube", "cube-joint_noise-0.1", "cube-push_force-0.5", "cube-push_force-1",
    ]  # fmt: skip
    EvaluationStore(tmp_path / "noise")(hold, changed(SHORT, CONDITIONS["everything"]))
    (file,) = (tmp_path / "noise").iterdir()  # named by all noise that there is
    assert file.name.startswith("cube-position_noise-0.002-normal_noise-0.1-force_noise-0.5-")
    calls.pop()
    files[2].unlink()
    files[3].write_bytes(files[3].read_bytes()[:100])  # cut short by who knows what
    store = EvaluationStore(tmp_path / "points")
    again = robustness(hold, changed(SHORT, {"threads": 2}), LEVELS, run=store)
    assert (len(calls), store.found) == (6, 2)
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one.rotation, other.rotation)
        np.testing.assert_array_equal(one.rotations, other.rotations)
        assert other.protocol == changed(one.protocol, {"threads": 2})
        assert one.to_dict() == other.to_dict()


def test_nothing_is_taken_for_something_else(
    dex5: dexctl.HandModel, tmp_path: Path, calls: list[str]
) -> None:
    hold = controllers.make("hold", dex5)
    store = EvaluationStore(tmp_path)
    store(hold, SHORT)
    store(hold, SHORT, object="cylinder")
    store(hold, replace(SHORT, seed=1))
    store(controllers.make("igm", dex5), SHORT)
    store(controllers.make("igm", dex5, grip_force=2.0), SHORT)
    assert (len(calls), store.found) == (5, 0)
    store(controllers.make("igm", dex5), SHORT)
    assert (len(calls), store.found) == (5, 1)


def test_every_setting_counts_but_threads(dex5: dexctl.HandModel, tmp_path: Path) -> None:
    """A digest for each setting that differs; files by what is in them."""
    hold, seen = controllers.make("hold", dex5), set()
    states, mesh = tmp_path / "states.npz", tmp_path / "thing.stl"
    others = {
        "scene.hand": "wonik_allegro", "scene.object": "sphere", "scene.object_mesh": mesh,
        "scene.gravity": "down", "scene.initial_states": states, "task.turning.axis": "x",
        "task.goals": "cube", "task.turning.commands": ("x", "any"),
        "scene.sensing.touch": "binary", "scene.sensing.object_pose": "odometry",
        "scene.sensing.joint_touch.release_force": 0.3,
        "scene.sensing.joint_touch.weigh_links": False,
        "task.holding.end_on_links": True, "task.turning.keep_speed": True,
        "task.turning.only_fingertips": False,
        **{path: (0.25, 0.75) for path in paths(Protocol) if path.endswith("_range")},
    }  # fmt: skip

    def about(protocol: Protocol) -> str:
        found = stores._about(hold, "hold", protocol.scene.object[0], protocol)
        return json.dumps(found, sort_keys=True)

    for path in (states, mesh):
        path.write_text("one")
    for path in paths(Protocol):
        value = get(Protocol(), path)
        number = 0.5 if value is None else value + 1 if path not in others else None
        other = others.get(path, number)
        if path != "scene.threads":
            seen.add(about(changed(Protocol(), {path: other})))
    assert len(seen) == len(list(paths(Protocol))) - 1
    assert about(changed(Protocol(), {"threads": 2})) == about(Protocol())
    states.write_text("another")
    assert about(changed(Protocol(), {"initial_states": states})) not in seen


def test_how_wide_the_object_is_by_the_hands_toml_counts(dex5: dexctl.HandModel) -> None:
    held = replace(dex5.config.object, sizes={"cube": 0.08})
    other = replace(dex5.config, object=held).build()
    cube, sphere = (
        [
            stores._about(controllers.make("hold", hand), "hold", name, Protocol())
            for hand in (dex5, other)
        ]
        for name in ("cube", "sphere")
    )
    assert cube[0] != cube[1] and sphere[0] == sphere[1]


NAMES = (
    "igm", "switch", "gait", "coordinated", "hold",
    "dex5-robust", "dex5-robust@0.5", "dex5-nine", "dex5-cube-z", "dex5-cube-z-any",
    "regulated:dex5-robust", "regulated:dex5-robust@0.5", "regulated:dex5-nine",
    "centred:dex5-nine",
    "commanded:dex5-cube-z,dex5-cube-x", "commanded:dex5-cube-x,dex5-cube-z",
    "commanded:dex5-easy-any,dex5-sphere-x", "sequence:dex5-cube-z,dex5-cube-x",
    "sequence:dex5-cube-z-any,dex5-cube-x-any", "sequence:dex5-cube-z,dex5-cube-x@0.5",
    "pursuing:dex5-cube-goals", "pursuing:dex5-cube-goals-touch",
    "steered:dex5-axes", "steered:commanded:dex5-cube-z,dex5-cube-x",
)  # fmt: skip


def test_fingerprints(dex5: dexctl.HandModel) -> None:
    """Everybody inside counts, and the pace."""
    make = controllers.make
    different = [controllers.resolve(name, dex5) for name in NAMES]
    different.append(make("igm", dex5, axis=(1.0, 0.0, 0.0)))
    different += [
        dexctl.Superposition([make(name, dex5) for name in names])
        for names in (("igm", "switch"), ("switch", "igm"), ("igm", "hold"))
    ]
    found = [fingerprint(one) for one in different]
    assert None not in found and len(set(found)) == len(different)
    for i in (0, 6, 17, 20):
        assert fingerprint(controllers.resolve(NAMES[i], dex5)) == found[i]
        different[i].reset(seed=3)
        assert fingerprint(different[i]) == found[i]
        assert fingerprint(copy.deepcopy(different[i])) == found[i]


class Own(BatchController):
    """Somebody's own, that keeps nothing of what it was made with where others would look."""

    def __init__(self, hand: dexctl.HandModel, gain: object) -> None:
        super().__init__(hand)
        self._gain = gain

    def reset(self, seed: ArrayLike | None = None, mask: ArrayLike | None = None) -> None:
        """Nothing to forget."""

    def act_batch(self, state: GraspState) -> np.ndarray:
        return np.zeros_like(state.q)


def test_controllers_of_others(dex5: dexctl.HandModel, tmp_path: Path, calls: list[str]) -> None:
    """What they were made with counts, too; nothing is kept where nobody can tell what it is."""
    file = tmp_path / "gains.txt"
    file.write_text("1 2")
    inside = [0.1, {"a": [1, 2], "b": {3, 4}}, np.arange(3), np.arange(3.0), file, Own(dex5, 1)]
    found = [fingerprint(Own(dex5, one)) for one in inside]
    assert None not in found and len(set(found)) == len(inside)
    again = [fingerprint(Own(dex5, one)) for one in (*inside[:4], str(file), Own(dex5, gain=1))]
    assert again[:5] == found[:5]
    file.write_text("1 3")
    assert fingerprint(Own(dex5, file)) not in found
    unknown = dexctl.Superposition([Own(dex5, lambda: 1)])
    assert fingerprint(unknown) is None
    store = EvaluationStore(tmp_path / "points")
    for _ in range(2):
        store(unknown, SHORT)
    assert (len(calls), store.found) == (2, 0) and not (tmp_path / "points").exists()


def test_a_killed_sweep_continues(tmp_path: Path) -> None:
    out = tmp_path / "out"
    code = (
        "import sys; from dexctl.cli.parsing import parse; "
        "from learning.cli.evaluate import Evaluate; "
        f"parse(Evaluate, 'dexctl evaluate', ['hold', '--robustness', '--episodes', '2', "
        f"'--seconds', '0.3', '--out', {str(out)!r}]).run()"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    killed = subprocess.Popen(
        [sys.executable, "-c", code], env=environment,
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    deadline = time.monotonic() + 120.0
    while len(list(out.glob("points/cube*.npz"))) < 3 and time.monotonic() < deadline:
        assert killed.poll() is None
        time.sleep(0.002)
    killed.send_signal(signal.SIGKILL)
    killed.wait()
    kept = {path: path.stat().st_mtime_ns for path in out.glob("points/cube*.npz")}
    assert 3 <= len(kept) <= 21
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert f"{len(kept)} of 21 were there already" in done.stderr
    assert all(path.stat().st_mtime_ns == when for path, when in kept.items())
    assert len(list(out.glob("points/cube*.npz"))) == 21
    for name in ("evaluate.json", "figures.csv", "curves.csv", "episodes.csv"):
        assert (out / name).stat().st_size > 0


def test_a_full_disk_loses_nothing_that_was_there(
    dex5: dexctl.HandModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hold, store = controllers.make("hold", dex5), EvaluationStore(tmp_path)
    store(hold, SHORT)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def full(stream, **arrays) -> None:
        stream.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", full)
    with pytest.raises(OSError, match="No space left on device"):
        store(hold, replace(SHORT, seed=1))
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
