"""What a hand's toml says of its servos: it counts for the commands, joint by joint."""

from __future__ import annotations

from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

import dexctl
from dexctl.cli import commands, main
from dexctl.exceptions import InvalidInput
from dexctl.sim import SceneConfig
from hardware import registers as R  # noqa: N812 (a table of names)
from hardware.bus import Bus
from hardware.cli.options import HandOptions, _grasp
from hardware.cli.run import Run
from hardware.emulator import Emulator
from hardware.emulator.mujoco_hand import MujocoHand
from hardware.findings import shares_at_limit, torque_limits
from hardware.hand import ServoHand
from hardware.identification import identify
from hardware.limits import Limits
from hardware.log import LogWriter, read_log
from hardware.report import build
from hardware.scene import HOLDING
from hardware.units import SimGains, to_servo

pytest.importorskip("dynamixel_sdk", reason="needs the extra 'hardware'")
FILE = Path(__file__).resolve().parents[1] / "hands" / "four_fingers.xml"
SERVOS = """
[servos]
stiffness = 1.5
damping = 0.08
effort = {ffj0 = 0.1, ffj1 = 0.2}
velocity = {ffj0 = 0.15, ffj2 = 0.3}
"""


@pytest.fixture
def weak(tmp_path: Path) -> str:
    """Four fingers, of whose servos the toml says something."""
    path = tmp_path / "weak.toml"
    tips = "\n".join(f"{name} = [0.0, 0.0, 0.0267]" for name in ("ff_tip", "mf_tip", "rf_tip"))
    path.write_text(f"description = '{FILE}'\n[fingertips]\n{tips}\nth_tip = [0, 0, 0.0267]\n")
    path.write_text(path.read_text() + SERVOS)
    return str(path)


def options(hand: str, **scene: float) -> HandOptions:
    asked = HandOptions(emulate=True, patience=10.0)
    asked.scene = replace(asked.scene, hand=hand, **scene)
    return asked


def own(hand: dexctl.HandModel, usual: float, **joints: float) -> np.ndarray:
    return np.array([joints.get(name, usual) for name in hand.joint_names])


def test_registers_hold_what_the_toml_says(weak: str) -> None:
    asked = options(weak)
    asked.check()
    with asked.open(asked.limits(), 0.02) as session:
        hand, bus = session.hand, session.bus
        hand.arm()
        torque = own(session.model, 0.5, ffj0=0.1, ffj1=0.2)
        speed = own(session.model, 0.6, ffj0=0.15, ffj2=0.3)
        for register in (R.GOAL_CURRENT, R.CURRENT_LIMIT):
            told = bus.read(register).value * hand.torque_constant
            np.testing.assert_allclose(told, torque, atol=0.5 * R.AMPERES * 1.3)
        told = bus.read(R.PROFILE_VELOCITY).value
        np.testing.assert_allclose(told, speed, atol=0.5 * R.RADIANS_PER_SECOND)
        gains = to_servo(SimGains(1.5, 0.08, 0.5, 0.6))
        assert set(bus.read(R.POSITION_P_GAIN).raw.tolist()) == {gains.p}
        assert set(bus.read(R.POSITION_D_GAIN).raw.tolist()) == {gains.d}
        # and no set-point moves faster
        before = hand.q_target.copy()
        middle = 0.5 * (session.model.lower + session.model.upper)
        sent = hand.write(before + np.copysign(0.1, middle - before))
        np.testing.assert_allclose(np.abs(sent - before), 0.02 * speed)
        hand.disarm()


def test_what_is_typed_counts_but_raises_no_limit(weak: str) -> None:
    model = dexctl.hands.load(weak)
    asked = options(weak, stiffness=2.5)
    limits = replace(asked.limits(), torque_limit=0.15, speed_limit=0.2)
    gains = asked.gains(limits, model)
    assert {one.kp for one in gains} == {2.5} and {one.kv for one in gains} == {0.08}
    torque = [one.torque_limit for one in gains]
    np.testing.assert_allclose(torque, own(model, 0.15, ffj0=0.1))
    speed = [one.speed_limit for one in gains]
    np.testing.assert_allclose(speed, own(model, 0.2, ffj0=0.15))
    high = asked.gains(replace(limits, torque_limit=3.0), model)
    # the file of the hand says 0.5 N m
    assert max(one.torque_limit for one in high) == 0.5


def test_a_hand_that_says_nothing_is_armed_as_ever(dex5: dexctl.HandModel) -> None:
    asked = options("dex5")
    gains = asked.gains(asked.limits(), dex5)
    assert gains == [SimGains(3.0, 0.15, 0.5, 0.6)] * 15


def test_gains_of_some_joints_only(weak: str) -> None:
    path = Path(weak)
    path.write_text(path.read_text().replace("stiffness = 1.5", "stiffness = {ffj1 = 1.0}"))
    asked, model = options(weak), dexctl.hands.load(weak)
    stiffness = [one.kp for one in asked.gains(asked.limits(), model)]
    np.testing.assert_allclose(stiffness, own(model, 3.0, ffj1=1.0))


