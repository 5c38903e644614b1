"""Logs: written beside the run, read back even when cut off."""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from dexctl.exceptions import InvalidInput
from hardware.log import LogWriter, encode, read_log

pytest.importorskip("mcap")


def write(path: Path, count: int = 20) -> LogWriter:
    log = LogWriter(path)
    log.write("/run", {"controller": "sine"})
    for i in range(count):
        log.write("/tick", {"time": 0.02 * i, "q": np.arange(3) + i, "late": None}, 1000 + i)
    log.write("/event", {"time": 0.1, "event": "x"})
    log.write("/summary", {"ticks": count})
    log.close()
    return log


def test_there_and_back(tmp_path: Path) -> None:
    written = write(tmp_path / "a.mcap")
    assert (written.dropped, written.error) == (0, "")
    log = read_log(tmp_path / "a.mcap")
    assert not log.cut and log.messages == 23
    assert log.run == {"controller": "sine"} and log.summary == {"ticks": 20}
    assert log.ticks["q"].shape == (20, 3) and log.ticks["q"][4].tolist() == [4, 5, 6]
    assert np.isnan(log.ticks["late"]).all()
    assert log.events == ({"time": 0.1, "event": "x"},)


def test_cut_off_at_any_byte_it_still_opens(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap", 3)
    content = (tmp_path / "a.mcap").read_bytes()
    cut = tmp_path / "cut.mcap"
    seen = []
    for length in range(len(content)):
        cut.write_bytes(content[:length])
        seen.append(read_log(cut).messages)
    assert seen == sorted(seen) and seen[0] == 0 and seen[-1] == 6


def test_what_is_not_finite_is_null() -> None:
    assert encode({"a": np.array([1.0, np.nan]), "b": float("inf"), "c": {"d": -np.inf}}) == (
        b'{"a": [1.0, null], "b": null, "c": {"d": null}}'
    )


def test_a_full_queue_drops_and_does_not_wait(tmp_path: Path) -> None:
    log = LogWriter(tmp_path / "a.mcap")
    log.write("/run", {})
    os.kill(log._process.pid, signal.SIGSTOP)
    try:
        start = time.perf_counter()
        taken = sum(log.write("/tick", {"time": 0.0, "x": "y" * 5000}) for _ in range(600))
        assert time.perf_counter() - start < 2.0
        assert log.dropped == 600 - taken > 0
    finally:
        os.kill(log._process.pid, signal.SIGCONT)
    log.close()
    assert read_log(tmp_path / "a.mcap").messages == taken + 1


def test_a_writer_that_dies_does_not_stop_the_run(tmp_path: Path) -> None:
    log = LogWriter(tmp_path / "a.mcap")
    log.write("/run", {})
    log._process.kill()
    log._process.wait()
    for _ in range(5):
        log.write("/tick", {"time": 0.0})
    log.close()
    log.close()
    assert log.dropped and log.error


@pytest.mark.skipif(sys.platform != "linux", reason="needs /dev/full")
def test_a_full_disk_is_said() -> None:
    log = LogWriter("/dev/full")
    log.write("/run", {})
    log.close()
    assert "No space left" in log.error


def test_files_that_are_no_logs(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="cannot read"):
        read_log(tmp_path / "none.mcap")
    (tmp_path / "text.mcap").write_text("no MCAP at all")
    with pytest.raises(InvalidInput, match="is no MCAP file"):
        read_log(tmp_path / "text.mcap")
    with pytest.raises(InvalidInput, match="cannot write"):
        LogWriter(tmp_path / "none" / "a.mcap")
