"""Pictures of the environments: offscreen, or in MuJoCo's viewer."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from dexctl.sim import GroupedSimulator

RENDER_MODES = ("rgb_array", "human")


class Renderer:
    """Draws the first environment of each object; a window shows the first of all.

    Args:
        sim: what is drawn.
        mode: one of `RENDER_MODES`.

    Raises:
        MissingExtra: pictures need the extra "viz".
        SimulationError: there is no OpenGL, or no display; the message says what helps.
    """

    def __init__(self, sim: GroupedSimulator, mode: str) -> None:
        from dexctl.sim import Recorder, Viewer

        self._sim = sim
        self._viewer = Viewer(sim.groups[0].scene) if mode == "human" else None
        self._recorders = (
            [Recorder(group.scene, None) for group in sim.groups] if mode == "rgb_array" else []
        )

    def draw(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Pictures ``(height, width, 3)``, one for each object; None where there is a window."""
        if self._viewer is not None:
            self._viewer(self._sim.groups[0])
            return None
        pictures = []
        for recorder, group in zip(self._recorders, self._sim.groups, strict=True):
            recorder(group)
            pictures.append(recorder.picture())
        return tuple(pictures)

    def close(self) -> None:
        """Free the window or the drawing contexts."""
        if self._viewer is not None:
            self._viewer.close()
        for recorder in self._recorders:
            recorder.close()
