"""`dexctl train`: what it leaves behind, and what it says to bad input."""

from __future__ import annotations

import csv
import json
import os
import re
import signal
import subprocess
import sys
import time
import tomllib
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")

import learning
from dexctl.cli import main
from dexctl.cli.parsing import parse
from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.settings import from_plain
from dexctl.sim import GraspStates, Scene
from learning.cli.train import Train
from learning.config import TrainConfig, recipe
from learning.training.log import Tally, columns, who_acted
from learning.training.run_folder import RunFolder

ROOT = Path(__file__).parents[3]
SMALL = (
    "--num-envs", "4", "--steps", "200", "--sac.network", "16", "16", "--sac.batch-size", "16",
    "--sac.learning-starts", "40", "--sac.buffer-size", "100", "--log-every", "100",
    "--device", "cpu", "--recipe", "thesis",
)  # fmt: skip


def test_it_is_found_by_name() -> None:
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    points = tomllib.loads(text)["project"]["entry-points"]["dexctl.commands"]
    assert EntryPoint("train", points["train"], "dexctl.commands").load() is Train


def command(*arguments: str) -> Train:
    found = parse(Train, "dexctl train", arguments)
    assert found is not None
    return found


def test_settings_of_the_tree_that_starts_are_from_are_options() -> None:
    config = command("--tree.kinematic.friction", "0.8", "--stability.no-fingertips-only").config
    assert config.starts.tree.kinematic.friction == 0.8
    assert not config.starts.stability.fingertips_only


