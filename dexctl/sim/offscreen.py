"""Drawing without a display: an OpenGL context from EGL or OSMesa, whichever works here."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from functools import cache
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from dexctl.exceptions import SimulationError

_BACKENDS = ("egl", "osmesa")
# A driver that is half there may kill the process, so each backend is tried in one of its own.
_PROBE = """
import mujoco
from mujoco.{backend} import GLContext
context = GLContext(64, 64)
context.make_current()
mujoco.MjrContext(mujoco.MjSpec().compile(), mujoco.mjtFontScale.mjFONTSCALE_100)
"""
_HOW = (
    "to get one on Debian or Ubuntu: apt-get install libegl1 libgl1-mesa-dri (EGL, in software or "
    "on a GPU), or apt-get install libosmesa6 (OSMesa)"
)


@cache
def opengl_backend() -> str:
    """The first of EGL and OSMesa that draws here; MUJOCO_GL, where set to one, decides.

    Raises:
        SimulationError: neither works; the message says how to get one.
    """
    asked = os.environ.get("MUJOCO_GL", "").lower()
    reasons = []
    for backend in [asked] if asked in _BACKENDS else _BACKENDS:
        try:
            done = subprocess.run(
                [sys.executable, "-c", _PROBE.format(backend=backend)],
                env={**os.environ, "MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend},
                capture_output=True,
                text=True,
                timeout=60,
                check=False,
            )
        except subprocess.TimeoutExpired:
            reasons.append(f"{backend}: no answer within 60 s")
            continue
        if done.returncode == 0:
            return backend
        last = done.stderr.strip().splitlines()[-1:] or [f"exit code {done.returncode}"]
        reasons.append(f"{backend}: {last[0]}")
    raise SimulationError(f"no OpenGL to draw with ({'; '.join(reasons)}); {_HOW}")


class Offscreen:
    """Draws one model into pictures.

    Args:
        model: what to draw; its offscreen buffer must be as large as the picture.
        width, height: of the picture [pixels].

    Raises:
        SimulationError: no OpenGL here.
    """

    def __init__(self, model: mujoco.MjModel, width: int, height: int) -> None:
        backend = opengl_backend()
        # read when PyOpenGL is first imported, which mujoco.egl and mujoco.osmesa do
        os.environ.setdefault("PYOPENGL_PLATFORM", backend)
        try:
            self._gl: Any = importlib.import_module(f"mujoco.{backend}").GLContext(width, height)
        except (ImportError, RuntimeError, AttributeError) as error:
            raise SimulationError(f"no OpenGL to draw with ({backend}: {error}); {_HOW}") from None
        self._gl.make_current()
        self.model = model
        self.scene = mujoco.MjvScene(model, maxgeom=2000)
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_150)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._viewport = mujoco.MjrRect(0, 0, width, height)
        self._pixels = np.zeros((height, width, 3), np.uint8)

    def draw(self, captions: tuple[str, str] = ("", "")) -> NDArray[np.uint8]:
        """The picture of ``scene`` ``(height, width, 3)``, with captions at its top left."""
        if self._gl is None:
            raise SimulationError("the drawing context is closed")
        self._gl.make_current()
        mujoco.mjr_render(self._viewport, self.scene, self._context)
        if any(captions):
            mujoco.mjr_overlay(
                mujoco.mjtFont.mjFONT_NORMAL,
                mujoco.mjtGridPos.mjGRID_TOPLEFT,
                self._viewport,
                captions[0],
                captions[1],
                self._context,
            )
        mujoco.mjr_readPixels(self._pixels, None, self._viewport, self._context)
        return self._pixels[::-1].copy()  # OpenGL's rows go upwards

    def close(self) -> None:
        """Free the context."""
        if self._gl is not None:
            self._gl.make_current()
            self._context.free()
            self._gl.free()
            self._gl = None
