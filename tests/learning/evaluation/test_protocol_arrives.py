"""Every setting of a protocol arrives where it takes effect, whichever command it is given to."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import dexctl
import dexctl.sim
from dexctl import hands
from dexctl.cli.command_line import command_line
from dexctl.cli.parsing import parse
from dexctl.cli.rotate import Rotate
from dexctl.settings import changed, get, paths
from learning.cli.evaluate import Evaluate
from learning.cli.inspect import Inspect
from learning.evaluation import Evaluation, Protocol, rollout
from learning.starts import check

WHO = {Evaluate: "policy", Inspect: "subject"}
OTHERS: dict[str, Any] = {
    "scene.hand": "wonik_allegro",
    "scene.object": ("sphere",),
    "scene.object_mesh": Path("thing.stl"),
    "scene.gravity": "down",
    "scene.initial_states": Path("states.npz"),
    "scene.sensing.touch": "binary",
    "scene.sensing.object_pose": "odometry",
    "scene.sensing.joint_touch.release_force": 0.3,
    "scene.sensing.joint_touch.weigh_links": False,
    "scene.threads": 3,
    "task.goals": "cube",
    "task.turning.axis": (0.0, -2.0, 1.0),
    "task.holding.end_on_links": True,
    "task.turning.keep_speed": True,
    "task.turning.only_fingertips": False,
    "task.turning.commands": ("x", "any"),
}


def another(path: str) -> Any:
    """A value that the setting does not have by default."""
    value = get(Protocol(), path)
    if path in OTHERS:
        return OTHERS[path]
    if path.endswith("_range"):
        return (0.25, 0.75)
    return 0.5 if value is None else value + (1 if isinstance(value, int) else 0.25)


class Arrived(Exception):
    """Everything that is simulated and judged has been said."""


@pytest.fixture
def used(monkeypatch: pytest.MonkeyPatch, dex5: dexctl.HandModel) -> dict[str, Any]:
    """What the simulation, the trial and the figures are given."""
    found: dict[str, Any] = {}

    class Simulation:
        sim = SimpleNamespace(groups=[SimpleNamespace(scene=None)])

        def __init__(self, config: Any, num_envs: int, seed: int, *, hand: Any) -> None:
            found.update(scene=config, episodes=num_envs, seed=seed)

        def __enter__(self) -> Simulation:
            return self

        def __exit__(self, *_: object) -> None: ...

    def run(controller: Any, sim: Any, seconds: float, **options: Any) -> None:
        found.update(seconds=seconds, controller=controller, **options)

    def of(trace: Any, scene: Any, protocol: Protocol, judged: Any) -> Evaluation:
        found.update(task=protocol.task)
        raise Arrived

    monkeypatch.setattr(dexctl.sim, "Simulation", Simulation)
    monkeypatch.setattr(dexctl.sim, "run", run)
    module = sys.modules[rollout.__module__]
    monkeypatch.setattr(module, "Judged", lambda simulation, task: None)
    # nothing is simulated here, so no start can be held for half a second either
    monkeypatch.setattr(check, "remark_on_starts", lambda simulation, remark: None)
    monkeypatch.setattr(Evaluation, "of", of)
    monkeypatch.setattr(hands, "load", lambda name: dex5)
    return found


@pytest.mark.parametrize("kind", [Evaluate, Inspect])
def test_every_setting_of_a_command(
    kind: Any, used: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("thing.stl", "states.npz"):
        (tmp_path / name).touch()
    monkeypatch.chdir(tmp_path)
    asked = changed(Protocol(), {path: another(path) for path in paths(Protocol)})
    made = kind(protocol=asked, out=Path("out"), **{WHO[kind]: "goal"})
    command = parse(kind, "dexctl", shlex.split(command_line(made, "it"))[2:])
    assert command is not None
    assert command.protocol == asked
    with pytest.raises(Arrived):
        command.run()
    for path in paths(Protocol):
        assert get(asked, path) != get(Protocol(), path), path
        assert get(SimpleNamespace(**used), path) == get(asked, path), path
    assert used["axis"] == asked.task.axis
    assert used["drop_distance"] == asked.task.holding.drop_distance
    assert used["controller"].control_period == asked.scene.control_period


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        (Evaluate, "dex5-any --conditions limits --seconds 5.0"),
        (Evaluate, "--transfer dex5-cylinder --object sphere"),
        (Inspect, "dex5-easy --object cylinder --episodes 2"),
        (Rotate, "--as-real --controller igm --seconds 3.0"),
    ],
)
def test_a_command_says_what_was_typed_and_nothing_that_follows_from_it(kind: Any, said: str):
    command = parse(kind, "dexctl", shlex.split(said))
    assert command_line(command, "it") == f"dexctl it {said}"
