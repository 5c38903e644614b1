"""Simulation and updates side by side: what that means, and that it repeats to the bit."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

import pytest

pytest.importorskip("torch")
pytest.importorskip("stable_baselines3")

import torch
from stable_baselines3.common.callbacks import BaseCallback

from learning.agents import GuidedSAC, GuidedTD3, loop
from learning.envs import EnvConfig
from learning.exploration import GuidanceConfig
from learning.settings import TrainConfig
from learning.train import build

N = 6


def agent(**options: Any) -> GuidedSAC | GuidedTD3:
    """An agent of 6 small environments, which updates from the 12th step on."""
    options = {
        "guidance": GuidanceConfig(method="vge+bc"), "controllers": ("coordinated", "gait"),
        **options,
    }  # fmt: skip
    config = TrainConfig(
        env=EnvConfig(object="cylinder", episode_steps=30),
        num_envs=N, seed=4, network=(16,), batch_size=16, learning_starts=12, buffer_size=300,
        device="cpu", **options,
    )  # fmt: skip
    return build(config)


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


class Watch(BaseCallback):
    """What is remembered, and how often was updated, when a step has been done."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[tuple[int, int]] = []

    def _on_step(self) -> bool:
        assert isinstance(self.model, GuidedSAC | GuidedTD3)
        assert self.model.replay_buffer is not None
        self.seen.append((self.model.replay_buffer.size() * N, self.model._n_updates))
        return True


@pytest.mark.parametrize(("overlap", "updates"), [(True, 6), (False, 8)])
def test_updates_of_a_turn_by_hand(overlap: bool, updates: int) -> None:
    """2 updates for each turn once more than 12 transitions are there, that is from 3 steps on.

    The 4th step runs beside the first updates, or follows them: they come before its end.
    """
    watch = Watch()
    learner = agent(overlap=overlap)
    learner.learn(6 * N, callback=watch)
    assert watch.seen == [(i * N, count) for i, count in enumerate([0, 0, 0, 2, 4, 6])]
    assert learner._n_updates == updates
    assert learner.replay_buffer is not None and learner.replay_buffer.size() == 6


@pytest.mark.parametrize("algorithm", ["sac", "td3"])
def test_side_by_side_equals_one_after_the_other(
    algorithm: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Choose, update, step, remember: with the thread it is the same, to the bit."""
    first = agent(algorithm=algorithm)
    first.learn(60 * N)
    monkeypatch.setattr(loop, "ThreadPoolExecutor", InTurn)
    second = agent(algorithm=algorithm)
    second.learn(60 * N)
    for a, b in zip(first.policy.parameters(), second.policy.parameters(), strict=True):
        assert torch.equal(a, b)
    assert first.replay_buffer is not None and second.replay_buffer is not None
    ours, theirs = first.replay_buffer.state_dict(), second.replay_buffer.state_dict()
    assert torch.equal(ours["rows"], theirs["rows"])
    assert first.guide is not None and second.guide is not None
    assert first.guide.acted.tolist() == second.guide.acted.tolist()
    assert first.guide.acted[1:].min() > 0 and first._n_updates > 100
    assert first._episode_num == second._episode_num > 0


def test_the_step_is_under_way_while_updating(monkeypatch: pytest.MonkeyPatch) -> None:
    learner = agent()
    assert learner.env is not None
    step, train = learner.env.step, learner.train
    started, updated = threading.Event(), threading.Event()
    threads = set()

    def stepping(actions: Any) -> Any:
        threads.add(threading.current_thread())
        started.set()
        if learner.num_timesteps > 12:
            assert updated.wait(30)  # in vain where updates come after the step
        return step(actions)

    def updating(*arguments: Any, **named: Any) -> None:
        assert started.wait(30)  # in vain where updates come before it
        train(*arguments, **named)
        updated.set()

    monkeypatch.setattr(learner.env, "step", stepping)
    monkeypatch.setattr(learner, "train", updating)
    learner.learn(4 * N)
    assert started.is_set() and updated.is_set()
    assert threading.main_thread() not in threads and len(threads) == 1


@pytest.mark.parametrize("side", ["env", "updates"])
def test_an_error_on_either_side_comes_out_with_the_thread_at_rest(
    side: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    learner = agent()
    assert learner.env is not None
    step, done = learner.env.step, []

    def stepping(actions: Any) -> Any:
        if side == "env" and learner.num_timesteps > 12:
            raise ValueError("of the environment")
        time.sleep(0.01)
        done.append(step(actions))
        return done[-1]

    def updating(*_: Any, **__: Any) -> None:
        if side == "updates":
            raise ValueError("of the updates")

    monkeypatch.setattr(learner.env, "step", stepping)
    monkeypatch.setattr(learner, "train", updating)
    with pytest.raises(ValueError, match=f"of the {side[:3]}"):
        learner.learn(10 * N)
    assert not [t for t in threading.enumerate() if t.name.startswith("environments")]
    assert len(done) == (4 if side == "updates" else 3)  # the one under way was finished


def test_other_frequencies_are_refused() -> None:
    learner = agent(guidance=GuidanceConfig(method="rl"))
    learner.gradient_steps = -1
    with pytest.raises(NotImplementedError, match="train_freq must be 1 step"):
        learner.learn(N)
