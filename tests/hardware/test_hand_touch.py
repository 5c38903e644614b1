"""Touch from the servos' torques, from switches, and hands of their owner's file."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

import dexctl
from dexctl import JointTouch, hands
from dexctl.cli import commands, main
from dexctl.hand_toml import to_toml
from dexctl.state import Bools
from hardware.bus import Bus
from hardware.emulator import Emulator
from hardware.hand import ServoHand
from hardware.limits import Limits
from hardware.log import read_log
from hardware.tactile import TactileReading, judge
from hardware.units import SimGains

pytest.importorskip("dynamixel_sdk", reason="needs the extra 'hardware'")

PATIENT = Limits(watchdog=2.4, command_age=2.0, state_age=3.0, overruns=(1.0, 1.0))


@pytest.fixture(autouse=True)
def group(monkeypatch: pytest.MonkeyPatch) -> None:
    point = EntryPoint("hardware", "hardware.cli:COMMANDS", commands.GROUP)
    monkeypatch.setattr(commands, "entry_points", lambda group: [point])


@pytest.fixture(scope="module")
def emulator() -> Iterator[Emulator]:
    with Emulator(15, start=[0.1] * 15) as emulator:
        yield emulator


class Switches:
    """Fingertips that are said to touch."""

    def __init__(self, touch: Bools) -> None:
        self.touch = touch

    def read(self) -> TactileReading:
        ones = np.ones(len(self.touch))
        normal = np.tile([0.0, 0.0, 1.0], (len(ones), 1))
        return judge(0 * normal, normal, np.where(self.touch, 5.0, 0.0), 0 * ones, 0.0)

    def close(self) -> None: ...


def pressing(hand: ServoHand, emulator: Emulator) -> None:
    """Finger 2 is pushed against something that holds its joints fast."""
    emulator.reset()
    hand.arm()
    emulator.block(4, 5, 6)
    goal = hand.q_target.copy()
    goal[3:6] -= [0.0, 0.1, 0.03]  # flexing is negative
    for _ in range(40):
        hand.sample()
        hand.write(goal)
        hand.step()


def test_touch_of_torques_is_what_joint_touch_says(
    emulator: Emulator, dex5: dexctl.HandModel
) -> None:
    with Bus(emulator.port, range(1, 16), timeout=0.2) as bus:
        touch = JointTouch(dex5, 3.0, control_period=0.02)
        hand = ServoHand(bus, dex5, limits=PATIENT, gains=SimGains(3.0, 0.15, 0.5, 0.6),
                         joint_touch=touch)  # fmt: skip
        pressing(hand, emulator)
        sample = hand.sample()
        # what the servos measure is what set-points less joints make of the stiffness
        np.testing.assert_allclose(sample.torque[4:6], [-0.3, -0.09], rtol=0.1)
        plain = JointTouch(dex5, 3.0, control_period=0.02)
        for _ in range(30):
            state = hand.state(sample)
            expected = plain(replace(state, in_contact=np.zeros(5, bool)), torque=sample.torque)
        np.testing.assert_array_equal(state.in_contact, expected.in_contact)
        np.testing.assert_allclose(state.contact_force, expected.contact_force)
        np.testing.assert_allclose(state.contact_normal, expected.contact_normal)
        assert state.in_contact.tolist() == [False, True, False, False, False]
        said = hand.touch
        assert not said.stale.any() and said.in_contact.tolist() == state.in_contact.tolist()
        np.testing.assert_allclose(said.force, state.contact_force)
        hand.disarm()
        hand.arm()  # what was felt before is forgotten
        assert not touch.state_dict()["past"]
        hand.disarm()


def test_switches_say_who_touches(emulator: Emulator, dex5: dexctl.HandModel) -> None:
    says = np.array([True, False, False, False, True])
    with Bus(emulator.port, range(1, 16), timeout=0.2) as bus:
        hand = ServoHand(bus, dex5, limits=PATIENT, gains=SimGains(3.0, 0.15, 0.5, 0.6),
                         tactile=Switches(says),
                         joint_touch=JointTouch(dex5, 3.0, control_period=0.02))  # fmt: skip
        pressing(hand, emulator)
        state = hand.read()
        assert state.in_contact.tolist() == says.tolist()
        assert not state.contact_normal[1].any()
        # normals are told from the joints, not by the switches
        lengths = np.linalg.norm(state.contact_normal[says], axis=1)
        np.testing.assert_allclose(lengths, 1.0)
        assert not np.allclose(state.contact_normal[0], [0, 0, 1])
        hand.disarm()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["igm"], "igm goes by touch; expected --tactile PORT, --touch joint-torque"),
        (["igm", "--touch", "binary"], "igm goes by touch; expected --tactile PORT"),
        (["igm", "--touch", "joint-torque", "--tactile", "/dev/x"], "--touch is joint-torque and"),
        (["igm", "--emulate", "--touch", "smell"], "smell"),
        (["igm", "--touch", "joint-torque", "--port", "/dev/none"], "/dev/none: no such port"),
    ],
)
def test_bad_arguments(
    words: list[str], said: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert main(["hardware", "run", *words, "--object", "none", "--out", str(tmp_path)]) in (1, 2)
    assert said in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("touch", ["joint-torque", "binary"])
def test_the_gait_turns_the_object_without_touch_sensors(
    touch: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["run", "coordinated", "--emulate", "--seconds", "6", "--touch", touch, "--json"]
    assert main(["hardware", *words, "--patience", "10", "--out", str(tmp_path)]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["torque"] == "off" and "object_lost_at_s" not in said["figures"]
    assert said["figures"]["rotation_rad"] > 0.2
    assert read_log(tmp_path / "run.mcap").run["touch"] == touch


def my_hand(folder: Path) -> Path:
    """dex5 as somebody's own hand, whose controller board counts the joints from the last."""
    config = hands.config("dex5")
    order = tuple(reversed(dexctl.hands.load("dex5").joint_names))
    path = folder / "my_hand.toml"
    own = replace(config, description=dexctl.hands.load("dex5").path, joints=order)
    path.write_text(to_toml(own, {}))
    return path


def test_a_hand_of_ones_own_in_the_order_of_its_board(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = my_hand(tmp_path)
    words = ["hardware", "check", "--emulate", "--hand", str(path), "--patience", "10", "--json"]
    main(words)
    rows = json.loads(capsys.readouterr().out)["servos"]
    assert (rows[0]["servo"], rows[0]["joint"]) == (1, "f5_flexion2")
    assert (rows[14]["servo"], rows[14]["joint"]) == (15, "f1_roll")
    words = ["hardware", "run", "sine", "--emulate", "--hand", str(path), "--seconds", "0.3"]
    out = tmp_path / "out"
    assert main([*words, "--patience", "10", "--json", "--out", str(out)]) == 0
    run = read_log(out / "run.mcap").run
    assert run["joints"][0] == "f5_flexion2" and run["joint_fingers"][0] == 4
    assert run["hand_files"]["toml"] == str(path) and len(run["hand_files"]["sha256"]) == 64
