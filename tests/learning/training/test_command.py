"""`dexctl train`: what it leaves behind, and what it says to bad input."""

from __future__ import annotations

import csv
import json
import os
import pickle
import signal
import tomllib
from dataclasses import fields
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("stable_baselines3")

import learning
from dexctl.cli.parsing import parse
from dexctl.exceptions import DexctlError, InvalidInput, UnknownName
from learning.agents import state
from learning.cli_env_options import EnvOptions
from learning.cli_train import Train
from learning.envs import EnvConfig, InitialStates
from learning.export import policy_layers
from learning.settings import TrainConfig
from learning.train import TrainingDiverged, build, train
from learning.training import checkpoint
from learning.training.log import Tally, columns, who_acted

SMALL = (
    "--num-envs", "4", "--steps", "200", "--network", "16", "16", "--batch-size", "16",
    "--learning-starts", "40", "--buffer-size", "100", "--log-every", "100", "--device", "cpu",
    "--recipe", "thesis",
)  # fmt: skip


def test_it_is_found_by_name() -> None:
    text = (Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8")
    points = tomllib.loads(text)["project"]["entry-points"]["dexctl.commands"]
    assert EntryPoint("train", points["train"], "dexctl.commands").load() is Train


def command(*arguments: str) -> Train:
    found = parse(Train, "dexctl train", arguments)
    assert found is not None
    return found


def test_a_run_leaves_logs_a_checkpoint_and_a_policy(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "run"
    assert (
        command(*SMALL, "--object", "cylinder", "sphere", "--out", str(folder), "--json").run() == 0
    )
    printed = json.loads(capsys.readouterr().out)
    assert printed["steps"] == 200 and printed["last"]["step"] == 200
    with (folder / "progress.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["step"] for row in rows] == ["100", "200"]
    assert list(rows[0]) == list(columns(("gait",)))
    assert float(rows[0]["share_gait"]) == float(rows[0]["controller_share"])
    assert 0.0 < float(rows[0]["p_psi"]) == float(rows[0]["p_gait"]) < 1.0
    assert 0.0 <= float(rows[0]["controller_share"]) <= 1.0
    assert list((folder / "tensorboard").iterdir())
    policy = learning.load_policy(folder / "policy.npz")
    assert policy.card["steps"] == 200
    config = TrainConfig.from_dict(json.loads((folder / "config.json").read_text()))
    assert config.env.objects == ("cylinder", "sphere")
    assert TrainConfig.from_dict(policy.card["trained"]) == config
    with pytest.raises(InvalidInput, match="holds a run already"):
        command(*SMALL, "--out", str(folder)).run()


@pytest.mark.parametrize("algorithm", ["sac", "td3"])
def test_the_file_does_what_the_network_does(algorithm: str) -> None:
    """The layers written for numpy against the actor in torch."""
    import torch

    agent = build(command(*SMALL, "--algorithm", algorithm, "--method", "rl").config())
    obs = np.random.default_rng(0).normal(size=(5, *agent.observation_space.shape))  # type: ignore[misc]
    with torch.no_grad():
        expected, _ = agent.predict(obs.astype(np.float32), deterministic=True)
    x = obs
    layers = policy_layers(agent)
    for i, (weight, bias) in enumerate(layers):
        x = x @ weight.T + bias
        x = np.maximum(x, 0.0) if i + 1 < len(layers) else np.tanh(x)
    assert x == pytest.approx(expected, abs=1e-5)
    agent.env.close()  # type: ignore[union-attr]


def test_an_interrupted_run_saves_first(tmp_path: Path) -> None:
    calls = []

    def interrupt(step: int, row: Any) -> None:
        calls.append(step)
        if step == 80:
            os.kill(os.getpid(), signal.SIGINT)

    config = command(*SMALL, "--object", "cylinder").config()
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        train(config, tmp_path / "run", report=interrupt)
    assert signal.getsignal(signal.SIGINT) is before
    saved = checkpoint.read(tmp_path / "run" / "checkpoint.bin")
    assert saved["counters"]["num_timesteps"] == calls[-1] <= 84
    other = build(command(*SMALL, "--network", "8", "--object", "cylinder").config())
    with pytest.raises(checkpoint.CheckpointError, match="does not fit this configuration"):
        state.restore(other, saved)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("--object teapot", "unknown object 'teapot'; known: .*cylinder"),
        ("--hand paw", "unknown hand 'paw'"),
        ("--method dagger", "unknown method 'dagger'; known: rl, rl\\+bc, fge, vge, vge\\+bc"),
        ("--controller walk", "unknown controller 'walk'; known: igm"),
        ("--algorithm ppo", "unknown algorithm 'ppo'; known: sac, td3"),
        ("--device tpu", "unknown device 'tpu'; known: auto, cpu, cuda"),
        ("--steps 0", "steps is 0; expected a whole number from 1 on"),
        ("--num-envs -1", "num_envs is -1"),
        ("--gamma 1.5", "gamma is 1.5; expected a number from 0 to 1"),
        ("--learning-rate nan", "learning_rate is nan"),
        ("--network 0", "network is \\(0,\\)"),
        ("--buffer-size 64", "buffer_size is 64; expected at least one batch"),
        ("--env.axis w", "unknown axis 'w'; known: x, y, z"),
        ("--env.axis=1,2", "--env.axis is '1,2'; expected x, y, z, or three numbers"),
        ("--env.parts q smell", "unknown observation part 'smell'; known: q, q_target"),
        ("--env.latency nan", "latency is nan"),
        ("--env.initial-states none.npz", "initial_states '.*none.npz' cannot be read"),
        ("--seed -1", "seed is -1"),
        ("--recipe slow", "unknown recipe 'slow'; known: thesis, fast"),
        ("--method rl+bc --controller igm gait", "'rl\\+bc' has the controllers igm, gait at once"),
        ("--resume /nowhere/at/all", "there is no run in /nowhere/at/all"),
    ],
)
def test_bad_input(tmp_path: Path, arguments: str, said: str) -> None:
    folder = tmp_path / "run"
    with pytest.raises(DexctlError, match=said) as caught:
        command(*arguments.split(), "--out", str(folder)).run()
    assert "\n" not in str(caught.value)
    assert not folder.exists()


def test_every_setting_of_the_environments_has_a_flag(tmp_path: Path) -> None:
    plain = command("--recipe", "thesis").config().env
    assert plain == EnvConfig()
    own = {"hand", "object", "gravity", "episode_steps", "scaled"}
    known = {field.name for field in fields(EnvOptions)}
    assert known | own == {field.name for field in fields(EnvConfig)}
    assert not known & own
    assert own <= {field.name for field in fields(Train)}
    states = tmp_path / "states.npz"
    InitialStates(
        q=np.zeros((1, 1)),
        q_target=np.zeros((1, 1)),
        object_position=np.zeros((1, 3)),
        object_quaternion=np.eye(4)[:1],
        object=np.array(["cube"]),
        joint_names=np.array(["j"]),
    ).save(states)
    env = command(
        "--env.axis=0,0,-2", "--env.parts", "q", "touch", "--env.joint-noise", "0.02",
        "--env.latency", "0.1", "--env.push-force", "1", "--env.initial-states", str(states),
        "--gravity", "down", "--object", "cube", "sphere",
    ).config().env  # fmt: skip
    assert env.direction == (0.0, 0.0, -1.0)
    assert env.parts == ("q", "touch")
    assert (env.joint_noise, env.push_force, env.latency_steps) == (0.02, 1.0, 2)
    assert (env.gravity, env.objects) == ("down", ("cube", "sphere"))
    assert env.initial_states == str(states)


def test_the_controllers_turn_about_the_axis_of_the_environments() -> None:
    agent = build(command(*SMALL, "--controller", "igm", "--env.axis", "x").config())
    assert agent.guide is not None
    (controller,) = agent.guide.controllers
    assert controller.config.twist[3:] == pytest.approx((0.4, 0.0, 0.0))  # type: ignore[attr-defined]
    agent.env.close()  # type: ignore[union-attr]


@pytest.mark.parametrize("algorithm", ["sac", "td3"])
def test_weights_that_are_not_finite_do_not_replace_a_checkpoint(
    tmp_path: Path, algorithm: str
) -> None:
    folder = tmp_path / "run"
    first = "--method", "rl", "--algorithm", algorithm, "--checkpoint-every", "100"
    config = command(*SMALL, "--object", "cylinder", *first).config()
    policy: list[bytes] = []

    def spoil(agent: Any, step: int) -> None:
        import torch

        if step == 120:  # after the checkpoint at 100
            policy.append((folder / "policy.npz").read_bytes())
            with torch.no_grad():
                next(agent.critic.parameters())[0] = float("nan")

    agents = []

    def built(config: TrainConfig) -> Any:
        agents.append(build(config))
        return agents[0]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("learning.train.build", built)
        with pytest.raises(TrainingDiverged, match="weights are not finite") as caught:
            train(config, folder, report=lambda step, row: spoil(agents[0], step))
    assert "the checkpoint from before is kept" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert checkpoint.read(folder / "checkpoint.bin")["counters"]["num_timesteps"] == 100
    assert (folder / "policy.npz").read_bytes() == policy[0]
    command("--resume", str(folder)).run()  # the weights from before are fine
    assert checkpoint.read(folder / "checkpoint.bin")["counters"]["num_timesteps"] == 200


def test_a_policy_can_guide(tmp_path: Path) -> None:
    """Checkpoints hold the controllers, so a policy in a controller's place must pickle."""
    from dexctl import hands
    from learning import policies

    policy = policies.learned(hands.load("dex5"))
    again = pickle.loads(pickle.dumps(policy))
    seen = np.linspace(-1, 1, policy.observation.size)
    assert (again.predict(seen) == policy.predict(seen)).all()


def test_no_gpu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InvalidInput, match="torch finds no GPU"):
        command(*SMALL, "--device", "cuda", "--out", str(tmp_path / "run")).run()


def test_configurations_from_files() -> None:
    config = TrainConfig(controllers=("igm", "gait"))
    assert TrainConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config
    with pytest.raises(InvalidInput, match="no training configuration"):
        TrainConfig.from_dict({**config.to_dict(), "colour": "red"})
    with pytest.raises(UnknownName, match="unknown controller"):
        TrainConfig(controllers=("igm", "crawl"))


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
