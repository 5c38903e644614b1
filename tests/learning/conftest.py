"""Environments and a small policy that the tests of learning share."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

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