def test_a_run_leaves_logs_a_checkpoint_and_a_policy(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "run"
    assert (
        command(*SMALL, "--object", "cylinder", "sphere", "--out", str(folder), "--json").run() == 0
    )
    said = capsys.readouterr()
    printed = json.loads(said.out)
    assert str(folder) in said.err  # where it is kept, from the beginning
    assert printed["steps"] == 200 and printed["last"]["step"] == 200
    with (folder / "progress.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["step"] for row in rows] == ["100", "200"]
    assert list(rows[0]) == list(columns(("gait",)))
    assert float(rows[0]["share_gait"]) == float(rows[0]["controller_share"])
    assert 0.0 < float(rows[0]["p_psi"]) == float(rows[0]["p_gait"]) < 1.0
    assert 0.0 < float(rows[0]["cpu_seconds"]) < float(rows[1]["cpu_seconds"])
    assert list((folder / "tensorboard").iterdir())
    policy = learning.load_policy(folder / "policy.npz")
    assert policy.card["steps"] == 200
    config = RunFolder(folder).config()
    assert config.env.scene.object == ("cylinder", "sphere")
    assert from_plain(TrainConfig, policy.card["trained"]) == config
    with pytest.raises(InvalidInput, match="holds a run already"):
        command(*SMALL, "--out", str(folder)).run()
    with pytest.raises(InvalidInput, match="only --steps may be given: seed was 0, is 1"):
        command("--resume", str(folder), "--seed", "1").run()
    with pytest.raises(InvalidInput, match="only --steps may be given: got --conditions limits"):
        command("--resume", str(folder), "--conditions", "limits").run()


def test_ctrl_c_says_what_is_saved_and_how_to_go_on(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    code = "import sys; from dexctl.cli import main; sys.exit(main(sys.argv[1:]))"
    arguments = ["train", *SMALL, "--steps", "1000000", "--out", str(folder)]
    process = subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    deadline = time.monotonic() + 100
    while len(RunFolder(folder).progress()) < 1:
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    said = process.communicate(timeout=60)[1].decode()
    assert process.returncode == 130
    last = said.strip().splitlines()[-1]
    assert last.startswith("dexctl: interrupted at step")
    assert f"dexctl train --resume {folder}" in last
    assert RunFolder(folder).read_checkpoint() is not None


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("--object teapot", "unknown object 'teapot'; known: .*cylinder"),
        ("--hand paw", "unknown hand 'paw'"),
        ("--method dagger", "dagger.*rl.*vge"),
        ("--controller walk", "unknown controller 'walk'; known: igm"),
        ("--algorithm dqn", "dqn.*sac.*td3.*ppo"),
        ("--algorithm ppo", "ppo learns from its own actions only: expected method 'rl'"),
        ("--device tpu", "tpu.*auto.*cpu.*cuda"),
        ("--steps 0", "steps is 0; expected a whole number from 1 on"),
        ("--num-envs -1", "num_envs is -1"),
        ("--sac.gamma 1.5", "gamma is 1.5; expected a number from 0 to 1"),
        ("--sac.learning-rate nan", "learning_rate is nan"),
        ("--sac.network 0", "network is \\(0,\\)"),
        ("--sac.buffer-size 64", "buffer_size is 64; expected at least one batch"),
        ("--env.axis w", "unknown axis 'w'; known: x, y, z"),
        ("--env.parts q smell", "unknown observation part 'smell'; known: q, q_target"),
        ("--env.critic-parts drawn drawn", "critic_parts is .*each named once"),
        ("--start-from gravity --env.gravity-tilt 3", "start_from is 'gravity', .* gravity_tilt"),
        ("--start-from grasps --env.size-range 0.9,1.1", "start_from is 'grasps', .* size_range"),
        ("--env.goals root", "goals is 'root', .* settled grasp, .*expected initial_states"),
        ("--env.goals root --start-from gravity", "goals is 'root', which is the settled grasp"),
        ("--env.sensor-latency 100", "sensor_latency is 100.0; expected 0 to 10 s"),
        ("--env.action-latency-range 0,11", "latency_range is .*; expected latencies up to 10 s"),
        ("--env.sensor-latency nan", "sensor_latency is nan"),
        ("--env.initial-states none.npz", "'.*none.npz' cannot be read"),
        ("--seed -1", "seed is -1"),
        ("--recipe slow", "unknown recipe 'slow'; known: thesis, fast"),
        ("--method rl+bc --controller igm gait", "'rl\\+bc' has the controllers igm, gait at once"),
        ("--resume /nowhere/at/all", "there is no run in /nowhere/at/all"),
        ("--env.commands x -x y", "Unrecognized options: -x, y; several axes are one word, .*x,-x"),
        ("--conditions --steps 9", "--conditions has nothing behind it; expected names, or a"),
        ("--conditions moon", "unknown conditions 'moon'; known: nominal, limits"),
        ("--conditions none.toml", "cannot read none.toml: No such file"),
    ],
)
def test_bad_input(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: str, said: str
) -> None:
    folder = tmp_path / "run"
    assert main(["train", *arguments.split(), "--out", str(folder)]) in (1, 2)
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(said, line)
    assert not folder.exists()


def test_a_run_can_be_resumed_from_another_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = Scene.build("dex5", "cylinder")
    q, pose = scene.settled.qpos[scene.qpos_columns], scene.settled.qpos[scene.object_qpos]
    GraspStates(
        hand="dex5",
        q=q[None],
        q_target=scene.settled.q_target[None],
        object_position=pose[None, :3],
        object_quaternion=pose[None, 3:],
        object=np.array(["cylinder"]),
        joint_names=np.array(scene.hand.joint_names),
    ).save(tmp_path / "states.npz")
    monkeypatch.chdir(tmp_path)
    run, typed = tmp_path / "run", ("--env.initial-states", "states.npz")
    assert command(*SMALL, "--object", "cylinder", *typed, "--out", str(run)).run() == 0
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert command("--resume", str(run), "--steps", "240").run() == 0
    found = RunFolder(run).config().env.scene.initial_states
    assert found == tmp_path.resolve() / "states.npz"


def test_conditions_are_trained_in(tmp_path: Path) -> None:
    """By name, and as `dexctl hardware identify` writes them; what is typed counts."""
    file = tmp_path / "ranges.toml"
    file.write_text("stiffness = 4.0\nstiffness_range = [0.9, 1.1]\narmature_range = [0, 0.01]\n")
    config = command("--conditions", "limits", str(file), "--env.armature-range", "0,0.02").config
    scene = config.env.scene
    assert scene.stiffness == 4.0 and scene.randomisation.stiffness_range == (0.9, 1.1)
    assert scene.randomisation.armature_range == (0.0, 0.02)
    assert scene.limits.speed_limit == 0.6
    assert replace(config.env, scene=command().config.env.scene) == command().config.env


def test_the_configuration_is_the_command_line(tmp_path: Path) -> None:
    assert command("--recipe", "thesis").config == TrainConfig()
    assert command().config == recipe("fast", "vge")
    config = command(
        "--env.axis=0,0,-2", "--env.parts", "q", "touch", "--env.joint-noise", "0.02",
        "--env.sensor-latency", "0.1", "--env.push-force", "1", "--gravity", "down",
        "--env.action-latency", "0.05", "--object", "cube", "sphere",
        "--td3.exploration-noise", "0.3", "--sac.gamma", "0.9", "--env.no-scaled",
    ).config  # fmt: skip
    scene = config.env.scene
    assert config.env.task.direction == (0.0, 0.0, -1.0)
    assert config.env.parts == ("q", "touch")
    assert (scene.sensing.joint_noise, scene.push.push_force) == (0.02, 1.0)
    assert (scene.gravity, scene.object) == ("down", ("cube", "sphere"))
    assert (scene.sensing.sensor_latency, scene.limits.action_latency) == (0.1, 0.05)
    assert (config.td3.exploration_noise, config.sac.gamma, config.sac.n_step) == (0.3, 0.9, 5)
    assert not config.env.scaled  # the recipe has it on


def test_recipes_on_the_command_line() -> None:
    fast = command("--recipe", "fast", "--method", "vge+bc", "--sac.tau", "0.1").config
    assert (fast.sac.n_step, fast.sac.tau, fast.env.scaled, fast.sac.layer_norm) == (
        5, 0.1, True, True,
    )  # fmt: skip
    assert (fast.guidance.cloned, fast.guidance.beta) == ("visited", 10.0)
    assert command("--recipe", "fast", "--method", "rl").config.guidance.beta == 0.1
    with pytest.raises(UnknownName, match="'slow'; known: thesis, fast"):
        recipe("slow")


def test_help_shows_defaults_of_the_recipe_and_no_syntax(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert parse(Train, "dexctl train", ["--recipe", "thesis", "--help"]) is None
    thesis = " ".join(capsys.readouterr().out.split())
    assert parse(Train, "dexctl train", ["--help"]) is None
    fast = " ".join(capsys.readouterr().out.split())
    for text in (thesis, fast):
        assert "{None}" not in text and "--no-overlap (default" not in text
    assert "(default: 0.005)" in thesis and "(default: 0.02)" in fast


def test_who_acted_by_hand() -> None:
    row = who_acted(np.array([6, 3, 1]), np.array([1.0, 0.6, 0.4]), 2, ("igm", "gait"))
    assert row == pytest.approx(
        {"share_igm": 0.3, "share_gait": 0.1, "p_psi": 0.5,
         "p_igm": 0.3, "p_gait": 0.2}
    )  # fmt: skip
    assert set(row) <= set(columns(("igm", "gait")))
    assert who_acted(np.array([4]), np.zeros(1), 0, ()) == {}


def test_tally_by_hand() -> None:
    tally = Tally()
    info = {
        "episode_return": np.array([3.0, 9.0, 5.0]),
        "episode_length": np.array([10, 20, 30]),
        "rotation": np.array([1.0, 7.0, 2.0]),
        "dropped": np.array([True, False, False]),
        "diverged": np.zeros(3, bool),
    }
    tally.add(np.array([1.0, 2.0, 3.0]), np.array([0, 2]), info)
    tally.add(np.array([0.0, 0.0, 0.0]), np.array([], int), info)
    assert tally.row() == {
        "episodes": 2, "return": 4.0, "length": 20.0, "rotation": 1.5, "dropped": 0.5,
        "diverged": 0.0, "reward": 1.0,
    }  # fmt: skip
    assert tally.row() == {"episodes": 0}


def test_nothing_is_shown_above_an_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "empty.npz").touch()
    guide = str(tmp_path / "empty.npz")
    made = command("--recipe", "distil", "--controllers", guide, "--out", str(tmp_path / "run"))
    with pytest.raises(InvalidInput, match="is not a policy file"):
        made.run()
    assert capsys.readouterr().err == ""
