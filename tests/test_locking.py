"""One process at a time in a folder."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from dexctl.cli import main
from dexctl.exceptions import InvalidInput
from dexctl.locking import locked

HOLD = """
import sys
from pathlib import Path
from dexctl.locking import locked
with locked(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


@contextmanager
def another(folder: Path) -> Iterator[subprocess.Popen[str]]:
    """Another process that holds ``folder`` until it is killed, or its input ends."""
    command = [sys.executable, "-c", HOLD, str(folder)]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        try:
            yield process
        finally:
            process.kill()


def test_nothing_is_left_and_it_may_be_held_once_more(tmp_path: Path) -> None:
    with locked(tmp_path):
        with locked(tmp_path / "." / ""):
            assert [path.name for path in tmp_path.iterdir()] == [".lock"]
        assert [path.name for path in tmp_path.iterdir()] == [".lock"]
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ZeroDivisionError), locked(tmp_path):
        _ = 1 / 0
    assert list(tmp_path.iterdir()) == []


def test_another_process_holds_it(tmp_path: Path) -> None:
    with another(tmp_path) as process:
        with pytest.raises(InvalidInput, match=f"^another process is at work in {tmp_path}$"):
            locked(tmp_path).__enter__()
        process.kill()
        process.wait()
        with locked(tmp_path):  # what it left holds nobody
            pass
    assert list(tmp_path.iterdir()) == []


def test_who_waits_holds_it_next(tmp_path: Path) -> None:
    with another(tmp_path) as process:
        assert process.stdin is not None
        end = threading.Timer(0.3, process.stdin.close)
        end.start()
        begun = time.monotonic()
        with locked(tmp_path, wait=60):
            assert time.monotonic() - begun > 0.2
            # the file that the other one took away is not what is held now
            with pytest.raises(AssertionError), another(tmp_path):
                pass
        end.join()


def test_two_plans_do_not_grow_one_tree(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["plan", "--nodes", "64", "--threads", "1", "--out", str(tmp_path)]
    with another(tmp_path):
        assert main(words) == 2
        assert f"another process is at work in {tmp_path}" in capsys.readouterr().err
        assert [path.name for path in tmp_path.iterdir()] == [".lock"]
    assert main(words) == 0
    assert {path.name for path in tmp_path.iterdir()} == {"tree.npz", "plan.json"}
