"""Training on a GPU: it learns, goes on where it was stopped, and the other device goes on, too."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch")

import torch

from learning import policies
from learning.algorithms import Transitions, make
from learning.config import TrainConfig
from learning.training.trainer import resume, train

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU here")
Make = Callable[..., TrainConfig]
METHODS = {"ppo": "rl", "dagger": "rl+bc", "sac": "vge+bc", "td3": "vge"}


def config(small: Make, name: str, **settings: Any) -> TrainConfig:
    guided: dict[str, Any] = (
        {} if name == "ppo" else {"controllers": ("coordinated",), "hard_stop": None}
    )
    guided["dagger.learning_rate_end"] = None  # a rate that falls falls later in a longer run
    return small(algorithm=name, method=METHODS[name], device="auto", **guided, **settings)


def weights(path: Path) -> list[np.ndarray]:
    return [layer.weight for layer in policies.load(str(path / "policy.npz")).layers]


@pytest.mark.parametrize("name", METHODS)
def test_a_run_goes_on_where_it_was_stopped(name: str, small: Make, tmp_path: Path) -> None:
    train(config(small, name, steps=320), tmp_path / "whole")
    train(config(small, name, steps=160), tmp_path / "cut")
    before = weights(tmp_path / "cut")
    resume(tmp_path / "cut", 320)
    for whole, cut in zip(weights(tmp_path / "whole"), weights(tmp_path / "cut"), strict=True):
        np.testing.assert_allclose(cut, whole, rtol=1e-3, atol=1e-4)
    assert any((a != b).any() for a, b in zip(before, weights(tmp_path / "cut"), strict=True))


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("first", [True, False], ids=["gpu first", "processor first"])
def test_the_other_device_goes_on(
    name: str, first: bool, small: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: first)
    train(config(small, name, steps=160), tmp_path / "run")
    before = weights(tmp_path / "run")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: not first)
    assert resume(tmp_path / "run", 320)["steps"] == 320
    assert any((a != b).any() for a, b in zip(before, weights(tmp_path / "run"), strict=True))


@pytest.mark.parametrize("name", ["sac", "td3", "dagger"])
def test_it_computes_what_a_processor_does(name: str) -> None:
    sizes: dict[str, Any] = {
        "groups": {"policy": slice(0, 6), "critic": slice(0, 8)}, "observation_size": 8,
        "action_size": 3, "num_envs": 16, "labels": name == "dagger",
    }  # fmt: skip
    here, there = (
        make(getattr(TrainConfig(), name), **sizes, device=device) for device in ("cpu", "cuda")
    )
    there.load_state_dict(here.state_dict())
    rng = np.random.default_rng(0)
    seen = rng.standard_normal((16, 8)).astype(np.float32)
    action = rng.uniform(-1, 1, (16, 3)).astype(np.float32)
    if name in ("sac", "td3"):
        np.testing.assert_allclose(
            there.values(seen, action[None]), here.values(seen, action[None]), rtol=1e-4, atol=1e-5
        )
    if name == "dagger":  # nothing in its updates is drawn but the batch, by numpy
        nothing = np.zeros(16, bool)
        step = Transitions(
            seen, action, np.zeros(16), seen, nothing, nothing, np.ones(16, bool), action
        )
        for agent in (here, there):
            agent.observe(step)
            for _ in range(20):
                agent.update()
    for ours, theirs in zip(here.policy_layers(), there.policy_layers(), strict=True):
        np.testing.assert_allclose(theirs[0], ours[0], rtol=1e-3, atol=1e-4)
