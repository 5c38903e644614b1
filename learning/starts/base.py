"""Starts: what decides where episodes begin while a training goes on."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from learning.envs.vector import ManipulationVectorEnv

Remark = Callable[[str], None]


class Starts:
    """Episodes begin where the environments' configuration says; what others build on.

    Args:
        env: the environments.

    Attributes:
        env: as given.
    """

    def __init__(self, env: ManipulationVectorEnv) -> None:
        self.env = env

    def begin(self, path: Path, remark: Remark) -> None:
        """Before the first step, of a training that is resumed too.

        Args:
            path: of the file for states that are made for the training; where it is there, they
                are read from it.
            remark: called with what people should know.
        """

    def after_step(self, step: int, done: Any) -> None:
        """After each step of all environments; ``done`` ``(N,)`` says whose episode it ended."""

    def state_dict(self) -> dict[str, Any]:
        """All that decides the future, as arrays and plain values."""
        return {}

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Continue from what `state_dict` gave."""