def test_what_no_register_holds_is_said_of_its_joint(weak: str) -> None:
    path = Path(weak)
    path.write_text(path.read_text().replace("ffj2 = 0.3", "ffj2 = 0.001"))
    with pytest.raises(InvalidInput, match=r"ffj2: speed_limit is 0.001; the least that"):
        options(weak).check()
    model = dexctl.hands.load(weak)
    with (
        Emulator(16) as emulator,
        Bus(emulator.port, range(1, 17)) as bus,
        pytest.raises(InvalidInput, match=r"speed limit of ffj2 is 0.001 rad/s; expected more"),
    ):
        ServoHand(bus, model)


def test_gains_for_too_few_joints(dex5: dexctl.HandModel) -> None:
    with (
        Emulator(15) as emulator,
        Bus(emulator.port, range(1, 16)) as bus,
        pytest.raises(InvalidInput, match="2 gains; expected one, or one for each of 15 joints"),
    ):
        ServoHand(bus, dex5, gains=[SimGains(3.0, 0.15, 0.5, 0.6)] * 2)


def test_a_real_hand_goes_to_the_grasp_of_its_own_gains(weak: str) -> None:
    model = dexctl.hands.load(weak)
    asked = options(weak)
    gains = asked.gains(asked.limits(), model)
    scene = replace(HOLDING, hand=weak, object=("cube",), stiffness=None, damping=None)
    soft = _grasp(scene, model, gains)[0]
    np.testing.assert_allclose(soft, scene.scenes(model)[0].settled.q_target)  # toml says it all
    stiff = _grasp(scene, model, [one._replace(kp=4.0) for one in gains])[0]
    assert np.abs(stiff - soft).max() > 0.01


def test_the_emulated_joints_have_the_gains_of_their_servos(weak: str) -> None:
    hand = MujocoHand(SceneConfig(hand=weak, object=("none",), disturbance=0.0))
    c = hand.commands
    c.torque_on[:], c.limit[:] = True, 0.5
    c.kp[:], c.kd[:] = np.linspace(1.0, 4.0, 16), np.linspace(0.05, 0.2, 16)
    c.goal[:] = hand.q
    hand.advance(0.02)
    (model,) = hand._sim.sim.groups[0]._parameters.models
    actuators = hand._sim.sim.groups[0].scene.actuators
    np.testing.assert_allclose(model.actuator_gainprm[actuators, 0], c.kp)
    np.testing.assert_allclose(model.actuator_biasprm[actuators, 2], -c.kd)


def test_check_reads_back_what_the_toml_says(
    weak: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    point = EntryPoint("hardware", "hardware.cli:COMMANDS", commands.GROUP)
    monkeypatch.setattr(commands, "entry_points", lambda group: [point])
    words = ["check", "--emulate", "--patience", "10", "--hand", weak]
    code = main(["hardware", *words])
    lines = capsys.readouterr().out.splitlines()
    assert " 0.10 " in next(line for line in lines if "ffj0" in line)
    # on a busy machine the emulated bus can be slow; nothing else may be wrong
    problems = [line for line in lines if line.startswith("problem:")]
    assert all("slow bus" in line for line in problems)
    assert code == (1 if problems else 0)


def test_a_log_says_the_limits_of_each_joint(weak: str, tmp_path: Path) -> None:
    asked = Run(controller="sine", emulate=True)
    asked.scene = replace(asked.scene, hand=weak)
    model, calibration = asked.load()
    about = asked._about(model, calibration, asked.limits(), asked.held(), 0.02, 0.0)
    torque = own(model, 0.5, ffj0=0.1, ffj1=0.2)
    assert about["joint_limits"]["torque_limit"] == torque.tolist()
    assert (about["stiffness_nm_per_rad"], about["damping_nms_per_rad"]) == (1.5, 0.08)
    time = 0.02 * np.arange(150)
    q = 0.05 * np.sin(2 * np.pi * time)[:, None] * np.ones(16)
    with LogWriter(tmp_path / "a.mcap") as log:
        log.write("/run", about)
        for i, now in enumerate(time):
            log.write("/tick", {
                "time": now, "state": "run", "q": q[i], "q_target": q[i], "velocity": 0 * q[i],
                "torque": np.full(16, 0.099), "fresh": np.ones(16, bool), "age": 0.0,
                "in_contact": [False] * 4, "contact_force": [0.0] * 4, "lateness": 0.0,
            })  # fmt: skip
    found = read_log(tmp_path / "a.mcap")
    told = torque_limits(found)
    assert told is not None and told.tolist() == torque.tolist()
    shares = shares_at_limit(found, np.ones(150, bool))
    np.testing.assert_allclose(shares, own(model, 0.0, ffj0=1.0))
    page = build(found)
    assert "<td>torque limit [N m]</td><td>0.1 to 0.5</td>" in page
    assert "At the torque limit of 0.1 to 0.5 N m: ffj0 (100% of the run)" in page
    assert identify(found).dynamics.stiffness.shape == (16,)


def test_limits_of_python_are_the_hands_own_too(weak: str) -> None:
    model = dexctl.hands.load(weak)
    with Emulator(16) as emulator, Bus(emulator.port, range(1, 17)) as bus:
        hand = ServoHand(bus, model, limits=Limits(torque_limit=1.0, speed_limit=0.25))
    np.testing.assert_allclose(hand.torque_limit, own(model, 0.5, ffj0=0.1, ffj1=0.2))
    np.testing.assert_allclose(hand.speed_limit, own(model, 0.25, ffj0=0.15))
