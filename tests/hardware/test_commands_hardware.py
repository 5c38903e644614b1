"""`dexctl hardware ...` on the emulator: what is typed, printed, written and returned."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

import dexctl
from dexctl.cli import commands, main
from dexctl.exceptions import InvalidInput
from dexctl.rotations import angle_between
from dexctl.sim.trial import rotation_about
from hardware.bus import Bus
from hardware.calibration import Calibration
from hardware.cli.calibrate import _EmulatedPerson, from_poses, odd_travels
from hardware.cli.check import _Look
from hardware.cli.latency import delays
from hardware.cli.options import HandOptions
from hardware.cli.run import Run
from hardware.emulator import Emulator
from hardware.figures import figures_of_merit
from hardware.hand import ServoHand
from hardware.log import LogWriter, read_log
from hardware.motions import Replay, Sine, StepAndChirp, lag
from hardware.report import build
from hardware.tracking import UdpTracker
from hardware.units import to_servo
from learning import policies

# A real-time loop: on a machine that others keep busy its deadlines pass, as they should.
real_time = pytest.mark.slow

# the machine may be busy with other tests
PATIENT = ["--emulate", "--patience", "10"]


@pytest.fixture(autouse=True)
def group(monkeypatch: pytest.MonkeyPatch, learned: None) -> None:
    point = EntryPoint("hardware", "hardware.cli:COMMANDS", commands.GROUP)
    monkeypatch.setattr(commands, "entry_points", lambda group: [point])


def test_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["hardware", "--help"]) == 0
    said = capsys.readouterr().out
    for name in ("check", "calibrate", "run", "latency", "replay", "report"):
        assert f"  {name} " in said
    assert main(["--help"]) == 0
    assert "hardware      Check, calibrate and run a servo hand" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["run", "fly", "--emulate"], "unknown controller 'fly'; known: igm"),
        (["run", "igm"], "igm goes by touch; expected --tactile PORT"),
        (["run", "igm", "--emulate", "--port", "/dev/x"], "--emulate and --port /dev/x"),
        (["run", "sine", "--emulate", "--rate", "0"], "--rate is 0.0"),
        (["run", "learned", "--emulate", "--rate", "50"], "was trained with 0.05"),
        (["run", "none.npz", "--emulate"], "policy 'none.npz': no such file"),
        (
            ["run", "sine", "--emulate", "--speed-limit", "9"],
            "speed_limit is 9.0; expected at most 3.0",
        ),
        (["run", "sine", "--emulate", "--torque-limit", "nan"], "torque_limit is nan"),
        (["run", "sine", "--emulate", "--seconds", "inf"], "--seconds is inf"),
        (["run", "sine", "--emulate", "--gravity", "left"], "'left'"),
        (["run", "sine", "--emulate", "--speed-limit", "none"], "--speed-limit is none"),
        (["run", "igm", "--emulate", "--object", "cube", "sphere"], "expected one object"),
        (
            ["run", "sine", "--emulate", "--object-mass", "0.2", "--push-force", "1"],
            "--object-mass, --push-force: the hand is empty",
        ),
        (
            ["run", "sine", "--push-force", "1", "--joint-noise", "0.1", "--action-latency", "0.1"],
            "--joint-noise, --push-force, --action-latency: a real hand cannot be told",
        ),
        (["run", "igm", "--emulate", "--control-period", "0.1"], "--control-period"),
        (["check", "--emulate", "--object-mass", "0.2"], "--object-mass"),
        (["check", "--action-latency", "0.1"], "--action-latency: a real hand cannot be told"),
        (["latency", "--emulate", "--action-latency", "2"], "--action-latency is 2.0; expected"),
        (["replay", "a.mcap", "--speed-limit", "1"], "--speed-limit"),
        (["run", "nowhere:make", "--emulate"], "'nowhere:make'; it cannot be loaded"),
        (["run", "hold", "--emulate", "--object", "pear"], "unknown object 'pear'"),
        (["run", "sine", "--emulate", "--patience", "0"], "patience is 0.0"),
        (["run", "sine", "--emulate", "--stiffness", "-1"], "stiffness is -1.0"),
        (
            ["run", "igm", "--emulate", "--object-pose", "odometry"],
            "unknown object_pose 'odometry'; known: unknown, touch, tracked",
        ),
        (
            ["run", "hold", "--object-pose", "tracked"],
            "--object-pose is tracked; expected --tracker [HOST:]PORT, where poses are sent (or",
        ),
        (
            ["run", "hold", "--tracker", "5005"],
            "--tracker is 5005 and --object-pose unknown; expected tracked with it",
        ),
        (
            ["run", "hold", "--tracker", "here", "--object-pose", "tracked"],
            "the tracker's port is 'here'; expected [HOST:]PORT",
        ),
        (
            ["run", "hold", "--emulate", "--tracker-latency", "0.1"],
            "--tracker-latency: --object-pose is unknown; expected tracked with it",
        ),
        (
            ["run", "hold", "--emulate", "--tracker", "5005", "--object-pose", "tracked"],
            "--emulate and --tracker 5005 are given; expected one of them",
        ),
        (
            [
                "run",
                "hold",
                "--tracker",
                "5005",
                *["--object-pose", "tracked"],
                *["--object", "none"],
            ],
            "--object-pose is tracked; the empty hand has no object that is tracked",
        ),
        (
            [
                "run",
                "hold",
                "--tracker",
                "5005",
                *["--object-pose", "tracked"],
                *["--tracker-latency", "0.1"],
            ],
            "--tracker-latency: a real hand cannot be told",
        ),
        (["run", "hold", "--emulate", "--object-pose", "touch"], "hold has no object that is"),
        (
            ["run", "igm", "--emulate", "--object", "none", "--object-pose", "touch"],
            "the empty hand has no object that is touched",
        ),
        (
            ["run", "goal", "--emulate", *["--goal", "1", "0", "0", "0"]],
            "--goal is (1.0, 0.0, 0.0, 0.0) and --object-pose unknown; expected touch or tracked",
        ),
        (
            ["run", "igm", "--emulate", *["--goal", "1", "0", "0", "0", "--object-pose", "touch"]],
            "igm goes to none, expected goal, steered:NAME, sequence:ABOUT,ACROSS or a policy",
        ),
        (
            [
                "run",
                "dex5-easy",
                "--emulate",
                *["--goal", "1", "0", "0", "0"],
                *["--object-pose", "touch"],
            ],
            "dex5-easy goes to none, expected goal, steered:NAME",
        ),
        (
            ["run", "dex5-cube-goals", "--emulate", *["--object-pose", "touch"]],
            "dex5-cube-goals acts only where it has a goal; expected --goal W X Y Z",
        ),
        (
            ["run", "igm", "--emulate", *["--spin", "0", "0", "-0.5"]],
            "--spin is (0.0, 0.0, -0.5); igm turns nothing as it is told, expected goal, commanded",
        ),
        (["run", "chirp", "--emulate", *["--spin", "0", "0", "1"]], "chirp turns nothing as it is"),
        (
            ["run", "dex5-cylinder", "--emulate", *["--spin", "0", "0", "1"]],
            "dex5-cylinder turns nothing as it is told",
        ),
        (
            ["run", "dex5-axes", "--emulate"],
            "dex5-axes acts only where it is told how to turn the object; expected --spin X Y Z",
        ),
        (
            [
                "run",
                "goal",
                "--emulate",
                *["--spin", "0", "0", "1", "--object-pose", "touch"],
                *["--goal", "1", "0", "0", "0"],
            ],
            "--spin is (0.0, 0.0, 1.0) and --goal (1.0, 0.0, 0.0, 0.0); expected one of them",
        ),
        (
            ["run", "dex5-axes", "--emulate", *["--spin", "0", "0", "5", "--object-pose", "touch"]],
            "angular_velocity is (0, 0, 5) rad/s; the policy was trained with commands x, -x",
        ),
        (
            ["run", "dex5-axes", "--emulate", *["--spin", "0", "0", "nan"]],
            "spin is (0.0, 0.0, nan); expected three finite numbers [rad/s]",
        ),
        (
            ["run", "goal", "--emulate", *["--goal", "2", "0", "0", "0", "--object-pose", "touch"]],
            "goal is (2, 0, 0, 0); expected a unit quaternion",
        ),
        (["run", "regulated:igm", "--emulate"], "expected --object-pose touch or tracked, or a"),
        (["check", "--hand", "claw"], "unknown hand 'claw'"),
        (["check", "--calibration", "none.toml"], "none.toml is no calibration file"),
        (["check", "--emulate", "--reboot", "300"], "--reboot is 300"),
        (["latency", "--emulate", "--joint", "knee"], "unknown joint 'knee'"),
        (["replay", "none.mcap"], "cannot read none.mcap"),
        (["replay", "a.mcap", "--emulate", "--port", "/dev/x"], "--emulate and --port /dev/x"),
        (["report", "none.mcap"], "cannot read none.mcap"),
        (["calibrate", "--emulate", "--torque-constant", "0"], "--torque-constant is 0.0"),
        # not after somebody has moved every joint
        (["calibrate", "--out", "tests"], "--out is 'tests'; cannot write there: Is a directory"),
        (
            ["run", "sine", "--emulate", "--object", "none", "--object-friction", "0.5"],
            "--object-friction",
        ),
    ],
)
def test_bad_arguments(
    words: list[str], said: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    out = ["--out", str(tmp_path)] if words[0] == "run" else []
    assert main(["hardware", *words, *out]) == 2
    error = capsys.readouterr().err
    assert said in error and len(error.strip().splitlines()) == 1


def test_the_servos_are_told_what_they_always_were(dex5: dexctl.HandModel) -> None:
    for options in (HandOptions(), Run(controller="igm")):
        limits = options.limits()
        assert (limits.speed_limit, limits.torque_limit) == (0.6, 0.5)
        told = {to_servo(gains) for gains in options.gains(limits, dex5)}
        assert told == {(168, 1053, 143, 25)}
    assert Run(controller="igm").scene.sensing.touch_threshold == 1.0


def test_what_auto_holds() -> None:
    for controller, held in (("sine", "none"), ("hold", "cylinder"), ("igm", "cylinder")):
        assert Run(controller=controller).held().object == (held,)


def test_a_port_must_be_named_or_the_only_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hardware.cli.options.ports", lambda: ["/dev/a", "/dev/b"])
    with pytest.raises(InvalidInput, match="expected one of the ports here: /dev/a, /dev/b"):
        HandOptions().find_port()
    monkeypatch.setattr("hardware.cli.options.ports", lambda: ["/dev/a"])
    assert HandOptions().find_port() == "/dev/a"


def test_a_port_that_is_not_there(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["hardware", "check", "--port", "/dev/none"]) in (1, 2)
    assert "/dev/none" in capsys.readouterr().err


@real_time
def test_calibrate_then_check(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "hand.toml"
    assert main(["hardware", "calibrate", "--emulate", "--seed", "3", "--out", str(path)]) == 0
    found, hand = Calibration.load(path), dexctl.hands.load("dex5")
    truth = _EmulatedPerson(hand, list(range(1, 16)), 3)
    np.testing.assert_array_equal(found.sign, truth.signs)
    np.testing.assert_allclose(found.zero, truth.zeros * 2 * np.pi / 4096, atol=1e-6)
    np.testing.assert_allclose(found.lower, hand.lower, atol=2e-3)
    np.testing.assert_allclose(found.upper, hand.upper, atol=2e-3)
    capsys.readouterr()
    assert main(["hardware", "check", *PATIENT, "--json", "--calibration", str(path)]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["problems"] == [] and len(said["servos"]) == 15
    assert {row["model"] for row in said["servos"]} == {1030}
    assert max(abs(row["position_rad"]) for row in said["servos"]) < 2e-3
    assert 0 < said["cycle_s"]["p50"] < 1


def test_calibration_from_poses_that_cannot_be(dex5: dexctl.HandModel) -> None:
    zero, servo = np.full(15, 3.0), np.arange(1, 16)
    poses = {"zero": zero, "upper": zero + dex5.upper, "lower": zero + dex5.lower}
    assert (from_poses(dex5, poses, servo).sign == 1).all() and odd_travels(dex5, poses) == []
    still = {**poses, "lower": poses["upper"]}
    with pytest.raises(InvalidInput, match=r"f1_roll \(servo 1\) moved by 0.000 rad"):
        from_poses(dex5, still, servo)
    beside = {**poses, "zero": zero + 2.0}
    with pytest.raises(InvalidInput, match="is not between its ends"):
        from_poses(dex5, beside, servo)
    short = {**poses, "upper": poses["upper"] - np.eye(15)[0] * 0.5}
    assert odd_travels(dex5, short) == ["f1_roll travels 0.90 rad; the model has 1.40"]


def test_check_names_what_is_wrong(dex5: dexctl.HandModel) -> None:
    with Emulator(15) as emulator, Bus(emulator.port, range(1, 16), timeout=0.05) as bus:
        emulator.silence(6)
        emulator.overload(2)
        emulator.voltage(9.7, 4)
        look = _Look(ServoHand(bus, dex5))
        look.at_servos(bus)
    assert look.silent == [6]
    assert len(look.problems) == 3
    said = "\n".join(look.problems)
    assert "servo 6" in said and "does not answer" in said
    assert "servo 2" in said and "overload" in said and "--reboot 2" in said
    assert "servo 4" in said and "9.7 V; expected 10.0 to 14.8" in said


@real_time
def test_run_replay_and_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    words = ["run", "sine", "--seconds", "1", "--json", "--out", str(first), *PATIENT]
    assert main(["hardware", *words]) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["outcome"], said["torque"]) == ("idle", "off")
    assert said["figures"]["tracking_rms_rad"] < 0.05
    log = read_log(first / "run.mcap")
    assert log.run["controller"] == "sine" and log.run["emulated"] and not log.cut
    page = (first / "report.html").read_text()
    assert "torque off, confirmed by all 15 servos" in page and "<script" not in page

    words = ["replay", str(first / "run.mcap"), "--out", str(second), "--patience", "10"]
    assert main(["hardware", *words]) == 0
    assert "joints against those of the log" in capsys.readouterr().out
    assert main(["hardware", *words[:2], "--out", str(first)]) == 2

    content = (first / "run.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(content[: len(content) // 2])
    assert main(["hardware", "report", str(tmp_path / "cut.mcap")]) == 0
    assert "the log was cut off" in capsys.readouterr().out
    assert "No summary" in (tmp_path / "report.html").read_text()


@real_time
def test_in_grasp_manipulation_turns_the_object(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["run", "igm", "--seconds", "10", "--json", "--out", str(tmp_path), *PATIENT]
    assert main(["hardware", *words]) == 0
    said = json.loads(capsys.readouterr().out)
    # the bare simulator turns it by 0.9 to 2.1 rad before a limit or a lost contact
    assert said["figures"]["rotation_rad"] > 0.5
    assert "Touch" in (tmp_path / "report.html").read_text()


@real_time
def test_an_object_is_tracked_by_touch(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Over the bus, where the emulator alone knows where it is."""
    words = ["run", "regulated:coordinated", "--object", "cube", "--object-pose", "touch"]
    words += ["--seconds", "5", "--json", "--out", str(tmp_path)]
    assert main(["hardware", *words, *PATIENT]) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["outcome"], said["torque"]) == ("idle", "off")
    log = read_log(tmp_path / "run.mcap")
    assert log.run["scene"]["sensing"]["object_pose"] == "touch"
    told = [one for one in log.ticks["diagnostics"] if "tracked_position" in one]
    rows = [i for i, one in enumerate(log.ticks["diagnostics"]) if "tracked_position" in one]
    assert len(rows) > 50
    place = np.array([one["tracked_position"] for one in told])
    turn = np.array([one["tracked_quaternion"] for one in told])
    # the truth is of the tick's beginning, what is tracked of the controller's answer to the last
    assert np.abs(place - log.ticks["object_position"][rows]).max() < 0.01
    assert angle_between(turn, log.ticks["object_quaternion"][rows]).max() < 0.15


