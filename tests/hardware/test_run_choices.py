"""What `dexctl hardware run` makes of a controller's name, and what it says of a run."""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dexctl
from dexctl.cli import main
from dexctl.exceptions import InvalidInput
from dexctl.gait import GoalPursuit
from dexctl.sim import SceneConfig
from dexctl.sim.sensing import Sensing
from hardware.cli.options import HandOptions, busy
from hardware.cli.run import Run, make_controller
from hardware.figures import figures_of_merit, in_words
from hardware.log import LogWriter, read_log
from hardware.report import build
from hardware.run_report import RunReport
from hardware.state_machine import Event, State
from learning import policies


def twenty(hand: dexctl.HandModel, control_period: float) -> dexctl.Controller:
    """As a function of the user's that returns a policy made for another rate."""
    return policies.load("dex5-cylinder", hand=hand)


@pytest.mark.usefixtures("learned")
def test_one_that_needs_the_objects_pose(dex5: dexctl.HandModel) -> None:
    wanted = "regulated:coordinated needs the object's pose, .* expected --object-pose touch or"
    with pytest.raises(InvalidInput, match=wanted):
        make_controller("regulated:coordinated", dex5)
    assert make_controller("regulated:coordinated", dex5, tracked=True).tracks


def test_the_rate_is_the_controllers(dex5: dexctl.HandModel) -> None:
    for name, rate, period in (
        ("igm", None, 0.02),
        ("sine", None, 0.02),
        ("igm", 100.0, 0.01),
        ("learned", None, 0.05),
        ("learned", 20.0, 0.05),
        (str(policies.FOLDER / "dex5-cylinder.npz"), None, 0.05),
        (f"{__name__}:twenty", None, 0.05),
        ("steered:goal", None, 0.02),
        ("sequence:dex5-cube-z,dex5-cube-x", None, 0.05),
        ("commanded:dex5-easy,dex5-cube-x", None, 0.05),
    ):
        assert make_controller(name, dex5, rate).control_period == pytest.approx(period), name
    for name, period in (("pursuing:goal", 0.02), ("pursuing:dex5-cube-goals", 0.05)):
        made = make_controller(name, dex5, tracked=True)
        assert made.control_period == pytest.approx(period), name


@pytest.mark.usefixtures("learned")
def test_another_rate_than_the_controllers(dex5: dexctl.HandModel) -> None:
    made = f"{__name__}:twenty"
    for name, said in (
        ("learned", r"control_period is 0\.02; .* was trained with 0\.05"),
        (made, rf"--rate is 50; {made} runs at 20 Hz"),
    ):
        with pytest.raises(InvalidInput, match=said):
            make_controller(name, dex5, 50.0)


def tick(i: int, **more: Any) -> dict[str, Any]:
    """What a log has of the i-th of ticks half a second apart; the first is before the run."""
    return {
        "time": 0.5 * i,
        "state": "run" if i else "armed",
        **{key: [0.0, 0.0] for key in ("q", "q_target", "torque")},
        "fresh": [True, True],
        "in_contact": [True],
        "contact_force": [2.0],
        "lateness": 0.0,
        **more,
    }


def test_rotation_is_counted_until_the_object_is_lost(tmp_path: Path) -> None:
    pytest.importorskip("mcap", reason="needs the extra 'hardware'")
    angle = np.array([0.0, 0.0, 0.2, 0.3, 0.4])  # and in the fourth tick it has fallen
    zeros = np.zeros(5)
    turned = np.stack([np.cos(angle / 2), zeros, zeros, np.sin(angle / 2)], axis=1)
    with LogWriter(tmp_path / "a.mcap") as log:
        for i in range(5):
            place = [0.0, 0.0, 0.13 if i < 3 else 0.0]
            log.write("/tick", tick(i, object_position=place, object_quaternion=turned[i]))
    found = read_log(tmp_path / "a.mcap")
    assert figures_of_merit(found)["rotation_rad"] == pytest.approx(0.2)  # as trials count
    assert figures_of_merit(found)["turning_speed_rad_s"] == pytest.approx(0.4)  # in the run
    assert figures_of_merit(found)["object_lost_at_s"] == pytest.approx(1.5)
    assert ("object lost at", "1.5 s") in in_words(figures_of_merit(found))
    assert "object lost at" in build(found)


def test_rotation_is_counted_about_the_axis_that_was_told(tmp_path: Path) -> None:
    """It was counted about z, whatever `--spin` said."""
    pytest.importorskip("mcap", reason="needs the extra 'hardware'")
    axis, angle = np.array([0.6, 0.0, -0.8]), np.array([0.0, 0.1, 0.3])
    for spin, name, turned in (
        ((0.3 * axis).tolist(), "rotation_as_told_rad", 0.3),
        ([0.0, 0.0, 0.0], "rotation_rad", -0.241),  # 2 arctan(-0.8 tan 0.15)
        ("torn", "rotation_rad", -0.241),
    ):
        path = tmp_path / f"{name}-{spin[0]}.mcap"
        with LogWriter(path) as log:
            log.write("/run", {"goal_angular_velocity": spin})
            for i in range(3):
                pose = [np.cos(angle[i] / 2), *(np.sin(angle[i] / 2) * axis)]
                log.write("/tick", tick(i, object_position=[0, 0, 0.1], object_quaternion=pose))
        found = read_log(path)
        figures = figures_of_merit(found)
        assert figures[name] == pytest.approx(turned, abs=1e-3)
        assert len({"rotation_rad", "rotation_as_told_rad"} & set(figures)) == 1
        assert in_words({name: figures[name]})[0][0].removeprefix("object's ") in build(found)


