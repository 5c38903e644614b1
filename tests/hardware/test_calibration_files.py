"""Joint and servo angles, turns, and the TOML file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import dexctl
from dexctl.exceptions import InvalidInput
from hardware.calibration import TURN, Calibration

TICK = TURN / 4096


@pytest.fixture
def nominal(dex5: dexctl.HandModel) -> Calibration:
    return Calibration.nominal(dex5)


def test_by_hand(nominal: Calibration) -> None:
    flipped = nominal.with_joint(1, sign=-1, zero=1.0)
    servo = flipped.servo_angle(np.full(15, 0.25), np.zeros(15))
    assert servo[0] == pytest.approx(np.pi + 0.25)
    assert servo[1] == pytest.approx(0.75)


@given(
    q=st.floats(-0.7, 0.7),
    sign=st.sampled_from([-1, 1]),
    zero=st.floats(-20.0, 20.0),
    turns=st.integers(-3, 3),
)
def test_turns_are_found_wherever_the_count_wraps(
    q: float, sign: int, zero: float, turns: int
) -> None:
    hand = dexctl.hands.load("dex5")
    calibration = Calibration.nominal(hand).with_joint(0, sign=sign, zero=zero)
    joints = 0.5 * (hand.lower + hand.upper)
    joints[0] = q
    count = np.zeros(15)
    count[0] = turns
    servo = calibration.servo_angle(joints, count)
    found = calibration.turns(servo)
    np.testing.assert_allclose(calibration.joint_angle(servo, found), joints, atol=1e-9)
    # a servo that lost power counts within one turn again: the joint angle stays the same
    wrapped = servo % TURN
    again = calibration.turns(wrapped)
    np.testing.assert_allclose(calibration.joint_angle(wrapped, again), joints, atol=1e-9)


def test_a_joint_out_of_its_range_is_named(nominal: Calibration) -> None:
    servo = nominal.servo_angle(np.zeros(15), np.zeros(15))
    servo[3] += 1.9
    with pytest.raises(InvalidInput, match=r"f2_roll \(servo 4\) stands at 1.900 rad"):
        nominal.turns(servo)
    servo[3] = np.nan
    with pytest.raises(InvalidInput, match="f2_roll"):
        nominal.turns(servo)


def test_the_file_comes_back(nominal: Calibration, tmp_path: Path) -> None:
    changed = nominal.with_joint(2, sign=-1, zero=2.5, lower=-2.0)
    path = tmp_path / "hand.toml"
    changed.save(path)
    back = Calibration.load(path)
    assert back.joint_names == changed.joint_names and back.date == changed.date
    for name in ("servo", "sign", "zero", "lower", "upper", "torque_constant"):
        np.testing.assert_array_equal(getattr(back, name), getattr(changed, name))


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("sign = 1", "sign = 2", "sign of joint f1_roll is 2; expected 1 or -1"),
        ("sign = 1", "sign = 1.5", "sign is"),
        ("sign = 1", "sing = 1", r"\[\[joint\]\] number 1 has"),
        ("servo = 2\n", "servo = 1\n", "servo 1 has several joints"),
        ("servo = 1\n", "servo = 253\n", "servo of joint f1_roll is 253; expected an ID"),
        ("torque_constant = nan", "torque_constant = 0", "torque_constant of joint f1_roll is 0"),
        ("zero = 3", "zero = nan #", "zero of joint f1_roll is nan"),
        ("zero = 3", "zero = true #", "zero of f1_roll is True"),
        ("lower = -0.7", "lower = 0.8", "upper of joint f1_roll is 0.7; expected above lower"),
        ("[[joint]]", "[[joints]]", "hand.toml"),
        ("date = ", "date = 5 #", "`date`"),
        ("hand = ", "hand = ]", "no calibration file"),
    ],
)
def test_bad_files(nominal: Calibration, tmp_path: Path, old: str, new: str, said: str) -> None:
    path = tmp_path / "hand.toml"
    nominal.save(path)
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(InvalidInput, match=said):
        Calibration.load(path)


def test_no_file(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="no calibration file"):
        Calibration.load(tmp_path / "none.toml")


def test_it_belongs_to_its_hand(nominal: Calibration, dex5: dexctl.HandModel) -> None:
    assert nominal.check(dex5) is nominal
    with pytest.raises(InvalidInput, match=r"range of f1_roll is -0.700 to 0.800"):
        nominal.with_joint(0, upper=0.8).check(dex5)
