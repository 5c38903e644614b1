"""Watching a run in MuJoCo's viewer."""

from __future__ import annotations

import os
import sys
import time as clock
from typing import Any

import mujoco
import numpy as np

from dexctl.exceptions import SimulationError
from dexctl.sim.scene import Scene
from dexctl.sim.visuals import visual_model


class Viewer:
    """A window that shows one environment, no faster than real time.

    Give it to `run` as an observer.

    Closing the window does not end the run: it goes on unseen, at full speed.

    Args:
        scene: what is shown.
        env: which environment.

    Raises:
        SimulationError: there is no display to open a window on.
    """

    def __init__(self, scene: Scene, env: int = 0) -> None:
        if not has_display():
            raise SimulationError(
                "the viewer needs a display, and neither DISPLAY nor WAYLAND_DISPLAY is set; "
                "record a video instead, or connect with ssh -X"
            )
        import mujoco.viewer  # loads the window system, which a headless machine may lack

        self._env = env
        self._model = visual_model(scene)
        self._data = mujoco.MjData(self._model)
        try:
            self._window = mujoco.viewer.launch_passive(
                self._model, self._data, show_left_ui=False, show_right_ui=False
            )
        except RuntimeError as error:
            raise SimulationError(f"the viewer cannot open a window: {error}") from None
        self._started: tuple[float, float] | None = None

    @property
    def is_open(self) -> bool:
        """Whether the window is still there."""
        return self._window.is_running()

    def __call__(self, sim: Any) -> None:
        """Show where ``sim`` is now, and wait until real time has caught up."""
        if not self.is_open:
            return
        simulated = float(np.atleast_1d(sim.time)[self._env])
        if self._started is None or simulated < self._started[1]:
            self._started = (clock.monotonic(), simulated)
        ahead = simulated - self._started[1] - (clock.monotonic() - self._started[0])
        if ahead > 0:
            clock.sleep(ahead)
        self._data.qpos[:] = np.atleast_2d(sim.qpos)[self._env]
        mujoco.mj_forward(self._model, self._data)
        self._window.sync()

    def close(self) -> None:
        """Close the window."""
        self._window.close()

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def has_display() -> bool:
    """Whether there is a display to open a window on."""
    if not sys.platform.startswith("linux"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
