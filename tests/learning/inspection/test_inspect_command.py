"""``dexctl inspect``: of a run, of a policy file, of a controller in the policy's place."""

from __future__ import annotations

import json
import re
import shutil
import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("matplotlib")

from dexctl.cli.parsing import parse
from dexctl.exceptions import DexctlError
from dexctl.settings import changed
from learning import policies
from learning.cli.inspect import Inspect
from learning.config import TrainConfig
from learning.envs import Observation
from learning.evaluation import Protocol, evaluate, open_subject
from learning.exploration.mixture import value_probabilities
from learning.inspection import roll_out
from learning.inspection.critic import Critic, open_critic
from learning.inspection.rollout import states_of
from learning.inspection.training import read_training
from learning.policies import Policy
from learning.training.build import build_algorithm, build_env
from learning.training.run_folder import RunFolder
from learning.training.trainer import train

SMALL = {
    "object": "cylinder", "threads": 1, "steps": 240, "num_envs": 4, "log_every": 80,
    "device": "cpu", "sac.network": (16, 16), "sac.batch_size": 16, "sac.learning_starts": 40,
    "sac.buffer_size": 240,
}  # fmt: skip
SHORT = changed(Protocol(), {"episodes": 2, "threads": 1, "object": "cylinder"})

SECTIONS = (
    "What it does", "A typical episode", "How the fingers take turns", "How sound the grasp is",
    "Compared with the controllers", "What the critic thinks", "Where and why drops begin",
    "Over training", "Conditions",
)  # fmt: skip


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A real training run, as short as one can be; its policy drops the object at once."""
    folder = tmp_path_factory.mktemp("inspect") / "run"
    config = changed(TrainConfig(), SMALL | {"method": "vge", "controllers": ("igm", "gait")})
    train(config, folder)
    return folder


def run(*arguments: str) -> int:
    command = parse(Inspect, "dexctl inspect", arguments)
    assert command is not None
    return command.run()


def check_page(page: str) -> list[str]:
    """The page's headings, where it loads nothing from elsewhere."""
    assert not re.search(r"(?:src|href)=[\"'](?!data:)", page)
    assert "url(" not in page and "<script" not in page and "@import" not in page
    assert page.count("<figure") >= 7
    return re.findall(r"<h2>(.*?)</h2>", page)


def test_it_is_found_by_name() -> None:
    text = (Path(__file__).parents[3] / "pyproject.toml").read_text(encoding="utf-8")
    points = tomllib.loads(text)["project"]["entry-points"]["dexctl.commands"]
    assert EntryPoint("inspect", points["inspect"], "dexctl.commands").load() is Inspect


