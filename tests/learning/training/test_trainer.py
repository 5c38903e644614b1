"""The trainer: side by side with the environments, what it keeps, and how it ends."""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch")

import torch

from dexctl import hands
from dexctl.exceptions import InvalidInput
from dexctl.settings import absolute, changed
from learning import policies
from learning.algorithms import PPO, Algorithm
from learning.algorithms.off_policy import OffPolicy
from learning.config import TrainConfig
from learning.training import trainer as module
from learning.training.checkpoint import CheckpointError
from learning.training.run_folder import RunFolder
from learning.training.trainer import Trainer, TrainingDiverged, resume, train

Make = Callable[..., TrainConfig]
GUIDED = {"method": "vge+bc", "controllers": ("coordinated", "gait"), "seed": 4, "num_envs": 6}


class InTurn:
    """In the place of the pool: what is submitted is done when its result is asked for."""

    def __init__(self, *_: Any) -> None: ...

    def __enter__(self) -> InTurn:
        return self

    def __exit__(self, *_: object) -> None: ...

    def submit(self, call: Callable[..., Any], *arguments: Any) -> Any:
        class Later(Future):
            def result(self, timeout: float | None = None) -> Any:
                return call(*arguments)

        return Later()


@pytest.mark.parametrize(("overlap", "updates"), [(True, 6), (False, 8)])
def test_updates_of_a_turn_by_hand(
    small: Make, tmp_path: Path, overlap: bool, updates: int
) -> None:
    """2 updates for each turn once more than 12 transitions are there, that is from 3 steps on.

    The 4th step runs beside the first updates, or follows them: they come before its end.
    """
    config = small(**GUIDED, overlap=overlap, steps=36, sac__learning_starts=12)
    seen = []
    made = Trainer(config, RunFolder(tmp_path), lambda step, row: seen.append(made_updates()))

    def made_updates() -> int:
        return made.algorithm.updates

    made.run(None)
    made.close()
    assert seen[:6] == ([0, 0, 0, 0, 2, 4] if overlap else [0, 0, 0, 2, 4, 6])
    assert made.algorithm.updates == updates


