"""Logs with flipped bits: figures and a page of what is whole, or one clear line."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest

from hardware.figures import figures_of_merit
from hardware.log import Log, LogWriter, read_log
from hardware.report import build

pytest.importorskip("mcap")


def write(path: Path, ticks: int = 30) -> bytes:
    """A log as a run writes it, of a hand of 15 joints and 5 fingers."""
    random = np.random.default_rng(0)
    with LogWriter(path) as log:
        log.write("/run", {"controller": "igm", "hand": "dex5", "date": "2026-01-01",
                           "limits": {"torque_limit": 0.5, "speed_limit": 0.6}})  # fmt: skip
        for i in range(ticks):
            log.write(
                "/tick",
                {
                    "time": 0.02 * (i + 1),
                    "state": "armed" if i < 3 else "run",
                    "q": random.normal(size=15),
                    "q_target": random.normal(size=15),
                    "velocity": random.normal(size=15),
                    "torque": random.normal(size=15),
                    "fresh": np.ones(15, bool),
                    "age": 0.001,
                    "in_contact": np.ones(5, bool),
                    "contact_force": random.uniform(size=5),
                    "contact_position": random.normal(size=(5, 3)),
                    "tactile_stale": np.zeros(5, bool),
                    "lateness": 1e-4,
                    "controller_seconds": None if i < 3 else 1e-3,
                    "diagnostics": {"limited": False},
                    "object_position": [0.0, 0.0, 0.1],
                    "object_quaternion": [1.0, 0.0, 0.0, 0.0],
                },
            )
            if i % 10 == 0:
                health = {"voltage": np.full(15, 12.0), "temperature": np.full(15, 40.0)}
                log.write("/health", {"time": 0.02 * i, **health, "error": np.zeros(15, int)})
        log.write("/event", {"time": 0.1, "event": "started", "detail": "x", "state": "run"})
        log.write("/summary", {"outcome": "idle", "torque_message": "torque off", "counts": {}})
    return path.read_bytes()


def flipped(content: bytes, seed: int) -> bytes:
    random = np.random.default_rng(seed)
    changed = bytearray(content)
    for at in random.integers(0, len(changed), random.integers(1, 4)):
        changed[at] ^= 1 << int(random.integers(8))
    return bytes(changed)


def read(path: Path, content: bytes) -> Log | str:
    """The log, or the one line that says why it is none."""
    path.write_bytes(content)
    try:
        return read_log(path)
    except ValueError as error:
        return str(error)


@pytest.mark.parametrize(
    "count", [200, pytest.param(1000, marks=pytest.mark.slow)], ids=["some", "all"]
)
def test_logs_with_flipped_bits(count: int, tmp_path: Path) -> None:
    content = write(tmp_path / "whole.mcap")
    path = tmp_path / "a.mcap"
    whole = figures_of_merit(read_log(tmp_path / "whole.mcap"))
    refused: list[str] = []
    told = 0
    for seed in range(count):
        log = read(path, flipped(content, seed))
        if isinstance(log, str):
            refused.append(log)
            continue
        told += bool(log.damage or log.cut)
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)
            try:
                found = figures_of_merit(log)
            except ValueError as error:
                refused.append(str(error))
                continue
        assert found.keys() <= {*whole, "object_lost_at_s"}
        assert not any(np.isnan(value) for value in found.values()), seed
    assert all(str(path) in line and "\n" not in line for line in refused)
    assert len(refused) < count / 10  # a flipped bit costs its message, not the log
    assert told > 0.88 * count  # the checksum knows of it where nothing else does


def test_pages_of_damaged_logs(tmp_path: Path) -> None:
    content = write(tmp_path / "whole.mcap", 12)
    pages = 0
    for seed in range(1000, 1002):
        log = read(tmp_path / "a.mcap", flipped(content, seed))
        if isinstance(log, Log):
            page = build(log)
            pages += 1
            assert not log.damage or "damaged" in page or "checksum" in page
    assert pages >= 1


@pytest.mark.parametrize("name", ["q", "torque", "in_contact", "lateness", "time"])
def test_ticks_without_what_figures_are_made_of(name: str, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    tick = {"time": 0.0, "q": [0.0], "q_target": [0.0], "torque": [0.0], "fresh": [True],
            "in_contact": [True], "contact_force": [1.0], "lateness": 0.0}  # fmt: skip
    del tick[name]
    with LogWriter(path) as log:
        for i in range(3):
            log.write("/tick", tick | ({} if name == "time" else {"time": float(i)}))
    found = read_log(path)
    if name == "time":
        assert figures_of_merit(found) == {}
        return
    with pytest.raises(ValueError, match=f"its ticks hold no {name}; the log is damaged"):
        figures_of_merit(found)


def test_one_damaged_tick_is_left_out(tmp_path: Path) -> None:
    content = write(tmp_path / "whole.mcap")
    path = tmp_path / "a.mcap"
    at = content.index(b'"q_target"', len(content) // 2)
    path.write_bytes(content[:at] + b'"q_tarGet"' + content[at + 10 :])
    log = read_log(path)
    assert log.damage == "1 messages are damaged and left out; its checksum is wrong"
    assert len(log.ticks["time"]) == 29 and len(log.ticks["q_target"]) == 29
    assert figures_of_merit(log)["seconds"] == pytest.approx(0.58)
