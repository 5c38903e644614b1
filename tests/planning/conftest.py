"""What the planning tests share: one scene, and one small tree grown in it."""

from __future__ import annotations

import pytest

from dexctl.planning import RandomActions, Tree, grow
from dexctl.sim import Scene


@pytest.fixture(scope="session")
def cylinder() -> Scene:
    return Scene.build("dex5", "cylinder", "up")


@pytest.fixture(scope="session")
def small(cylinder: Scene) -> Tree:
    """A tree of random actions, of about twenty nodes."""
    return grow(cylinder, RandomActions(batch=8), nodes=20, seed=1, threads=1)
