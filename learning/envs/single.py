"""ManipulationEnv: one hand with an object and a task."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import ArrayLike, NDArray

from dexctl.exceptions import InvalidInput
from dexctl.settings import from_plain
from dexctl.state import GraspState
from learning.envs.action import check_action
from learning.envs.config import EnvConfig
from learning.envs.rendering import RENDER_MODES
from learning.envs.vector import ManipulationVectorEnv


class ManipulationEnv(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """One environment, with the numbers that it has in a batch (see `ManipulationVectorEnv`).

    Args:
        config: what the environment is; None is made of ``options``.
        seed: of the random streams until `reset` gets one; None draws one.
        render_mode: None, "rgb_array" or "human".
        **options: settings of `EnvConfig` by name.

    Raises:
        UnknownName, InvalidInput: a setting is wrong.
        SimulationError: the hand does not hold the object.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (as gymnasium declares it)
        "render_modes": list(RENDER_MODES),
        "render_fps": 20,
    }

    def __init__(
        self,
        config: EnvConfig | None = None,
        *,
        seed: int | None = None,
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        if config is not None and options:
            raise InvalidInput(f"got a config and {', '.join(options)}; expected one or the other")
        self.batch = ManipulationVectorEnv(
            config if config is not None else from_plain(EnvConfig, options),
            1,
            seed,
            autoreset=False,
            render_mode=render_mode,
        )
        self.config = self.batch.config
        self.hand = self.batch.hand
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": self.batch.metadata["render_fps"]}
        self.observation_space = self.batch.single_observation_space
        self.action_space = self.batch.single_action_space

    @property
    def state(self) -> GraspState:
        """The true state ``()``, as controllers see it."""
        return self.batch.state[0]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin a new episode; see `ManipulationVectorEnv.reset`."""
        super().reset(seed=seed)
        observations, _ = self.batch.reset(seed=seed)
        return observations[0], {}

    def step(
        self, action: ArrayLike
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """One control step; see `ManipulationVectorEnv.step`."""
        row = check_action(action, (self.hand.nq,))[None]
        observations, reward, terminated, truncated, info = self.batch.step(row)
        single = {name: value[0] for name, value in info.items() if "final_obs" not in name}
        return observations[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), single

    def render(self) -> NDArray[np.uint8] | None:
        """A picture ``(height, width, 3)`` ("rgb_array"), or the window."""
        pictures = self.batch.render()
        return None if pictures is None else pictures[0]

    def close(self) -> None:
        """Stop the simulator and free what draws."""
        self.batch.close()
