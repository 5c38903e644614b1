"""Recording and viewing: files that are complete, and clear answers where there is no OpenGL."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dexctl.exceptions import InvalidInput, MissingExtra, SimulationError
from dexctl.sim import BatchSimulator, Scene
from dexctl.sim.offscreen import opengl_backend
from dexctl.sim.record import Recorder
from dexctl.sim.viewer import Viewer
from dexctl.sim.visuals import up_direction


@pytest.fixture(scope="module")
def sphere() -> Scene:
    return Scene.build("dex5", "sphere")


@pytest.fixture(scope="module")
def needs_opengl() -> None:
    pytest.importorskip("imageio_ffmpeg")
    try:
        opengl_backend()
    except SimulationError as error:
        pytest.skip(str(error))


@pytest.mark.usefixtures("needs_opengl")
def test_video_and_picture(sphere: Scene, tmp_path: Path) -> None:
    import imageio.v2 as imageio

    path = tmp_path / "deep" / "film.mp4"
    sim = BatchSimulator(sphere, 2)
    with Recorder(sphere, path, env=1, fps=10, width=160, height=120) as recorder:
        with pytest.raises(InvalidInput, match="not been called"):
            recorder.picture()
        for _ in range(2):  # a second part of the film starts with the reset
            recorder(sim)
            for _ in range(6):
                sim.step()
                recorder(sim)
            sim.reset()
        recorder.caption = "hold"
        picture = recorder.picture(tmp_path / "still.png")
        assert not path.exists()  # written aside until it is complete
    assert [item.name for item in path.parent.iterdir()] == ["film.mp4"]
    assert picture.shape == (120, 160, 3)
    assert picture.std() > 20  # something is to be seen
    np.testing.assert_array_equal(imageio.imread(tmp_path / "still.png"), picture)
    frames = list(imageio.get_reader(path).iter_data())
    assert len(frames) == 2 * 4  # 0, 0.1, 0.2, 0.3 s
    assert frames[0].shape == (120, 160, 3)


INTERRUPTED = """
import os, signal, sys, threading
from dexctl.sim import BatchSimulator, Scene
from dexctl.sim.record import Recorder
signal.signal(signal.SIGINT, signal.default_int_handler)
sim = BatchSimulator(Scene.build("dex5", "sphere"), 1)
with Recorder(sim.scene, None) as first:  # whose frame takes long: the next one is there in time
    first(sim)
try:
    with Recorder(sim.scene, sys.argv[1]) as recorder:
        threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGINT)).start()
        while True:
            recorder(sim)
            sim.step()
except KeyboardInterrupt:
    sys.exit(130)
"""


@pytest.mark.usefixtures("needs_opengl")
@pytest.mark.skipif(os.name != "posix", reason="the slow encoder is a shell script")
def test_ctrl_c_amid_a_frame_leaves_a_film_to_look_at(tmp_path: Path) -> None:
    """An encoder that reads nothing for the first two seconds: the frame waits in its pipe."""
    import imageio.v2 as imageio
    from imageio_ffmpeg import get_ffmpeg_exe

    slow = tmp_path / "slow-ffmpeg"
    slow.write_text(f'#!/bin/sh\nsleep 2\nexec "{get_ffmpeg_exe()}" "$@"\n')
    slow.chmod(0o755)
    path = tmp_path / "film.mp4"
    done = subprocess.run(
        [sys.executable, "-c", INTERRUPTED, str(path)],
        env={**os.environ, "IMAGEIO_FFMPEG_EXE": str(slow)},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 130, done.stderr
    assert sum(1 for _ in imageio.get_reader(path).iter_data()) > 0


@pytest.mark.usefixtures("needs_opengl")
def test_touching_fingertips_light_up(sphere: Scene, tmp_path: Path) -> None:
    sim = BatchSimulator(sphere)
    with Recorder(sphere, None, width=320, height=240) as recorder:
        recorder(sim)
        held = recorder.picture().astype(int)
        q, upright = np.asarray(sphere.open_q), [1.0, 0.0, 0.0, 0.0]
        sim.set_grasp(q, q, [0.0, 0.0, 0.3], upright)
        recorder(sim)
        let_go = recorder.picture().astype(int)
    orange = [
        int(((p[..., 0] > 180) & (p[..., 0] - p[..., 2] > 120)).sum()) for p in (held, let_go)
    ]
    assert orange[0] > 50
    assert orange[1] == 0


def test_sizes_and_environments_out_of_range(sphere: Scene, tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="width is 161; expected an even number"):
        Recorder(sphere, tmp_path / "film.mp4", width=161)


def test_without_opengl_the_error_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(command, **_):
        return subprocess.CompletedProcess(command, 1, "", "Traceback\nImportError: no libEGL")

    monkeypatch.setattr(subprocess, "run", fail)
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    opengl_backend.cache_clear()
    try:
        with pytest.raises(
            SimulationError, match=r"egl: ImportError: no libEGL; osmesa: .*apt-get"
        ):
            opengl_backend()
    finally:
        opengl_backend.cache_clear()


def test_without_imageio_the_error_names_the_extra(
    sphere: Scene, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "imageio.v2", None)
    with pytest.raises(MissingExtra, match=r"dexctl\[viz\]"):
        Recorder(sphere, tmp_path / "film.mp4")


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="other systems have a display")
def test_viewer_needs_a_display(sphere: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(SimulationError, match="needs a display"):
        Viewer(sphere)


def test_up_is_against_gravity() -> None:
    np.testing.assert_allclose(up_direction(Scene.build("dex5", gravity="down")), [0, 0, -1])
    np.testing.assert_allclose(up_direction(Scene.build("dex5", gravity=(0, 0, 0))), [0, 0, 1])
