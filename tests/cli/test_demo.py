"""The demo: its files, and what Ctrl-C leaves of them."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from dexctl import controllers
from dexctl.cli import demo, main
from dexctl.exceptions import SimulationError

ROOT = Path(__file__).resolve().parents[2]
# dexctl finds the policies that come with it through entry points, once it is installed
LEARNED = [name for name in ("learned",) if name in controllers.names()]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT)}


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def assert_whole(folder: Path) -> None:
    """Nothing half-written: every file that is there can be read to its end."""
    for path in folder.iterdir():
        assert not path.name.startswith("."), f"{path.name} was left behind"
        if path.suffix == ".html":
            assert path.read_text().endswith("</html>\n")
        elif path.suffix == ".png":
            assert path.read_bytes()[-8:-4] == b"IEND"
        elif path.suffix == ".mp4":
            imageio = pytest.importorskip("imageio.v2")
            with imageio.get_reader(path) as reader:
                assert sum(1 for _ in reader) > 0


@pytest.fixture(scope="module")
def can_draw() -> bool:
    from dexctl.sim.offscreen import opengl_backend

    try:
        opengl_backend()
    except SimulationError:
        return False
    return True


def test_demo_makes_its_files(tmp_path: Path, can_draw: bool) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "dexctl", "demo", "--seconds", "0.2", "--json", "--out", "out"],
        cwd=tmp_path,
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        timeout=180,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert list(found["controllers"]) == ["igm", "switch", "gait", "coordinated", *LEARNED]
    for result in found["controllers"].values():
        assert 0 <= result["mean_contacts"] <= 5
        assert 0 < result["act_time_median_s"] <= result["act_time_p99_s"]
    folder = tmp_path / "out"
    assert_whole(folder)
    assert {Path(file).name for file in found["files"]} == names(folder)
    expected = {"report.html", "picture.png", "demo.mp4", "coordinated_0.png"}
    assert expected <= names(folder) if can_draw else names(folder) == {"report.html"}
    check_report((folder / "report.html").read_text())


def check_report(document: str) -> None:
    """It needs nothing beside it, and says what was measured and under what conditions."""
    loaded = re.findall(r'(?:src|href)="([^"]{0,40})', document)
    assert loaded and all(source.startswith("data:") for source in loaded)
    assert "<script" not in document and "@import" not in document
    for words in ("Results", "Coordinated gait", "Contact switching", "Time of a call"):
        assert words in document
    for words in ("<td>seed</td><td>0</td>", "mujoco", "dexctl demo --seconds 0.2"):
        assert words in document


def test_without_opengl_everything_else_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def none_here() -> str:
        raise SimulationError("no OpenGL to draw with; to get one: apt-get install libegl1")

    monkeypatch.setattr("dexctl.sim.offscreen.opengl_backend", none_here)
    assert main(["demo", "--seconds", "0.2", "--out", str(tmp_path)]) == 0
    said = capsys.readouterr()
    assert "no video and no pictures" in said.err and "apt-get install libegl1" in said.err
    assert "coordinated gait" in said.out
    assert names(tmp_path) == {"report.html"}
    assert_whole(tmp_path)


def test_interrupted_while_simulating(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The report of the controllers that are done, and code 130."""
    done: list[object] = []
    run_trials = demo.run_trials

    def interrupt_the_second(*args: object, **options: object) -> object:
        if done:
            raise KeyboardInterrupt
        done.append(args[0])
        return run_trials(*args, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(demo, "run_trials", interrupt_the_second)
    assert main(["demo", "--seconds", "0.5", "--out", str(tmp_path)]) == 130
    assert names(tmp_path) == {"report.html"}
    assert_whole(tmp_path)
    document = (tmp_path / "report.html").read_text()
    assert "Interrupted" in document
    assert "In-grasp manipulation" in document and "Coordinated gait" not in document


def test_interrupted_before_anything_is_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(demo, "run_trials", interrupt)
    assert main(["demo", "--seconds", "0.5", "--out", str(tmp_path)]) == 130
    assert names(tmp_path) == set()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sign", "expected"),
    [("igm_0.png", {"report.html"}), (".demo.partial.mp4", {"report.html", "demo.mp4"})],
    ids=["key frames", "video"],
)
def test_ctrl_c_while_drawing(
    sign: str, expected: set[str], tmp_path: Path, can_draw: bool
) -> None:
    """A real Ctrl-C, once the first sign of a stage can be seen."""
    if not can_draw:
        pytest.skip("no OpenGL to draw with")
    process = subprocess.Popen(
        [sys.executable, "-m", "dexctl", "demo", "--seconds", "4", "--out", str(tmp_path)],
        env=ENVIRONMENT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # a shell's background jobs ignore it, and so would what they start
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        give_up = time.monotonic() + 120
        while not (tmp_path / sign).exists() and process.poll() is None:
            assert time.monotonic() < give_up
            time.sleep(0.02)
        time.sleep(0.3)
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGINT)  # what a terminal does: to ffmpeg as well
        _, said = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130, said
    assert "Traceback" not in said
    assert expected <= names(tmp_path)
    assert_whole(tmp_path)
