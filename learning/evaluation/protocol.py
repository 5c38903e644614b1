"""Protocol: in which scene, for which task and how long somebody is rolled out."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from dexctl.settings import NESTED
from dexctl.sim.scene_config import SceneConfig
from dexctl.validation import check_numbers, check_whole
from learning.envs.tasks import TaskConfig


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """How somebody is rolled out.

    Episodes begin in the settled grasp, or in the states that are given, with set-points
    disturbed. The object is dropped when its centre is too far from where it started, or when the
    simulation breaks down; nothing counts after that, nor after the last of the task's goals.

    Raises:
        UnknownName, InvalidInput: a setting is wrong; the message names it.
    """

    scene: Annotated[SceneConfig, NESTED] = field(default_factory=SceneConfig)
    task: Annotated[TaskConfig, NESTED] = field(default_factory=TaskConfig)
    episodes: int = 100
    """How many episodes there are, for each object."""
    seconds: float = 60.0
    """Simulated time of each [s]."""
    seed: int = 0
    """Of the first episode; episode i has seed + i."""

    def __post_init__(self) -> None:
        check_numbers(self, positive=("seconds",))
        check_whole(self, episodes=1, seed=0)