@real_time
def test_an_object_is_seen_by_a_tracker(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A policy that needs to see, on the emulator's tracker: late, and with noise."""
    words = ["run", "dex5-seen", "--object", "cube", "--object-pose", "tracked"]
    words += ["--tracker-latency", "0.05", "--tracker-position-noise", "0.002"]
    words += ["--seconds", "8", "--json", "--out", str(tmp_path)]
    assert main(["hardware", *words, *PATIENT]) == 0
    figures = json.loads(capsys.readouterr().out)["figures"]
    assert figures["rotation_rad"] > 2.0 and "object_lost_at_s" not in figures
    ticks = read_log(tmp_path / "run.mcap").ticks
    off = ticks["tracked_position"] - ticks["object_position"]
    assert 0.001 < np.std(off[ticks["state"] == "run"]) < 0.004
    np.testing.assert_allclose(np.median(ticks["tracked_age"]), 0.05, atol=0.02)


def test_poses_come_from_another_process(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As on a real hand: servos at a port, a tracker that sends to a UDP port."""
    where = UdpTracker("0")
    where.close()  # free again: the run takes it
    q = np.array([np.cos(0.2), 0.0, 0.0, np.sin(0.2)])
    sender = subprocess.Popen([sys.executable, "-c", _SENDER, str(where.port)])
    try:
        with Emulator(15) as emulator:
            words = ["run", "hold", "--port", emulator.port, "--object", "cube", "--seconds", "0.5"]
            words += ["--object-pose", "tracked", "--tracker", str(where.port)]
            words += ["--patience", "10", "--json", "--out", str(tmp_path)]
            assert main(["hardware", *words]) == 0
    finally:
        sender.kill()
        sender.wait()
    assert json.loads(capsys.readouterr().out)["figures"]["rotation_rad"] == 0.0
    ticks = read_log(tmp_path / "run.mcap").ticks
    np.testing.assert_allclose(ticks["tracked_position"], [[0.0, 0.01, 0.13]] * len(ticks["time"]))
    np.testing.assert_allclose(ticks["tracked_quaternion"], [q] * len(ticks["time"]), atol=1e-5)


_SENDER = """
import socket, sys, time
import numpy as np
from hardware.tracking import pose_line
line = pose_line(np.array([0.0, 0.01, 0.13]), np.array([np.cos(0.2), 0, 0, np.sin(0.2)]), 0.03)
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
    while True:
        sender.sendto(line, ("127.0.0.1", int(sys.argv[1])))
        time.sleep(0.02)
"""


def test_what_a_tracker_tells_is_checked(capsys: pytest.CaptureFixture[str]) -> None:
    where = UdpTracker("0")
    where.close()
    sender = subprocess.Popen([sys.executable, "-c", _SENDER, str(where.port)])
    words = ["check", "--patience", "10", "--json", "--tracker", str(where.port)]
    try:
        with Emulator(15) as emulator:
            assert main(["hardware", *words, "--port", emulator.port]) == 0
            told = json.loads(capsys.readouterr().out)["tracker"]
            sender.kill()
            sender.wait()
            assert main(["hardware", *words, "--port", emulator.port]) == 1
            problems = json.loads(capsys.readouterr().out)["problems"]
    finally:
        sender.kill()
        sender.wait()
    assert told["position_m"] == [0.0, 0.01, 0.13] and max(told["spread_m"]) < 1e-12
    assert 5 < told["rate_hz"] < 60 and 0.02 < told["age_s"] < 0.2 and told["no_poses"] == 0
    assert problems == ["the tracker has told no pose for 2 s"]


def test_a_tracker_that_says_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with Emulator(15) as emulator:
        words = ["run", "hold", "--port", emulator.port, "--object", "cube"]
        words += ["--object-pose", "tracked", "--tracker", "0", "--out", str(tmp_path)]
        assert main(["hardware", *words]) == 2
        assert "the tracker has told no pose for 2 s; expected" in capsys.readouterr().err
        assert not any(emulator.state()["torque_on"])


def test_help_says_what_servos_know_of_the_object(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["hardware", "run", "--help"]) == 0
    shown = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "--object-pose {unknown,touch,tracked} How the object's pose is known" in shown
    assert "odometry" not in shown and "--tracker-latency" in shown and "--touch-force" in shown


@real_time
def test_a_goal_is_come_to_without_a_camera(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A cube on its side, by two policies in sequence: a quarter about x, in 3 s or so."""
    words = ["run", "sequence:dex5-cube-z-any@0.4,dex5-cube-x-any", "--object", "cube"]
    words += ["--object-pose", "touch", "--goal", "0.7071", "0.7071", "0", "0"]
    words += ["--seconds", "15", "--json", "--out", str(tmp_path)]
    assert main(["hardware", *words, *PATIENT]) == 0
    figures = json.loads(capsys.readouterr().out)["figures"]
    assert figures["goal_reached_at_s"] < 15 and figures["left_to_goal_rad"] < 0.4
    assert "object_lost_at_s" not in figures
    assert "left to the goal" in (tmp_path / "report.html").read_text()


@real_time
@pytest.mark.parametrize("who", ["dex5-axes", "commanded:dex5-cube-z,dex5-cube-x"])
def test_the_object_is_turned_as_told(
    who: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["run", who, "--object", "cube", "--spin", "0.5", "0", "0", "--seconds", "6", "--json"]
    assert main(["hardware", *words, "--out", str(tmp_path), *PATIENT]) == 0
    assert "object_lost_at_s" not in json.loads(capsys.readouterr().out)["figures"]
    log = read_log(tmp_path / "run.mcap")
    assert log.run["goal_angular_velocity"] == [0.5, 0.0, 0.0]
    turned = rotation_about(log.ticks["object_quaternion"], (1.0, 0.0, 0.0))
    assert turned[-1] > 0.8


@real_time
@pytest.mark.parametrize("policy", ["learned", str(policies.FOLDER / "dex5-cylinder.npz")])
def test_a_learned_policy_turns_the_object(
    policy: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["run", policy, "--seconds", "5", "--json", "--out", str(tmp_path), *PATIENT]
    assert main(["hardware", *words]) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["outcome"], said["torque"]) == ("idle", "off")
    # in the simulator it turns it all the way round in 20 s
    assert said["figures"]["rotation_rad"] > 1.0
    assert "object_lost_at_s" not in said["figures"]
    assert read_log(tmp_path / "run.mcap").run["rate_hz"] == 20.0


def test_a_log_without_ticks_gives_a_page(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "a.mcap") as log:
        log.write("/run", {"controller": "sine"})
    found = read_log(tmp_path / "a.mcap")
    assert figures_of_merit(found) == {}
    assert "The log holds no ticks" in build(found)


def test_lag_is_found_between_samples() -> None:
    time = np.arange(0, 8, 0.01)
    chirp = np.sin(2 * np.pi * (0.3 + 0.1 * time) * time)
    for delay in (0.0, 0.043, 0.1):
        late = np.interp(time - delay, time, chirp, left=0.0)
        assert lag(chirp, late, 0.01) == pytest.approx(delay, abs=2e-3)
    assert np.isnan(lag(np.zeros(100), np.zeros(100), 0.01))


def test_step_and_chirp_delays_by_hand(dex5: dexctl.HandModel) -> None:
    motion = StepAndChirp(dex5, 2, control_period=0.01)
    time = np.arange(0, motion.seconds, 0.01)
    sent = np.array([motion.offset(t)[2] for t in time])
    came = np.interp(time - 0.05, time, sent, left=0.0)
    step, chirp = delays(np.stack([time, sent, came], axis=1), motion.STEP_SECONDS, 0.01)
    assert step == pytest.approx(0.05, abs=0.011) and chirp == pytest.approx(0.05, abs=2e-3)


def test_motions_start_where_the_set_points_are(dex5: dexctl.HandModel) -> None:
    def state(q_target: np.ndarray) -> dexctl.GraspState:
        return dexctl.GraspState(
            q=q_target,
            q_target=q_target,
            in_contact=np.zeros(5, bool),
            contact_position=np.zeros((5, 3)),
            contact_normal=np.zeros((5, 3)),
            contact_force=np.zeros(5),
        )

    sine = Sine(dex5, control_period=0.5, amplitude=0.1, frequency=0.5)
    q = np.full(15, 0.2)
    q = q + sine.act(state(q))  # a quarter of a period of 2 s
    np.testing.assert_allclose(q, 0.3)
    q = q + sine.act(state(q))
    np.testing.assert_allclose(q, 0.2, atol=1e-12)
    rows = np.linspace(0, 1, 30).reshape(2, 15)
    replay = Replay(dex5, rows)
    np.testing.assert_allclose(q + replay.act(state(q)), rows[0])
    np.testing.assert_allclose(q + replay.act(state(q)), rows[1])
    np.testing.assert_allclose(q + replay.act(state(q)), rows[1])
    with pytest.raises(InvalidInput, match=r"q_target has shape \(2, 14\)"):
        Replay(dex5, rows[:, 1:])
