"""Environments and a small policy that the tests of learning share."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

if TYPE_CHECKING:
    from learning.config import TrainConfig

# without the extra "learning" there is nothing here to test
collect_ignore_glob = ["test_*.py"] if find_spec("gymnasium") is None else []


@pytest.fixture
def in_scratch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working directory (MuJoCo writes a log file where it stands)."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def wiggle() -> np.ndarray:
    """Actions ``(40, 15)`` that move every joint a little, the same for every environment."""
    steps = np.arange(40)[:, None]
    return 0.3 * np.sin(0.7 * steps + np.arange(15))


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
    "dagger.network": (16,),
    "dagger.batch_size": 16,
    "ppo.network": (16,),
    "ppo.rollout_steps": 8,
    "ppo.minibatches": 2,
    "ppo.epochs": 2,
}  # fmt: skip


@pytest.fixture(scope="session")
def small() -> Callable[..., TrainConfig]:
    """A configuration from settings by name, beside those of a run of a second."""
    from dexctl.settings import changed
    from learning.config import TrainConfig

    def make(**settings: Any) -> TrainConfig:
        given = {name.replace("__", "."): value for name, value in settings.items()}
        return changed(TrainConfig(), SMALL | given)

    return make
