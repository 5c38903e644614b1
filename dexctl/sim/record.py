"""Recording: videos and still pictures of a run."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import ModuleType
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from dexctl.exceptions import InvalidInput, MissingExtra
from dexctl.sim import checks
from dexctl.sim.offscreen import Offscreen
from dexctl.sim.scene import Scene
from dexctl.sim.settle_failure import SettleFailure
from dexctl.sim.visuals import CAMERA, colour_fingertips, fingertip_geoms, visual_model
from dexctl.state import Bools, Floats


class Recorder:
    """Films one environment; give it to `run` as an observer.

    The video is written beside its place and moved there when it is closed, so that an
    interrupted run leaves a complete (shorter) file. Where the simulator is reset, or another one
    with the same scene goes on, the film does too.

        with Recorder(scene, "out/cube.mp4") as recorder:
            run(controller, sim, 10.0, observers=[recorder])
            recorder.picture("out/cube.png")

    Args:
        scene: what is filmed.
        path: the mp4 file; None takes no video, `picture` still works.
        env: which environment.
        fps: pictures per simulated second; between control steps, joints are interpolated.
        width, height: of the picture, even numbers [pixels].

    Attributes:
        caption: a line of text in the picture; change it at any time.
        path: as given.

    Raises:
        MissingExtra: imageio with ffmpeg is not installed (extra "viz").
        SimulationError: there is no OpenGL to draw with; the message says how to get it. Callers
            go on without a video.
    """

    def __init__(
        self,
        scene: Scene,
        path: str | Path | None,
        *,
        env: int = 0,
        fps: float = 15.0,
        width: int = 800,
        height: int = 600,
    ) -> None:
        for name, value in (("width", width), ("height", height)):
            if checks.count(name, value) % 2 or value > 1920:
                raise InvalidInput(f"{name} is {value}; expected an even number up to 1920")
        self._imageio = _imageio()
        self.path = None if path is None else Path(path)
        self.caption = ""
        self._env = env
        self._period = 1.0 / checks.positive("fps", fps)
        model = visual_model(scene)
        self._data = mujoco.MjData(model)
        self._offscreen = Offscreen(model, width, height)
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._camera.fixedcamid = model.camera(CAMERA).id
        self._option = mujoco.MjvOption()
        self._tips = fingertip_geoms(scene, model)
        self._free = scene.object_qpos
        self._last: tuple[float, Floats, Bools] | None = None
        self._due = 0.0
        self._writer: Any = None
        if self.path is not None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._partial = self.path.with_name(f".{self.path.stem}.partial{self.path.suffix}")
            # A Ctrl-C amid a frame would make imageio kill ffmpeg, and the film with it. Only the
            # main thread is interrupted, so another one writes.
            self._write = ThreadPoolExecutor(1, "film")
            self._writer = self._imageio.get_writer(
                self._partial,
                format="FFMPEG",
                fps=fps,
                codec="libx264",
                quality=7,
                macro_block_size=2,
                ffmpeg_log_level="error",
            )

    def __call__(self, sim: Any) -> None:
        """Film up to where ``sim`` is now."""
        time, qpos, touching = self._look(sim)
        if self._last is None or time < self._last[0]:
            self._due = time
            self._last = (time, qpos, touching)
        before, start, _ = self._last
        while self._writer is not None and self._due <= time + 1e-9:
            part = (self._due - before) / (time - before) if time > before else 1.0
            picture = self._draw(self._between(start, qpos, part), touching)
            self._write.submit(self._writer.append_data, picture).result()
            self._due += self._period
        self._last = (time, qpos, touching)

    def show(self, qpos: Floats, touching: Bools) -> None:
        """Look at a posture ``(nq,)`` instead of a simulator, for `picture`."""
        self._last = (0.0, np.asarray(qpos, float), np.asarray(touching, bool))

    def picture(self, path: str | Path | None = None) -> NDArray[np.uint8]:
        """What was seen last, ``(height, width, 3)``; saved as a PNG file where a path is given.

        Raises:
            InvalidInput: nothing was seen yet.
        """
        if self._last is None:
            raise InvalidInput("the recorder has not been called with a simulator yet")
        _, qpos, touching = self._last
        pixels = self._draw(qpos, touching)
        if path is not None:
            path = Path(path)
            path.parent.mkdir(parents=True, exist_ok=True)
            partial = path.with_name(f".{path.stem}.partial.png")
            self._imageio.imwrite(partial, pixels)
            partial.replace(path)
        return pixels

    def close(self) -> None:
        """Complete the video and put it in its place."""
        if self._writer is not None:
            self._write.submit(self._writer.close).result()
            self._write.shutdown()
            self._writer = None
            if self.path is not None and self._partial.exists():
                self._partial.replace(self.path)
        self._offscreen.close()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _look(self, sim: Any) -> tuple[float, Floats, Bools]:
        time, qpos = np.atleast_1d(sim.time), np.atleast_2d(sim.qpos)
        if not 0 <= self._env < len(time):
            raise InvalidInput(f"env is {self._env}; the simulator has {len(time)}, from 0")
        touching = np.atleast_2d(sim.read().in_contact)
        return float(time[self._env]), qpos[self._env], touching[self._env]

    def _between(self, start: Floats, end: Floats, part: float) -> Floats:
        """Between two postures of neighbouring control steps."""
        rotation = slice(self._free.start + 3, self._free.stop)
        if start[rotation] @ end[rotation] < 0:
            start = start.copy()
            start[rotation] *= -1
        qpos = (1 - part) * start + part * end
        qpos[rotation] /= np.linalg.norm(qpos[rotation])
        return qpos

    def _draw(self, qpos: Floats, touching: Bools) -> NDArray[np.uint8]:
        model, data, drawn = self._offscreen.model, self._data, self._offscreen.scene
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)
        every = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(model, data, self._option, None, self._camera, every, drawn)
        colour_fingertips(drawn, self._tips, touching)
        return self._offscreen.draw((self.caption, ""))


def draw_failure(failure: SettleFailure, path: str | Path) -> None:
    """Draw what came closest to holding the object into a PNG file, fingertips that touch lit.

    Raises:
        MissingExtra, SimulationError: nothing to draw with; the message says what is missing.
    """
    best = failure.closest
    with Recorder(failure.scene, None) as recorder:
        if best is not None:
            recorder.caption = best.reason
        qpos = failure.scene.model.qpos0 if best is None else best.qpos
        recorder.show(qpos, failure.reached)
        recorder.picture(path)


def _imageio() -> ModuleType:
    try:
        import imageio.v2 as imageio  # extras: only where a video is wanted
        import imageio_ffmpeg  # noqa: F401
    except ImportError:
        raise MissingExtra("recording videos and pictures", "viz") from None
    return imageio
