"""Identification: from what servos did, the values that moved them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from dexctl import HandModel
from dexctl.cli import main
from dexctl.exceptions import InvalidInput
from dexctl.settings import changed
from dexctl.sim.conditions import under
from dexctl.sim.scene_config import SceneConfig
from dexctl.state import Floats
from hardware.cli.identify import gains_of, ranges_of
from hardware.cli.run import make_controller
from hardware.emulator.mujoco_hand import MujocoHand
from hardware.identification import JointDynamics, fit
from hardware.log import LogWriter
from hardware.motions import Chirp
from hardware.registers import RADIANS_PER_TICK
from hardware.scene import EMPTY

PERIOD, SPEED, TORQUE, TOLD = 0.02, 0.6, 0.5, 3.0
STIFFNESS, DAMPING, FRICTION, LATENCY = 2.6, 0.12, 0.03, 0.06


class Samples(NamedTuple):
    time: Floats
    q_target: Floats
    q: Floats
    velocity: Floats
    torque: Floats


@pytest.fixture(scope="module")
def chirp(dex5: HandModel) -> Samples:
    return chirped(dex5, replace(EMPTY, gear_friction=FRICTION))


def chirped(dex5: HandModel, scene: SceneConfig) -> Samples:
    """What the servos of the MuJoCo hand did, read as their encoders tell it."""
    joints = MujocoHand(scene)
    c = joints.commands
    c.torque_on[:], c.kp[:], c.kd[:] = True, STIFFNESS, DAMPING
    c.limit[:], c.speed[:] = TORQUE, SPEED
    joints.reference[:] = c.goal[:] = start = joints.q.copy()
    joints.set_action_latency(LATENCY)
    motion = Chirp(dex5, seconds=6.0)
    rows = []
    for i in range(int((motion.seconds + 0.5) / PERIOD)):
        c.goal[:] = dex5.clip(start + motion.offset((i + 1) * PERIOD))
        q = np.round(joints.q / RADIANS_PER_TICK) * RADIANS_PER_TICK
        rows.append((c.goal.copy(), q, joints.velocity.copy(), joints.torque.copy()))
        joints.advance(PERIOD)
    time = np.linspace(0.0, PERIOD * (len(rows) - 1), len(rows))
    return Samples(time, *np.swapaxes(np.array(rows), 0, 1))


def test_hidden_values_are_found(chirp: Samples) -> None:
    found = fit(*chirp, speed_limit=SPEED, torque_limit=TORQUE, told=TOLD)
    joints = found.dynamics
    assert joints.measured_torque.all()
    np.testing.assert_allclose(joints.stiffness, STIFFNESS, rtol=0.1)
    np.testing.assert_allclose(joints.servo_damping, DAMPING, rtol=0.15)
    np.testing.assert_allclose(joints.damping, DAMPING + 0.02, rtol=0.25)  # the joint's own: 0.02
    np.testing.assert_allclose(joints.friction, FRICTION, rtol=0.2)
    np.testing.assert_allclose(joints.latency, LATENCY, atol=0.01)
    assert (joints.inertia > 0.002).all() and (joints.inertia < 0.004).all()  # armature 0.002
    assert (joints.residual < 0.001).all()
    seen = found.moving
    assert np.abs(found.computed - found.q)[seen].max() < 0.01


@pytest.mark.slow
def test_gains_that_are_not_what_was_told_are_found(dex5: HandModel) -> None:
    hidden = {"stiffness_range": (0.8, 0.8), "gear_friction_range": (FRICTION, FRICTION)}
    samples = chirped(dex5, changed(EMPTY, hidden))
    joints = fit(*samples, speed_limit=SPEED, torque_limit=TORQUE, told=TOLD).dynamics
    np.testing.assert_allclose(joints.stiffness, 0.8 * STIFFNESS, rtol=0.1)
    np.testing.assert_allclose(joints.friction, FRICTION, rtol=0.2)


def test_without_measured_torque_the_gains_are_what_was_told(chirp: Samples) -> None:
    blind = chirp._replace(torque=np.full_like(chirp.torque, np.nan))
    one = Samples(blind.time, *(value[:, 2:3] for value in blind[1:]))
    joints = fit(*one, speed_limit=SPEED, torque_limit=np.inf, told=TOLD).dynamics
    assert not joints.measured_torque.any() and joints.stiffness == TOLD
    assert joints.residual < 0.001
    np.testing.assert_allclose(joints.latency, LATENCY, atol=0.03)


def test_a_joint_that_stands_still_is_left_out(chirp: Samples) -> None:
    still = chirp.q_target.copy()
    still[:, 1] = still[0, 1]
    two = Samples(chirp.time, *(value[:, 1:3] for value in chirp._replace(q_target=still)[1:]))
    joints = fit(*two, speed_limit=SPEED, torque_limit=TORQUE, told=TOLD).dynamics
    assert np.isnan([value[0] for value in joints[:-2]]).all()
    assert np.isfinite([value[1] for value in joints[:-2]]).all()
    still[:] = still[0]
    with pytest.raises(InvalidInput, match=r"no set-point moved by more than 0\.01 rad"):
        fit(*chirp._replace(q_target=still), speed_limit=SPEED, torque_limit=TORQUE, told=TOLD)


def test_a_joint_whose_motion_was_cut_short_is_not_explained(chirp: Samples) -> None:
    """The slow part of a chirp tells little of inertia, and fits all the same."""
    part = Samples(*(value[: int(10.0 / PERIOD)] for value in chirp))  # of 18 s, 6 for each joint
    told = {"speed_limit": SPEED, "torque_limit": TORQUE, "told": TOLD}
    joints = fit(*part, **told, motion=5.5).dynamics
    cut = np.arange(15) % 3 == 1
    np.testing.assert_array_equal(joints.cut_short, cut)
    np.testing.assert_array_equal(joints.explained, np.arange(15) % 3 == 0)
    assert not fit(*chirp, **told, motion=5.5).dynamics.cut_short.any()


def test_a_log_that_is_cut_off_is_said_to_be(
    dex5: HandModel, chirp: Samples, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "run.mcap"
    few = Samples(*(value[:400] for value in chirp))
    write_log(path, few, list(dex5.joint_names), about={"controller": "chirp"})
    path.write_bytes(path.read_bytes()[:-200])
    assert main(["hardware", "identify", str(path)]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "the log was cut off, after" in shown
    assert "of f1_roll, " in shown and "only a part of the chirp was seen" in shown
    assert "moved otherwise" not in shown
    said = json.loads((tmp_path / "identification.json").read_text())
    assert said["cut"] is True and not any(said["explained"]) and any(said["cut_short"])
    assert set(said["ranges"]) == {"stiffness_range", "action_latency_range"}


def test_the_chirp_moves_one_joint_of_a_finger_at_its_speed(dex5: HandModel) -> None:
    motion = make_controller("chirp", dex5)
    assert isinstance(motion, Chirp)
    path = np.array([motion.offset(t) for t in np.arange(0.0, motion.seconds, 0.001)])
    assert np.abs(np.diff(path, axis=0)).max() < 1.1 * motion.speed * 0.001
    assert np.abs(path).max() == pytest.approx(motion.amplitude, rel=0.01)
    moving = np.abs(np.diff(path, axis=0)) > 0
    assert (moving[:, dex5.finger_joints].sum(axis=2) <= 1).all()
    assert moving.any(axis=0).all()
    assert not motion.offset(motion.seconds + 1.0).any()


def write_log(
    path: Path,
    chirp: Samples,
    joints: list[str],
    *,
    state: str = "run",
    about: Mapping[str, Any] | None = None,
) -> None:
    with LogWriter(path) as log:
        log.write(
            "/run",
            {
                "scene": {"hand": "dex5"},
                "joints": joints,
                "limits": {"speed_limit": SPEED, "torque_limit": TORQUE},
                "stiffness_nm_per_rad": TOLD,
                "damping_nms_per_rad": 0.15,
                **(about or {}),
            },
        )
        for time, q_target, q, velocity, torque in zip(*chirp, strict=True):
            tick = {"time": time, "q": q, "q_target": q_target, "velocity": velocity}
            tick |= {"torque": torque, "state": state, "fresh": [True] * len(q), "age": 0.0}
            tick |= {"in_contact": [], "contact_force": [], "lateness": 0.0}
            while not log.write("/tick", tick):
                pass


def test_the_command_writes_ranges_to_train_with(
    dex5: HandModel, chirp: Samples, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "run.mcap"
    write_log(path, chirp, list(dex5.joint_names))
    there = tmp_path / "there"
    assert main(["hardware", "identify", str(path), "--out", str(there)]) == 0
    shown = capsys.readouterr().out
    assert "f5_flexion2" in shown and "N m/rad" in shown
    said = json.loads((there / "identification.json").read_text())
    np.testing.assert_allclose(said["armature"], 0.002, atol=0.001)
    scene = under(SceneConfig(stiffness=1.0), str(there / "ranges.toml"))
    assert (scene.stiffness, scene.damping) == (TOLD, 0.15)  # what the shares are of
    assert said["gains"] == {"stiffness": TOLD, "damping": 0.15}
    config = scene.randomisation
    for found, hidden in (
        (config.stiffness_range, STIFFNESS / TOLD),
        (config.damping_range, (DAMPING + 0.02) / 0.17),
        (config.gear_friction_range, FRICTION),
        (config.armature_range, 0.002),
        (config.action_latency_range, LATENCY),
    ):
        assert found is not None and found[0] < hidden < found[1]
    assert (there / "identification.png").read_bytes().startswith(b"\x89PNG")


def test_ranges_hold_what_was_found_whatever_the_servos_were_told(dex5: HandModel) -> None:
    """The shares are of the gains that the file sets, or of those of the hand's own file."""
    every = np.full(dex5.nq, 0.1)
    found = JointDynamics(
        stiffness=np.linspace(3.8, 4.0, dex5.nq), servo_damping=every, damping=every + 0.1,
        friction=every, inertia=every, latency=every, offset=every, residual=0.0 * every,
        measured_torque=every > 0, cut_short=every < 0,
    )  # fmt: skip
    each = [4.0] * (dex5.nq - 1) + [5.0]
    for stiffness, damping in ((4.0, 0.2), (each, 0.2), (each, each)):
        gains = gains_of({"stiffness_nm_per_rad": stiffness, "damping_nms_per_rad": damping})
        assert ("stiffness" in gains, "damping" in gains) == (stiffness == 4.0, damping == 0.2)
        ranges = ranges_of(dex5, found, every, gains)
        (scene,) = changed(SceneConfig(), gains).scenes(dex5)
        for name, values in (("stiffness", found.stiffness), ("damping", found.damping)):
            low, high = ranges[f"{name}_range"]
            own = getattr(scene, name)
            assert (low * own < values).all() and (values < high * own).all()


