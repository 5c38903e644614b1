"""``dexctl evaluate``."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from dexctl.cli.parsing import parse
from dexctl.exceptions import InvalidInput, UnknownName
from learning.cli_evaluate import Evaluate
from learning.envs import EnvConfig, make_vector
from learning.policy import PolicySpec, save_policy


def run(*arguments: str) -> int:
    command = parse(Evaluate, "dexctl evaluate", arguments)
    assert command is not None
    return command.run()


@pytest.fixture
def policy(tmp_path: Path) -> Path:
    """One that leaves the set-points where they are."""
    envs = make_vector(EnvConfig(object="cylinder", threads=1), 1, seed=0)
    path = tmp_path / "still.npz"
    spec = PolicySpec.of(envs.hand, envs.observation, envs.action, envs.config)
    save_policy(path, [(np.zeros((15, 65)), np.zeros(15))], spec, {"seed": 7})
    return path


def test_a_policy_as_json(policy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    arguments = ("--object", "cylinder", "cube", "--episodes", "3", "--seconds", "0.5")
    assert run(str(policy), *arguments, "--json", "--out", str(out)) == 0
    found = json.loads(capsys.readouterr().out)
    assert found == json.loads((out / "evaluate.json").read_text())
    assert found["card"]["seed"] == 7
    assert [one["object"] for one in found["results"]] == ["cylinder", "cube"]
    first = found["results"][0]
    assert first["share_dropped"]["value"] == 0.0
    assert abs(first["rotation_median_rad"]["value"]) < 0.05
    assert first["noise"] == {"joint": 0.0, "position": 0.0, "normal": 0.0, "force": 0.0}
    assert len((out / "episodes.csv").read_text().splitlines()) == 1 + 2 * 3


def test_a_controller_in_its_place(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("hold", "--episodes", "2", "--seconds", "0.1", "--robustness") == 0
    table = capsys.readouterr().out
    assert "2 episodes of 0.1 s" in table
    assert table.count("cube") == 21
    assert "joint 0.1" in table
    assert "rad" in table


def test_bad_input(tmp_path: Path) -> None:
    with pytest.raises(UnknownName, match=r"unknown policy 'gate'; known: a policy file \(\.npz\)"):
        run("gate")
    with pytest.raises(InvalidInput, match="no such file"):
        run(str(tmp_path / "none.npz"))
    with pytest.raises(UnknownName, match="unknown object 'brick'"):
        run("hold", "--object", "brick")
    with pytest.raises(InvalidInput, match="--seconds is 0"):
        run("hold", "--seconds", "0")
    with pytest.raises(InvalidInput, match="--episodes is 0"):
        run("hold", "--episodes", "0")
