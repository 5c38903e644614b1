"""``dexctl evaluate``."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dexctl
from dexctl.cli.parsing import parse
from dexctl.exceptions import InvalidInput, UnknownName
from learning import policies
from learning.cli_evaluate import Evaluate
from learning.envs import EnvConfig, Observation, SetPointAction, make_vector
from learning.policies import PolicySpec


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
    policies.save(path, [(np.zeros((15, 65)), np.zeros(15))], spec, {"seed": 7})
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


def test_a_controller_in_its_place(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ("--episodes", "2", "--seconds", "0.1", "--object", "cube", "sphere")
    assert run("hold", *arguments, "--robustness", "--out", str(tmp_path / "out")) == 0
    table = capsys.readouterr().out
    assert "2 episodes of 0.1 s" in table
    assert table.count("rotation, rad") == 2  # a table for each object
    assert table.count("joint 0.1 rad") == 2 and table.count("push 2 N") == 2
    figures = list(csv.DictReader((tmp_path / "out" / "figures.csv").open()))
    assert len(figures) == 42
    assert figures[4]["joint_noise"] == "0.1"
    assert float(figures[0]["share_dropped_high"]) == pytest.approx(0.657, abs=1e-3)  # Wilson
    curves = list(csv.DictReader((tmp_path / "out" / "curves.csv").open()))
    assert len(curves) == 42 * 3
    assert curves[2]["time_s"] == "0.1" and curves[2]["share_held"] == "1.0"
    for name in ("rotation.png", "robustness.png"):
        assert (tmp_path / "out" / name).read_bytes().startswith(b"\x89PNG")


def test_one_table_of_figures(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("igm", "--episodes", "2", "--seconds", "0.2", "--axis=0,0,-1") == 0
    table = capsys.readouterr().out
    assert "igm, palm up, about (0, 0, -1)" in table
    assert "cube" in table and "made a full turn" in table
    assert all(len(line) <= 80 for line in table.splitlines()[2:])
    # it turns the other way, about the other axis: forwards
    assert float(re.search(r"rotation +([-.0-9]+) rad", table)[1]) > 0.01  # type: ignore[index]


def policy_of(folder: Path, card: Mapping[str, Any] | None, **options: Any) -> str:
    """A policy that leaves the set-points where they are, trained in ``EnvConfig(**options)``."""
    config = EnvConfig(**options)
    hand = dexctl.hands.load(config.hand)
    observation = Observation(hand, config.parts, scaled=config.scaled)
    action = SetPointAction(
        hand, max_speed=config.max_speed, max_lead=config.max_lead, control_period=0.05
    )
    path = folder / f"{'-'.join(config.objects)}-{config.gravity}.npz"
    layers = [(np.zeros((hand.nq, observation.size)), np.zeros(hand.nq))]
    if card is None:
        card = {"trained": {"env": config.to_dict()}}
    policies.save(path, layers, PolicySpec.of(hand, observation, action, config), card)
    return str(path)


def test_what_is_not_said_is_as_in_training(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    policy = policy_of(
        tmp_path, None, object=("sphere", "cylinder"), gravity="down", axis=(0.0, 2.0, 0.0),
        object_mass=0.05,
    )  # fmt: skip
    short = ("--episodes", "2", "--seconds", "0.1", "--json")
    assert run(policy, *short) == 0
    found = json.loads(capsys.readouterr().out)
    assert [one["object"] for one in found["results"]] == ["sphere", "cylinder"]
    assert (found["gravity"], found["axis"]) == ("down", [0.0, 1.0, 0.0])
    assert (found["object_mass_kg"], found["object_size_m"]) == (0.05, None)
    assert run(policy, *short, "--object", "cube", "--gravity", "up", "--axis", "z") == 0
    found = json.loads(capsys.readouterr().out)
    assert [one["object"] for one in found["results"]] == ["cube"]
    assert (found["gravity"], found["axis"]) == ("up", [0.0, 0.0, 1.0])


def test_the_transfer_matrix(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sphere = policy_of(tmp_path, None, object="sphere")
    out = tmp_path / "out"
    arguments = ("--episodes", "2", "--seconds", "0.2", "--object", "cube", "--out", str(out))
    assert run("--transfer", sphere, "cylinder=igm", *arguments) == 0
    table = capsys.readouterr().out
    assert "policy of" in table
    found = json.loads((out / "evaluate.json").read_text())
    matrix = found["transfer"]
    assert matrix["objects"] == ["sphere", "cylinder", "cube"]
    assert [one["object"] for one in matrix["policies"]] == ["sphere", "cylinder"]
    row = matrix["rotation_median_rad"][1]
    scores = matrix["rotation_score"][1]
    assert scores[1]["value"] == 1.0
    assert scores[2]["value"] == pytest.approx(row[2]["value"] / row[1]["value"])
    assert len((out / "transfer.csv").read_text().splitlines()) == 1 + 6
    assert (out / "transfer.png").read_bytes().startswith(b"\x89PNG")
    assert found["cards"][1] is None


def cut(path: str) -> str:
    whole = Path(path).read_bytes()
    Path(path).write_bytes(whole[: len(whole) // 2])
    return path


def of_another_hand(folder: Path) -> str:
    parts = {"version": 1, "parts": ["q"], "scaled": False, "centre": [0, 0, 0]}
    action = {"max_speed": 2.0, "max_lead": 0.25, "control_period": 0.05}
    spec = PolicySpec("paw", ("a", "b"), ("tip",), parts, action)
    policies.save(folder / "paw.npz", [(np.zeros((2, 2)), np.zeros(2))], spec, {})
    return str(folder / "paw.npz")


def without_card(path: str) -> str:
    np.savez(path, weight_0=np.zeros((15, 65)), bias_0=np.zeros(15))
    return path


def of_format(path: str, number: int) -> str:
    np.savez(path, card=np.array(json.dumps({"format": number})))
    return path


BAD: dict[str, tuple[Callable[[Path], list[str]], str]] = {
    "controller": (lambda _: ["gate"], r"unknown policy 'gate'; known: a policy file \(\.npz\)"),
    "no file": (lambda f: [str(f / "none.npz")], "policy .*none.npz': no such file"),
    "cut off": (lambda f: [cut(policy_of(f, None))], "cube-up.npz' is not a policy file"),
    "no card": (
        lambda f: [without_card(policy_of(f, None))],
        "cube-up.npz' is not a policy file: it holds no card",
    ),
    "format": (lambda f: [of_format(policy_of(f, None), 9)], "has format 9; expected 1"),
    "card of another version": (
        lambda f: [policy_of(f, {"trained": {"env": {"colour": "red"}}})],
        "card of policy '.*cube-up.npz' is of another version: .*colour",
    ),
    "hand": (
        lambda f: [of_another_hand(f), "--hand", "dex5"],
        r"the policy is for the hand 'paw' \(2 joints, 1 fingers\); got 'dex5' \(15 joints",
    ),
    "hand that is not there": (lambda f: [of_another_hand(f)], "unknown hand 'paw'; known: dex5"),
    "parts": (
        lambda f: [policy_of(f, None), "--parts", "q", "touch"],
        "the policy was trained with the observation parts q, q_target, .*; got q, touch",
    ),
    "part": (
        lambda f: [policy_of(f, None), "--parts", "smell"], "unknown observation part 'smell'"
    ),
    "object": (lambda _: ["hold", "--object", "brick"], "unknown object 'brick'; known: cube"),
    "axis": (lambda _: ["hold", "--axis", "w"], "unknown axis 'w'; known: x, y, z"),
    "seconds": (lambda _: ["hold", "--seconds", "0"], "--seconds is 0"),
    "episodes": (lambda _: ["hold", "--episodes", "0"], "--episodes is 0"),
    "nothing": (lambda _: [], "got neither of a policy and --transfer"),
    "both": (lambda _: ["hold", "--transfer", "cube=igm"], "got both of a policy and --transfer"),
    "transfer and robustness": (
        lambda _: ["--robustness", "--transfer", "cube=igm", "sphere=igm"],
        "got --transfer and --robustness",
    ),
    "transfer of one": (lambda _: ["--transfer", "cube=igm"], "got 1 policies for a transfer"),
    "transfer object": (
        lambda _: ["--transfer", "brick=igm", "cube=igm"], "unknown object 'brick'; known: cube"
    ),
    "transfer without card": (
        lambda f: ["--transfer", policy_of(f, {}), "sphere=igm"],
        "'.*cube-up.npz' has no such card: give it, as in cube=.*cube-up.npz",
    ),
    "transfer of several": (
        lambda f: ["--transfer", policy_of(f, None, object=("cube", "sphere")), "sphere=igm"],
        "was trained on cube and sphere: give it, as in cube=",
    ),
    "transfer up and down": (
        lambda f: [
            "--transfer", policy_of(f, None), policy_of(f, None, object="sphere", gravity="down")
        ],
        "the policies were trained with gravity up and down; say which with --gravity",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_input(case: str, tmp_path: Path) -> None:
    arguments, said = BAD[case]
    with pytest.raises((InvalidInput, UnknownName), match=said) as caught:
        run(*arguments(tmp_path))
    assert "\n" not in str(caught.value)
