"""The report's sentences, by hand, and what its page says and draws."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hardware.figures import in_full
from hardware.findings import findings, shares_at_limit, touches_per_second
from hardware.log import Log, LogWriter, read_log
from hardware.report import _coinciding, build

pytest.importorskip("mcap")
TICKS = 100  # of 20 ms: 2 s
RUN = {
    "controller": "igm",
    "joints": ["f1_roll", "f1_flexion", "f2_roll", "f2_flexion"],
    "joint_fingers": [0, 0, 1, 1],
    "servos": [11, 12, 13, 14],
    "seed": 0,
    "emulated": False,
    "action_latency_s": 0.0,
    "limits": {"torque_limit": 0.5, "speed_limit": 0.6},
    "scene": {"sensing": {"touch_threshold": 1.0}},
}


def log_of(path: Path, run: Mapping[str, Any] = RUN, **changed: np.ndarray) -> Log:
    """A quiet log of four joints and two fingers, with columns ``(T, ...)`` changed."""
    columns: dict[str, np.ndarray] = {
        "q": np.zeros((TICKS, 4)),
        "q_target": np.linspace(0, 1, TICKS)[:, None] * np.arange(4),
        "velocity": np.zeros((TICKS, 4)),
        "torque": np.full((TICKS, 4), 0.1),
        "fresh": np.ones((TICKS, 4), bool),
        "in_contact": np.ones((TICKS, 2), bool),
        "contact_force": np.full((TICKS, 2), 1.2),
        "lateness": np.full(TICKS, 1e-4),
    } | changed
    with LogWriter(path) as log:
        log.write("/run", run)
        for i in range(TICKS):
            tick = {"time": 0.02 * i, "state": "run", "age": 0.0}
            log.write("/tick", tick | {name: rows[i] for name, rows in columns.items()})
        log.write("/health", {"time": 0.0, "voltage": [12.0] * 4, "temperature": [40, 41, 55, 39]})
        log.write("/health", {"time": 1.0, "voltage": [12.0] * 4, "temperature": [40, 42, 56, 39]})
        log.write(
            "/summary", {"outcome": "idle", "torque_message": "torque off", "counts": {"armed": 1}}
        )
    return read_log(path)


def test_a_quiet_run_has_nothing_to_look_at(tmp_path: Path) -> None:
    log = log_of(tmp_path / "a.mcap")
    assert findings(log) == []
    page = build(log)
    assert "What to look at" not in page
    assert "The run ended as wanted; torque off." in page and "idle" not in page
    for raw in ("action_latency_s", "rate_hz", "late_over_1ms", "emulated</td><td>False"):
        assert raw not in page
    assert "<td>seed</td><td>0</td>" in page and "<td>latency of actions [s]</td><td>0</td>" in page


def test_how_runs_end_in_words() -> None:
    assert [in_full(o) for o in ("idle", "hold", "fault", "?")] == [
        "ended as wanted", "was held", "ended in a fault", "?",
    ]  # fmt: skip


def test_a_run_that_a_signal_ended_says_so(tmp_path: Path) -> None:
    assert in_full("idle", "SIGTERM") == "was ended by SIGTERM"
    assert in_full("idle", "SIGINT") == "was ended by Ctrl-C"
    assert in_full("fault", "SIGTERM") == "ended in a fault"
    log = log_of(tmp_path / "a.mcap")
    told = replace(log, summary={**log.summary, "signal": "SIGHUP"})
    assert "The run was ended by SIGHUP; torque off." in build(told)


def test_set_points_that_were_clamped(tmp_path: Path) -> None:
    log = log_of(tmp_path / "a.mcap")
    few, many = (
        replace(log, summary={"outcome": "idle", "counts": {"set-point clamped": count}})
        for count in (2, 40)
    )
    assert findings(few) == []
    (said,) = findings(many)
    assert said.startswith("Set-points were clamped in 40 ticks: the controller asks for more than")
    assert said.partition(" or ")[0] in build(many)


def test_a_joint_at_its_torque_limit(tmp_path: Path) -> None:
    torque = np.full((TICKS, 4), 0.1)
    torque[:30, 3] = -0.49  # at 98 % of it for 30 of 100 ticks
    torque[:4, 1] = 0.5  # for 4 %: not told
    log = log_of(tmp_path / "a.mcap", torque=torque)
    np.testing.assert_allclose(shares_at_limit(log, np.ones(TICKS, bool)), [0, 0.04, 0, 0.3])
    (said,) = findings(log)
    assert said.startswith("At the torque limit of 0.5 N m: f2_flexion (30% of the run).")
    assert said in build(log)


def test_touch_that_chatters_at_the_threshold(tmp_path: Path) -> None:
    touch = np.ones((TICKS, 2), bool)
    touch[::10, 1] = False  # lost ten times, made again ten times, within 1.98 s
    log = log_of(tmp_path / "a.mcap", in_contact=touch)
    rates = touches_per_second(log, np.ones(TICKS, bool))
    np.testing.assert_allclose(rates, [0.0, 10 / 1.98])
    (said,) = findings(log)
    assert said.startswith("Finger 2 made and lost touch 5.1 times a second, at forces about the")
    assert "threshold of 1 N (median 1.2 N)" in said
    strong = log_of(tmp_path / "b.mcap", in_contact=touch, contact_force=np.full((TICKS, 2), 4.0))
    assert findings(strong) == ["Finger 2 made and lost touch 5.1 times a second."]


@pytest.mark.parametrize(
    ("how", "words", "caption"),
    [
        ("full", "the threshold of 1 N (median 0.5 N)", "Thin line: what counts as touch, 1 N."),
        (
            "joint-torque",
            "the thresholds of 0.4 and 0.2 N (median 0.5 N)",
            "Thin lines: touch begins at 0.4 N and ends below 0.2 N.",
        ),
        ("binary", "", ""),
    ],
)
def test_thresholds_are_those_of_what_tells_of_touch(
    how: str, words: str, caption: str, tmp_path: Path
) -> None:
    joint_touch = {"touch_force": 0.4, "release_force": 0.2}
    sensing = {"touch": how, "touch_threshold": 1.0, "joint_touch": joint_touch}
    touch = np.ones((TICKS, 2), bool)
    touch[::10, 1] = False
    run = {**RUN, "scene": {"sensing": sensing}}
    weak, firm = (
        log_of(
            tmp_path / f"{force}.mcap", run, in_contact=touch,
            contact_force=np.full((TICKS, 2), force),
        )
        for force in (0.5, 0.7)
    )  # fmt: skip
    (said,) = findings(weak)
    assert words in said and ("at forces about" in said) == bool(words)
    page = build(weak)
    assert caption in page and ("Thin line" in page.split("normal force")[-1]) == bool(caption)
    # 0.7 N is near what counts for fingertips, and well above what counts for joints
    (said,) = findings(firm)
    assert ("at forces about" in said) == (how == "full")


def test_late_ticks_and_silent_servos(tmp_path: Path) -> None:
    late, fresh = np.full(TICKS, 1e-4), np.ones((TICKS, 4), bool)
    late[:10], fresh[:5, 2] = 3e-3, False
    first, second = findings(log_of(tmp_path / "a.mcap", lateness=late, fresh=fresh))
    assert first.startswith("10% of the ticks began more than 1 ms late")
    assert second == "f2_roll did not answer in 5% of the ticks: look at its cable."


def test_curves_that_coincide_are_one() -> None:
    rise = np.linspace(0, 1, 50)
    values = np.stack([rise, rise + 1e-4, -rise, rise * 0.5], axis=1)
    assert _coinciding(values) == [[0, 1], [2], [3]]
    assert _coinciding(np.zeros((5, 3))) == [[0, 1, 2]]
    assert _coinciding(np.full((5, 2), np.nan)) == [[0, 1]]


def test_pictures_name_what_they_draw(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    legends: list[list[str]] = []

    def plot(figure, alt: str, caption: str = "") -> str:
        for axes in figure.axes:
            boxes = [a for a in axes.get_children() if type(a).__name__ == "Legend"]
            legends.append(sorted(text.get_text() for box in boxes for text in box.get_texts()))
            assert len(axes.lines) <= 1 or boxes, alt
        return ""

    monkeypatch.setattr("hardware.report.html.plot", plot)
    build(log_of(tmp_path / "a.mcap"))
    assert legends[0] == ["1st joint", "2nd joint", "finger 1", "finger 2"]
    assert legends[1][-1] == "finger 1, 2 alike"  # torques are all the same
    assert ["coolest: servo 14 (f2_flexion)", "hottest: servo 13 (f2_roll)"] in legends
    assert ["all servos"] in legends  # one voltage