def test_a_run(run_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    arguments = ("--episodes", "2", "--seconds", "2", "--out", str(out), "--json")
    assert run(str(run_folder), *arguments) == 0
    found = json.loads(capsys.readouterr().out)
    assert found == json.loads((out / "inspect.json").read_text())
    page = (out / "report.html").read_text()
    assert check_page(page) == list(SECTIONS)
    assert "in-grasp manipulation" in page and "p_psi" in page
    assert found["kind"] == "run" and found["object"] == "cylinder"
    assert found["protocol"]["scene"]["object"] == ["cylinder"]
    assert found["protocol"]["seconds"] == 2.0
    assert found["angles"].keys() == {"igm", "gait"}  # those that guided it
    assert 0.0 < found["angles"]["igm"]["all"]["median_deg"] < 180.0
    candidates = found["critic"]["candidates"]
    assert list(candidates) == ["policy", "igm", "gait"]
    assert found["critic"]["checkpoint_steps"] == 240
    assert 0.0 < found["critic"]["p_psi"]["median"] < 1.0
    assert found["training"]["step"] == [80, 160, 240]
    assert found["training"]["rows"] == 3
    assert len(found["episodes"]) == 2 and found["episodes"][1]["seed"] == 1
    assert sum(found["gait"]["fingers_in_contact_share"]) == pytest.approx(1.0)
    assert sum(one["count"] for one in found["drops"]["causes"].values()) == len(
        found["drops"]["each"]
    )


def test_p_psi_is_what_training_would_find(run_folder: Path) -> None:
    """The algorithm of the whole run, restored, against the critic of the inspection."""
    subject = open_subject(str(run_folder))
    critic, remark = open_critic(subject)
    assert critic is not None and remark is None
    found = roll_out(subject, changed(SHORT, {"seconds": 0.2}), critic=critic)
    assert found.valued is not None
    assert found.valued.chances.shape == (4, 2, 3)
    config, saved = RunFolder(run_folder).config(), RunFolder(run_folder).read_checkpoint()
    assert saved is not None
    env = build_env(config)
    env.close()
    algorithm: Any = build_algorithm(config, env)
    algorithm.load_state_dict(saved["algorithm"])
    row, episode = 3, 1
    state = _state(found.trace, row, episode)
    policy = subject.controller
    assert isinstance(policy, Policy)
    observation = policy.observation(state)
    proposed = [policy.predict(observation)]
    proposed += [
        policy.action.from_change(found.shadows[name][row, episode]) for name in ("igm", "gait")
    ]
    values = algorithm.values(observation[None], np.array(proposed, np.float32)[:, None])
    expected = value_probabilities(values[:, 0])
    assert found.valued.chances[row, episode] == pytest.approx(expected, abs=1e-5)


def _state(trace: Any, row: int, episode: int) -> Any:
    from dexctl.state import GraspState

    names = ("q", "q_target", "in_contact", "contact_position", "contact_normal", "contact_force",
             "object_position", "object_quaternion")  # fmt: skip
    return GraspState(**{name: getattr(trace, name)[row, episode] for name in names})


def test_a_policy_file(
    run_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "alone.npz"
    shutil.copy(run_folder / "policy.npz", file)
    out = tmp_path / "out"
    arguments = ("--episodes", "2", "--seconds", "0.5", "--out", str(out))
    assert run(str(file), "--controller", "coordinated", "--object", "cube", *arguments) == 0
    said = capsys.readouterr()
    assert "rotation" in said.out and "coordinated gait" in said.out
    assert "has no critic" in said.err and "trained with cylinder, not with cube" in said.err
    page = (out / "report.html").read_text()
    assert check_page(page) == [name for name in SECTIONS if name != "Over training"]
    assert "There is no critic to ask" in page
    found = json.loads((out / "inspect.json").read_text())
    assert found["critic"] is None and found["training"] is None
    assert list(found["angles"]) == ["coordinated"]
    assert found["card"]["steps"] == 240


@pytest.mark.slow
def test_a_controller_in_the_policys_place(tmp_path: Path) -> None:
    """The coordinated gait against itself: no angle; against one that holds still: undefined."""
    out = tmp_path / "out"
    names = ("--controller", "coordinated", "hold")
    arguments = ("--episodes", "2", "--seconds", "3", "--object", "cylinder", "--out", str(out))
    assert run("coordinated", *names, *arguments) == 0
    found = json.loads((out / "inspect.json").read_text())
    assert found["angles"]["coordinated"]["all"]["median_deg"] == pytest.approx(0.0, abs=1e-6)
    assert found["angles"]["coordinated"]["size_ratio_median"] == pytest.approx(1.0)
    assert found["angles"]["hold"]["all"]["undefined_share"] == 1.0
    assert found["angles"]["hold"]["all"]["median_deg"] is None
    assert found["results"]["share_dropped"]["value"] == 0.0
    assert found["drops"]["each"] == []
    assert found["grasp"]["sound_share"] > 0.9
    page = (out / "report.html").read_text()
    check_page(page)
    assert "None of the 2 episodes ended with a drop" in page
    assert "Coordinated gait: dex5 turns a cylinder" in page


def test_shadows_change_nothing(run_folder: Path) -> None:
    """What is inspected does, to the bit, what it does in the evaluation, noise and all."""
    disturbed = {
        "seconds": 1.0, "axis": "-z", "object_size": 0.08, "object_mass": 0.2, "push_force": 0.5,
        "joint_noise": 0.02, "sensor_latency": 0.05, "speed_limit": 0.6, "max_reward": 0.1,
    }  # fmt: skip
    for name in (str(run_folder / "policy.npz"), "igm"):
        subject, protocol = open_subject(name), changed(SHORT, disturbed)
        found = roll_out(subject, protocol, ("igm", "gait")).evaluation
        alone = evaluate(subject, protocol)
        for figure in ("rotation", "time_held", "dropped", "returns", "drift"):
            assert (getattr(found, figure) == getattr(alone, figure)).all()


def test_shadows_turn_about_the_axis_of_the_protocol() -> None:
    """The same controller in shadow does what the one that acts does."""
    protocol = changed(SHORT, {"seconds": 0.5, "axis": "x"})
    found = roll_out(open_subject("igm"), protocol, ("igm",))
    np.testing.assert_array_equal(found.shadows["igm"], found.action)
    about_z = roll_out(open_subject("igm"), changed(protocol, {"axis": "z"}), ("igm",))
    assert not np.allclose(about_z.action, found.action)


def test_bad_input(run_folder: Path, tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    early = tmp_path / "early"
    early.mkdir()
    shutil.copy(run_folder / "config.json", early)
    broken = tmp_path / "broken.npz"
    broken.write_text("no numpy file")
    old = tmp_path / "old"
    shutil.copytree(run_folder, old)
    other = tmp_path / "other.npz"
    policy = policies.load(run_folder / "policy.npz")
    spec = policy.spec._replace(fingertip_names=("thumb",))
    policies.save(other, policy.layers, spec)
    RunFolder(old).checkpoint_path.write_bytes(b"no checkpoint")
    cases = [
        ((), "expected a run folder, a policy, or the name of a controller"),
        (("coordinate",), "unknown controller 'coordinate'; known: igm, .*, a run folder"),
        ((str(broken),), "is not a policy file"),
        ((str(tmp_path / "none.npz"),), "no such file"),
        ((str(empty),), "is no run folder: it has no config.json"),
        ((str(early),), "there is no policy.npz in it"),
        ((str(old),), "checkpoint.bin: it is no checkpoint"),
        ((str(run_folder), "--controller", "igm", "walk"), "unknown controller 'walk'; known: igm"),
        ((str(run_folder), "--object", "cube", "sphere"), "object is cube, sphere; expected one"),
        ((str(run_folder), "--object", "teapot"), "unknown object 'teapot'; known: .*cylinder"),
        ((str(other),), r"the policy is for the hand 'dex5' \(15 joints, 1 fingers\); got 'dex5'"),
        ((str(run_folder), "--hand", "paw"), "unknown hand 'paw'"),
        ((str(run_folder), "--episodes", "0"), "episodes is 0"),
        ((str(run_folder), "--seconds", "nan"), "seconds is nan"),
        ((str(run_folder), "--seed", "-1"), "seed is -1"),
    ]
    out = tmp_path / "out"
    for arguments, said in cases:
        with pytest.raises(DexctlError, match=said) as caught:
            run(*arguments, "--out", str(out))
        assert "\n" not in str(caught.value)


def test_critics_that_see_more_than_the_policy(tmp_path: Path) -> None:
    """p_psi against the run's own networks: the kept policy's actions, the critics' observation."""
    more = {
        "parts": ("q", "touch"), "scaled": True, "critic_parts": ("object_position",),
        "controllers": ("igm",), "sac.layer_norm": True, "sac.n_step": 3,
        "sac.policy_average": 0.9, "sac.learning_rate": 1e-2,
    }  # fmt: skip
    config = changed(TrainConfig(), SMALL | more)
    train(config, tmp_path / "run")
    subject = open_subject(str(tmp_path / "run"))
    critic = Critic(RunFolder(tmp_path / "run"))
    found = roll_out(subject, changed(SHORT, {"seconds": 0.5}), critic=critic)
    assert found.valued is not None and isinstance(subject.controller, Policy)
    states, own = states_of(found.trace, {}), subject.controller.observation
    other = Observation.from_dict(
        subject.controller.hand, {**own.to_dict(), "parts": ["object_position"]}
    )
    seen = np.concatenate([own(states), other(states)], axis=-1)
    kept = subject.controller.predict(own(states)).astype(np.float32)
    saved = RunFolder(tmp_path / "run").read_checkpoint()
    assert saved is not None
    env = build_env(config)
    env.close()
    algorithm: Any = build_algorithm(config, env)
    algorithm.load_state_dict(saved["algorithm"])
    least = algorithm.values(seen, kept[None])[0]
    assert found.valued.values[..., 0].ravel() == pytest.approx(least, abs=1e-4)
    assert found.trace.diagnostics["action"].reshape(-1, 15) == pytest.approx(kept, abs=1e-5)


def test_a_run_without_checkpoint_and_a_log_cut_short(run_folder: Path, tmp_path: Path) -> None:
    old = tmp_path / "old"
    shutil.copytree(run_folder, old)
    folder = RunFolder(old)
    folder.checkpoint_path.unlink()
    with folder.progress_path.open("a") as log:
        log.write("7,1")  # cut short by a kill
    log = read_training(folder)
    assert len(log) == 3 and list(log.shares()) == ["igm", "gait"]
    out = tmp_path / "out"
    assert run(str(old), "--episodes", "1", "--seconds", "0.5", "--out", str(out)) == 0
    page = (out / "report.html").read_text()
    assert "so there is no critic" in page and "Over training" in check_page(page)
    folder.progress_path.write_text("step,seconds\nx,1\n")
    with pytest.raises(DexctlError, match=r"progress\.csv is not a training log"):
        read_training(folder)