@pytest.mark.parametrize("algorithm", ["sac", "td3"])
def test_side_by_side_equals_one_after_the_other(
    small: Make, tmp_path: Path, algorithm: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Choose, update, step, observe: with the thread it is the same, to the bit."""
    config = small(**GUIDED, algorithm=algorithm, steps=360)
    train(config, tmp_path / "thread")
    monkeypatch.setattr(module, "ThreadPoolExecutor", InTurn)
    train(config, tmp_path / "turns")
    first, second = (policies.load(tmp_path / name) for name in ("thread", "turns"))
    for ours, theirs in zip(first.layers, second.layers, strict=True):
        np.testing.assert_array_equal(ours.weight, theirs.weight)
    assert first.card["figures"]["controller_share"] > 0


def test_the_step_is_under_way_while_updating(
    small: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = Trainer(small(steps=40), RunFolder(tmp_path))
    step, update = made.env.step, made.algorithm.update
    started, updated = threading.Event(), threading.Event()
    threads = set()

    def stepping(actions: Any) -> Any:
        threads.add(threading.current_thread())
        started.set()
        assert updated.wait(30)  # in vain where updates come after the step
        return step(actions)

    def updating(**named: Any) -> None:
        assert started.wait(30)  # in vain where updates come before it
        update(**named)
        updated.set()

    monkeypatch.setattr(made.env, "step", stepping)
    monkeypatch.setattr(made.algorithm, "update", updating)
    made.run(None)
    made.close()
    assert threading.main_thread() not in threads and len(threads) == 1


@pytest.mark.parametrize("side", ["env", "updates"])
def test_an_error_on_either_side_comes_out_with_the_thread_at_rest(
    small: Make, tmp_path: Path, side: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = Trainer(small(), RunFolder(tmp_path))
    step, done = made.env.step, []

    def stepping(actions: Any) -> Any:
        if side == "env" and made.algorithm.steps > 12:
            raise ValueError("of the environment")
        time.sleep(0.01)
        done.append(step(actions))
        return done[-1]

    def updating(**_: Any) -> None:
        if side == "updates":
            raise ValueError("of the updates")

    monkeypatch.setattr(made.env, "step", stepping)
    monkeypatch.setattr(made.algorithm, "update", updating)
    with pytest.raises(ValueError, match=f"of the {side[:3]}"):
        made.run(None)
    made.close()
    assert not [t for t in threading.enumerate() if t.name.startswith("environments")]
    assert len(done) == (1 if side == "updates" else 4)  # the one under way was finished


@pytest.mark.parametrize("algorithm", ["sac", "td3"])
def test_a_policy_trained_with_all_of_it_needs_its_own_parts_only(
    small: Make, tmp_path: Path, algorithm: str
) -> None:
    own = {"n_step": 3, "layer_norm": True, "policy_delay": 2, "policy_average": 0.9}
    config = small(
        method="vge+bc", cloned="visited", cloning="squared", cloning_weight="better", beta=5,
        controllers=("coordinated",), parts=("q", "q_target", "touch"), algorithm=algorithm,
        critic_parts=("object_position", "object_quaternion"),
        **{f"{algorithm}__{name}": value for name, value in own.items()},
    )  # fmt: skip
    found = train(config, tmp_path / "run")
    assert np.isfinite(found["last"]["critic_loss"])
    policy = policies.load(found["policy"])
    assert policy.observation.parts == ("q", "q_target", "touch")
    assert policy.layers[0].weight.shape == (16, 35)
    assert resume(tmp_path / "run", 240)["steps"] == 240


def test_an_interrupted_run_saves_first_and_says_how_to_go_on(small: Make, tmp_path: Path) -> None:
    def interrupt(step: int, row: Any) -> None:
        if step == 80:
            os.kill(os.getpid(), signal.SIGINT)

    folder, before = tmp_path / "run", signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt, match="dexctl train --resume .*run` goes on"):
        train(small(), folder, report=interrupt)
    assert signal.getsignal(signal.SIGINT) is before
    saved = RunFolder(folder).read_checkpoint()
    assert saved is not None and saved["algorithm"]["steps"] in (80, 84)
    assert policies.load(folder).card["steps"] in (80, 84)


@pytest.mark.parametrize(
    ("settings", "what"),
    [
        ({"sac__network": (8,)}, "sac.network was [16], is [8]"),
        ({"object": "cube"}, "env.scene.object was ['cylinder'], is ['cube']"),
        ({"controllers": ("igm",)}, "controllers was ['gait'], is ['igm']"),
        ({"algorithm": "td3"}, "algorithm was 'sac', is 'td3'"),
        ({"critic_parts": ("object_position",)}, "env.critic_parts was []"),
    ],
)
def test_a_checkpoint_of_another_configuration_is_named(
    small: Make, tmp_path: Path, settings: dict[str, Any], what: str
) -> None:
    folder = RunFolder(tmp_path / "run")
    train(small(steps=60), folder.path)
    saved = folder.read_checkpoint()
    other = Trainer(small(**settings), folder)
    with pytest.raises(CheckpointError) as caught:
        other.run(saved)
    other.close()
    assert what in str(caught.value) and str(folder.checkpoint_path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("gone", ["env", "observation", "guide", "run", "algorithm"])
def test_a_checkpoint_that_lacks_something_is_one_line(
    small: Make, tmp_path: Path, gone: str
) -> None:
    folder = RunFolder(tmp_path / "run")
    train(small(steps=60), folder.path)
    saved = folder.read_checkpoint()
    assert saved is not None
    del saved[gone]
    folder.write_checkpoint(saved)
    with pytest.raises(CheckpointError, match="checkpoint.bin does not fit"):
        resume(folder.path, 80)


def test_a_setting_that_came_since_is_no_obstacle_at_its_default(
    small: Make, tmp_path: Path
) -> None:
    folder = RunFolder(tmp_path / "run")
    train(small(steps=60), folder.path)
    saved = folder.read_checkpoint()
    assert saved is not None
    del saved["config"]["env"]["scene"]["randomisation"]["gravity_straight_share"]
    folder.write_checkpoint(saved)
    assert resume(folder.path, 80) is not None
    del saved["config"]["env"]["scene"]["randomisation"]["gravity_tilt"]
    folder.write_checkpoint(saved)
    values = folder.config_values()
    values["env"]["scene"]["randomisation"]["gravity_tilt"] = 1.0
    folder.config_path.write_text(json.dumps(values))
    with pytest.raises(CheckpointError, match=r"gravity_tilt was 0.0, is 1.0"):
        resume(folder.path, 100)


@pytest.mark.parametrize("algorithm", ["sac", "td3"])
def test_weights_that_are_not_finite_do_not_replace_a_checkpoint(
    small: Make, tmp_path: Path, algorithm: str
) -> None:
    config = small(method="rl", algorithm=algorithm, checkpoint_every=100)
    folder, policy = RunFolder(tmp_path / "run"), []

    def spoil(step: int, row: Any) -> None:
        if step == 120:  # after the checkpoint at 100
            policy.append(folder.policy_path.read_bytes())
            with torch.no_grad():
                algorithm: Any = made.algorithm
                algorithm.critic.flat[0] = float("nan")

    made = Trainer(config, folder, spoil)
    folder.create(config)
    with pytest.raises(TrainingDiverged, match="weights are not finite") as caught:
        made.run(None)
    made.close()
    assert "the checkpoint from before is kept" in str(caught.value)
    assert folder.policy_path.read_bytes() == policy[0]
    assert resume(folder.path)["steps"] == 200  # the weights from before are fine


def test_the_controllers_turn_about_the_axis_of_the_environments(
    small: Make, tmp_path: Path
) -> None:
    made = Trainer(small(controllers=("igm",), axis="x"), RunFolder(tmp_path))
    (controller,) = made.guide.controllers
    assert controller.config.twist[3:] == pytest.approx((0.4, 0.0, 0.0))  # type: ignore[attr-defined]
    made.close()


def test_two_do_not_work_in_one_folder(small: Make, tmp_path: Path) -> None:
    train(small(steps=60), tmp_path / "run")
    with pytest.raises(InvalidInput, match="holds a run already"):
        train(small(), tmp_path / "run")


def test_no_gpu(small: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InvalidInput, match="torch finds no GPU"):
        train(changed(small(), {"device": "cuda"}), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_run_may_begin_with_the_networks_of_another(
    tmp_path: Path, small: Callable[..., TrainConfig]
) -> None:
    first = small(method="rl", steps=100)
    train(first, tmp_path / "first")
    saved = RunFolder(tmp_path / "first").read_checkpoint()
    assert saved is not None
    # other ranges, other rewards: nothing but the networks is taken over
    config = small(
        method="rl", steps=100, begin_from=tmp_path / "first", gravity_tilt=3.0, drop_cost=5.0
    )
    trainer = Trainer(config, RunFolder(tmp_path / "second"))
    trainer.begin()
    state = trainer.algorithm.state_dict()
    trainer.close()
    for name, one in saved["algorithm"]["networks"].items():
        assert torch.equal(one["flat"], state["networks"][name]["flat"]), name
    assert (state["steps"], state["updates"], len(state["replay"]["rows"])) == (0, 0, 0)


def test_a_run_from_before_tips_had_their_friction_goes_on(tmp_path: Path, small: Make) -> None:
    """Neither its configuration nor its checkpoint knows of it, and its critics do not see it."""
    config = small(method="rl", friction_range=(0.6, 1.4), critic_parts=("drawn",))
    train(replace(config, steps=100), tmp_path / "old")
    train(config, tmp_path / "whole")
    folder = RunFolder(tmp_path / "old")
    saved, values = folder.read_checkpoint(), folder.config_values()
    assert saved is not None
    drawn = saved["env"]["simulation"]["randomiser"]["drawn"]
    for scene in (values["env"]["scene"], saved["config"]["env"]["scene"]):
        for name in ("tip_friction", "link_friction"):
            del scene["randomisation"][f"{name}_range"]
            drawn.pop(name, None)
    folder.config_path.write_text(json.dumps(values))
    folder.write_checkpoint(saved)
    resume(tmp_path / "old", 200)
    both = [policies.load(tmp_path / name) for name in ("old", "whole")]
    for one, other in zip(*(policy.layers for policy in both), strict=True):
        np.testing.assert_array_equal(one.weight, other.weight)


@pytest.mark.parametrize("begins", [True, False])
def test_a_run_that_begins_with_a_policy_acts_by_it_from_the_first_step(
    begins: bool, tmp_path: Path, small: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was random until the first update, and began with drops."""
    first = tmp_path / "first"
    train(small(method="rl", steps=8), first)
    config = small(method="rl", sac__learning_starts=50, begin_from=first if begins else None)
    trainer = Trainer(config, RunFolder(tmp_path / "second"))
    trainer.begin()
    policy = torch.full((trainer.env.num_envs, 15), 0.25)
    monkeypatch.setattr(type(trainer.algorithm), "_explore", lambda algorithm, seen: policy)
    acted = trainer.algorithm.act(np.zeros((len(policy), trainer.env.observations[0].size)))
    trainer.close()
    assert (acted == 0.25).all() == begins


@pytest.mark.parametrize("rate", [None, 5e-4])
def test_rates_are_those_of_the_run_that_begins(
    rate: float | None, tmp_path: Path, small: Make
) -> None:
    """PPO took over the other run's rate, and one group of weights for two was a traceback."""
    ppo = {"method": "rl", "algorithm": "ppo", "steps": 80, "ppo__rollout_steps": 8}
    train(small(**ppo), tmp_path / "first")
    config = small(
        **ppo, begin_from=tmp_path / "first", ppo__target_kl=None, ppo__learning_rate=1e-5,
        ppo__critic_learning_rate=rate,
    )  # fmt: skip
    trainer = Trainer(config, RunFolder(tmp_path / "second"))
    trainer.begin()
    assert isinstance(trainer.algorithm, PPO)
    found = [group["lr"] for group in trainer.algorithm.optimizer.param_groups]
    trainer.close()
    assert found == ([1e-5] if rate is None else [1e-5, rate])


def equal_layers(algorithm: Algorithm, policy: policies.Policy) -> None:
    for own, other in zip(algorithm.policy_layers(), policy.layers, strict=True):
        np.testing.assert_array_equal(own[0], other.weight)
        np.testing.assert_array_equal(own[1], other.bias)


@pytest.mark.parametrize("algorithm", ["sac", "td3"])
def test_a_run_may_begin_with_a_policy_whose_worth_is_learned_first(
    algorithm: str, tmp_path: Path, small: Make
) -> None:
    train(small(method="rl", steps=40), tmp_path / "first")
    begun_from = tmp_path / "first" / "policy.npz"
    begun = policies.load(begun_from)
    config = small(
        method="rl", algorithm=algorithm, steps=160, begin_from=begun_from,
        **{f"{algorithm}__learning_starts": 20, f"{algorithm}__actor_starts": 80},
    )  # fmt: skip
    said: list[str] = []
    trainer = Trainer(config, RunFolder(tmp_path / "second"), remark=said.append)
    trainer.begin()
    assert [text for text in said if "falls before it rises" in text and str(begun_from) in text]
    assert isinstance(trainer.algorithm, OffPolicy)
    critics = trainer.algorithm.networks["critic"].flat.clone()
    with ThreadPoolExecutor(1) as pool:
        while trainer.algorithm.steps < 80:
            trainer.turn(pool)
        equal_layers(trainer.algorithm, begun)
        assert not torch.equal(critics, trainer.algorithm.networks["critic"].flat)
        seen = np.zeros((trainer.env.num_envs, trainer.env.observations[0].size), np.float32)
        drawn = np.array([trainer.algorithm.act(seen) for _ in range(200)])
        if algorithm == "sac":  # as told, about the policy's own actions
            off = np.arctanh(drawn) - np.arctanh(begun.predict(np.zeros(begun.observation.size)))
            assert abs(off.std() - 0.1) < 0.01 and abs(off.mean()) < 0.01
        while trainer.algorithm.steps < 160:
            trainer.turn(pool)
    assert not np.array_equal(trainer.algorithm.policy_layers()[0][0], begun.layers[0].weight)
    trainer.close()


def test_ppo_may_begin_with_a_policy(tmp_path: Path, small: Make) -> None:
    """It was refused. What a policy is worth is not in its file, so the critic learns first."""
    train(small(method="rl", steps=40), tmp_path / "first")
    begun = policies.load(tmp_path / "first")
    config = small(
        method="rl", algorithm="ppo", steps=320, begin_from=tmp_path / "first" / "policy.npz",
        ppo__critic_steps=160, ppo__rollout_steps=8, ppo__initial_deviation=0.1,
    )  # fmt: skip
    trainer = Trainer(config, RunFolder(tmp_path / "second"))
    trainer.begin()
    assert isinstance(trainer.algorithm, PPO)
    critic = trainer.algorithm.critic.flat.clone()
    group = trainer.algorithm.optimizer.param_groups[0]
    with ThreadPoolExecutor(1) as pool:
        while trainer.algorithm.steps < 160:
            trainer.turn(pool)
        equal_layers(trainer.algorithm, begun)
        assert not torch.equal(critic, trainer.algorithm.critic.flat)
        assert group["lr"] == config.ppo.learning_rate
        # a checkpoint knows that the actor takes observations as they are
        other = Trainer(config, RunFolder(tmp_path / "third"))
        other.algorithm.load_state_dict(trainer.algorithm.state_dict())
        assert isinstance(other.algorithm, PPO)
        assert set(other.algorithm.normalisations) == {"critic"}
        other.close()
        while trainer.algorithm.steps < 320:
            trainer.turn(pool)
    assert not np.array_equal(trainer.algorithm.policy_layers()[0][0], begun.layers[0].weight)
    trainer.close()


@pytest.mark.parametrize("slow", ["dex5-cylinder@0.8", "runs/mine@0.8", "mine.npz@.5"])
def test_networks_to_begin_with_have_no_pace(slow: str, small: Make) -> None:
    with pytest.raises(InvalidInput, match=f"begin_from is {slow}; .* expected .* without a pace"):
        small(method="rl", begin_from=Path(slow))


def test_a_policy_to_begin_with_keeps_its_name_and_a_run_is_absolute(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    for given, expected in (
        ("dex5-easy", Path("dex5-easy")),
        ("run", tmp_path / "run"),
        ("other.npz", tmp_path / "other.npz"),
        ("runs/gone", tmp_path / "runs" / "gone"),
    ):
        config = changed(TrainConfig(), {"begin_from": Path(given)})
        assert absolute(config, tmp_path).begin_from == expected


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({}, "actor_starts is 0; .* expected more than learning_starts, "),
        ({"sac__network": (64,)}, r"layers of .65, 256, 256, 15.; expected .65, 64, 15."),
        ({"max_speed": 1.0}, "the policy has max_speed 2.0; expected 1.0"),
        ({"parts": ("q", "q_target")}, "the policy has parts .*; expected .'q', 'q_target'."),
        ({"algorithm": "ppo"}, "critic_steps is 0; .* expected some, such as 500000"),
    ],
)
def test_a_policy_that_a_run_cannot_begin_with(
    changes: dict[str, Any], text: str, tmp_path: Path, small: Make
) -> None:
    starts = {} if not changes else {"sac__actor_starts": 10_000}
    values = {"method": "rl", "begin_from": Path("dex5-cylinder"), "scaled": True}
    config = small(**values | starts | changes)
    with pytest.raises(InvalidInput, match=f"begin_from is dex5-cylinder: .*{text}"):
        train(config, tmp_path / "second")
    assert not (tmp_path / "second").exists()


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"parts": ("q", "q_target")}, "begin_from is .*first: the saved actor has layers"),
        ({"algorithm": "td3"}, "begin_from is .*first: the saved algorithm is sac; expected td3"),
        ({"begin_from": Path("nowhere")}, "begin_from is nowhere: unknown policy 'nowhere'"),
    ],
)
def test_networks_that_do_not_fit(
    changes: dict[str, Any], text: str, tmp_path: Path, small: Callable[..., TrainConfig]
) -> None:
    train(small(method="rl", steps=8), tmp_path / "first")
    config = small(**{"method": "rl", "begin_from": tmp_path / "first"} | changes)
    with pytest.raises(InvalidInput, match=text):
        train(config, tmp_path / "second")
    assert not (tmp_path / "second").exists()


def test_the_hand_of_a_run_is_found_from_another_folder(
    small: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hands.config("dex5").write(tmp_path / "mine.toml")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path)
    train(small(hand="mine.toml", steps=120), tmp_path / "run")
    monkeypatch.chdir(tmp_path / "elsewhere")
    mine = str(tmp_path.resolve() / "mine.toml")
    assert RunFolder(tmp_path / "run").config().env.scene.hand == mine
    policy = policies.load(tmp_path / "run" / "policy.npz")
    assert str(policy.hand.config.source) == policy.spec.hand == mine
    assert policy.card["trained"]["env"]["scene"]["hand"] == mine