def test_a_real_hand_has_what_was_tracked_by_touch(tmp_path: Path) -> None:
    """Before the controller starts nothing is tracked, and a damaged tick says nothing."""
    pytest.importorskip("mcap", reason="needs the extra 'hardware'")
    angle = [None, 0.0, 0.1, "torn", 0.3]
    with LogWriter(tmp_path / "a.mcap") as log:
        for i, one in enumerate(angle):
            half = 0.5 * one if isinstance(one, float) else 0.0
            told = {
                "tracked_position": [0.0, 0.0, 0.13],
                "tracked_quaternion": [
                    np.cos(half),
                    0.0,
                    0.0,
                    one if one == "torn" else np.sin(half),
                ],
            }
            log.write("/tick", tick(i, diagnostics={} if one is None else told))
    figures = figures_of_merit(read_log(tmp_path / "a.mcap"))
    assert figures["rotation_rad"] == pytest.approx(0.3)
    assert "object_lost_at_s" not in figures


def test_a_real_hand_has_what_a_tracker_told(tmp_path: Path) -> None:
    """And not what the controller makes of it."""
    pytest.importorskip("mcap", reason="needs the extra 'hardware'")
    other = {"tracked_position": [0.0] * 3, "tracked_quaternion": [1.0, 0.0, 0.0, 0.0]}
    with LogWriter(tmp_path / "a.mcap") as log:
        for i in range(4):
            turned = [np.cos(0.1 * i), 0.0, 0.0, np.sin(0.1 * i)]
            told = {"tracked_position": [0.0, 0.0, 0.13], "tracked_quaternion": turned}
            log.write("/tick", tick(i, **told, diagnostics=other))
    assert figures_of_merit(read_log(tmp_path / "a.mcap"))["rotation_rad"] == pytest.approx(0.6)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--object-pose touch --tracker-age 0.1", "--tracker-age is 0.1 and --object-pose touch"),
        ("--object-pose tracked --tracker-age 0.3", "--tracker-age is 0.3; expected 0 to less"),
        ("--object-pose tracked --tracker-age nan", "--tracker-age is nan; expected 0 to less"),
    ],
)
def test_ages_of_poses_that_are_refused(
    words: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    told = f"hardware run dex5-seen --emulate --object cube {words}"
    assert main(told.split()) == 2
    assert said in capsys.readouterr().err


def test_poses_are_told_as_old_as_a_policy_has_learned_by(dex5: dexctl.HandModel) -> None:
    policy = policies.load("dex5-cube-goals-touch", hand=dex5)
    late = policies.load("dex5-cube-goals", hand=dex5)
    assert policy.pose_age is None and late.pose_age == 0.1
    for controller, asked, sensing, age, latency in (
        (policy, None, {}, 0.0, 0.0),
        (late, None, {}, 0.1, 0.1),
        (GoalPursuit(dex5, reacher=late), None, {}, 0.1, 0.1),
        (late, 0.0, {}, 0.0, 0.0),
        (late, None, {"tracker_latency": 0.2}, 0.1, 0.2),
        (late, None, {"sensor_latency": 0.04}, 0.1, 0.06),
        (late, None, {"object_pose": "touch"}, 0.0, 0.0),
    ):
        scene = SceneConfig(sensing=Sensing(**{"object_pose": "tracked", **sensing}))
        run = Run(controller="a policy", emulate=True, tracker_age=asked)
        held, found = run._aged(scene, controller)
        assert (found, held.sensing.tracker_latency) == (age, pytest.approx(latency))
    card = deepcopy(late.card)
    card["trained"]["env"]["scene"]["sensing"]["object_pose"] = "touch"
    assert policies.Policy(dex5, late.layers, late.spec, card).pose_age is None


def test_a_busy_machine_is_told_of(monkeypatch: pytest.MonkeyPatch) -> None:
    late = RunReport(outcome=State.FAULT, cause=Event.READS_LOST)
    monkeypatch.setattr("os.getloadavg", lambda: (9.5, 9.0, 9.0))
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    assert "load 9.5 on 2 cores" in busy(HandOptions(emulate=True), late)
    assert busy(HandOptions(), late) == ""  # a hand is no emulator
    assert busy(HandOptions(emulate=True), RunReport(cause=Event.ALERT)) == ""
    monkeypatch.setattr("os.getloadavg", lambda: (1.5, 1.0, 1.0))
    assert busy(HandOptions(emulate=True), late) == ""