@pytest.mark.slow
def test_fingers_that_something_stops_tell_stiffness_and_latency_only(
    dex5: HandModel, chirp: Samples, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As an object does to fingers: joints stop, and servos press."""
    stop = chirp.q[0] + 0.02
    stopped = np.minimum(chirp.q, stop)
    torque = chirp.torque + STIFFNESS * (chirp.q - stopped)
    path = tmp_path / "run.mcap"
    velocity = np.where(chirp.q > stop, 0.0, chirp.velocity)
    pressed = chirp._replace(q=stopped, velocity=velocity, torque=np.clip(torque, -0.49, 0.49))
    write_log(path, pressed, list(dex5.joint_names))
    assert main(["hardware", "identify", str(path)]) == 0
    assert "15 joints moved otherwise than a mass behind a servo does" in capsys.readouterr().out
    said = json.loads((tmp_path / "identification.json").read_text())
    assert not any(said["explained"])
    assert set(said["ranges"]) == {"stiffness_range", "action_latency_range"}
    found = under(SceneConfig(), str(tmp_path / "ranges.toml")).randomisation
    assert found.stiffness_range is not None and found.action_latency_range is not None
    assert found.stiffness_range[0] < STIFFNESS / TOLD < found.stiffness_range[1]
    assert np.mean(found.action_latency_range) == pytest.approx(LATENCY, abs=0.02)


def test_logs_that_tell_nothing(
    dex5: HandModel, chirp: Samples, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    short, other = tmp_path / "short.mcap", tmp_path / "other.mcap"
    write_log(short, Samples(*(value[:50] for value in chirp)), list(dex5.joint_names))
    assert main(["hardware", "identify", str(short)]) == 2
    assert "holds 50 ticks of a controller; expected 100 or more" in capsys.readouterr().err
    write_log(other, chirp, list(dex5.joint_names), state="armed")
    assert main(["hardware", "identify", str(other)]) == 2
    assert "holds 0 ticks of a controller" in capsys.readouterr().err
    nameless = tmp_path / "nameless.mcap"
    write_log(nameless, Samples(*(value[:110] for value in chirp)), [])
    assert main(["hardware", "identify", str(nameless), "--hand", "dex5", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["joints"][:2] == ["joint 1", "joint 2"]
    assert said == json.loads((tmp_path / "identification.json").read_text())
    assert main(["hardware", "identify", str(tmp_path / "none.mcap")]) == 2
    assert "No such file" in capsys.readouterr().err
