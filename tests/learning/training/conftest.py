"""Small runs, so that a training takes a second."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from dexctl.settings import changed
from learning.config import TrainConfig

SMALL: dict[str, Any] = {
    "object": "cylinder",
    "episode_steps": 30,
    "num_envs": 4,
    "steps": 200,
    "log_every": 100,
    "device": "cpu",
    **{
        f"{name}.{key}": value
        for name in ("sac", "td3")
        for key, value in {
            "network": (16,), "batch_size": 16, "learning_starts": 40, "buffer_size": 300,
        }.items()
    },
    "ppo.network": (16,),
    "ppo.rollout_steps": 8,
    "ppo.minibatches": 2,
    "ppo.epochs": 2,
}  # fmt: skip


@pytest.fixture(scope="session")
def small() -> Callable[..., TrainConfig]:
    """A configuration from settings by name, beside those of a small run."""

    def make(**settings: Any) -> TrainConfig:
        given = {name.replace("__", "."): value for name, value in settings.items()}
        return changed(TrainConfig(), SMALL | given)

    return make
