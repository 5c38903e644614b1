"""GravityStarts: gravity grows while the training goes on (gravity curriculum)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from learning.envs.vector import ManipulationVectorEnv
from learning.starts.base import Remark, Starts
from learning.starts.config import StartsConfig

_STAGES = 100  # gravity is changed in so many stages


class GravityStarts(Starts):
    """Episodes begin as ever, under gravity that grows from none to all (thesis chapter 5, GC).

    Args:
        env: the environments.
        config: the settings.
    """

    def __init__(self, env: ManipulationVectorEnv, config: StartsConfig) -> None:
        super().__init__(env)
        self._steps, self._stage = config.gravity_steps, -1

    def begin(self, path: Path, remark: Remark) -> None:
        self._follow(0)

    def after_step(self, step: int, done: Any) -> None:
        self._follow(step)

    def _follow(self, step: int) -> None:
        stage = min(_STAGES, step * _STAGES // self._steps)
        if stage != self._stage:
            self._stage = stage
            self.env.simulation.scale_gravity(stage / _STAGES)

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        self._stage = -1  # the next step sets it again
