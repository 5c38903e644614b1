"""The control table: no overlaps, conversions both ways, values worked out by hand."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexctl.exceptions import InvalidInput, UnknownName
from hardware import registers as R  # noqa: N812
from hardware.registers import REGISTERS, Register

ANY = st.sampled_from(REGISTERS)
WRITABLE = st.sampled_from([register for register in REGISTERS if register.writable])


def test_no_two_share_a_byte() -> None:
    for first, second in itertools.pairwise(REGISTERS):
        assert first.end <= second.address


def test_addresses_of_the_manual() -> None:
    for register, address, size in (
        (R.MODEL, 0, 2),
        (R.OPERATING_MODE, 11, 1),
        (R.CURRENT_LIMIT, 38, 2),
        (R.TORQUE_ENABLE, 64, 1),
        (R.BUS_WATCHDOG, 98, 1),
        (R.GOAL_CURRENT, 102, 2),
        (R.GOAL_POSITION, 116, 4),
        (R.PRESENT_CURRENT, 126, 2),
        (R.PRESENT_VELOCITY, 128, 4),
        (R.PRESENT_POSITION, 132, 4),
        (R.PRESENT_VOLTAGE, 144, 2),
        (R.PRESENT_TEMPERATURE, 146, 1),
    ):
        assert (register.address, register.size) == (address, size), register.name


def test_units_by_hand() -> None:
    assert R.PRESENT_POSITION.to_si(1024) == pytest.approx(np.pi / 2)
    assert R.GOAL_POSITION.to_raw(-np.pi) == -2048
    # 0.229 rpm = 0.229 x 2 pi / 60 rad/s, so 25 units are 0.5995 rad/s
    assert R.PROFILE_VELOCITY.to_si(25) == pytest.approx(0.59952, abs=1e-5)
    assert R.PROFILE_VELOCITY.to_raw(0.6) == 25
    assert R.GOAL_CURRENT.to_raw(0.5 / 1.3) == 143
    assert R.BUS_WATCHDOG.to_raw(0.1) == 5
    assert R.PRESENT_VOLTAGE.to_si(118) == pytest.approx(11.8)
    assert R.RETURN_DELAY.to_si(250) == pytest.approx(500e-6)


def test_signed_values() -> None:
    assert R.PRESENT_CURRENT.decode(b"\xff\xff") == -1
    assert R.MODEL.decode(b"\x06\x04") == 1030
    assert R.GOAL_POSITION.encode(-2) == b"\xfe\xff\xff\xff"
    assert R.BUS_WATCHDOG.decode(b"\xff") == -1


@given(WRITABLE, st.integers(-(2**31), 2**31 - 1))
def test_raw_to_si_and_back(register: Register, number: int) -> None:
    raw = register.low + number % (register.high - register.low + 1)
    assert register.to_raw(register.to_si(raw)) == raw
    assert register.decode(register.encode(raw)) == raw


@given(WRITABLE, st.floats(allow_nan=True, allow_infinity=True))
def test_si_to_raw_rounds_or_refuses(register: Register, value: float) -> None:
    half = 0.5 * register.scale
    if register.low * register.scale - half < value < register.high * register.scale + half:
        raw = int(register.to_raw(value))
        assert register.low <= raw <= register.high
        assert abs(register.to_si(raw) - value) <= half * (1 + 1e-9)
    elif not register.low * register.scale - half <= value <= register.high * register.scale + half:
        with pytest.raises(InvalidInput, match=register.name):
            register.to_raw(value)


@given(ANY, st.binary(min_size=4, max_size=4))
def test_bytes_both_ways(register: Register, data: bytes) -> None:
    data = data[: register.size]
    assert register.encode(register.decode(data)) == data


def test_one_bad_value_of_many_is_named() -> None:
    with pytest.raises(InvalidInput, match="goal_current is 9.5; expected a number from -3.2.* A"):
        R.GOAL_CURRENT.to_raw([0.1, 9.5, 0.2])


def test_names() -> None:
    assert R.register("goal_position") is R.GOAL_POSITION
    with pytest.raises(UnknownName, match="unknown register 'goal'"):
        R.register("goal")


def test_errors_in_words() -> None:
    assert R.describe_hardware_error(0) == ""
    text = R.describe_hardware_error(0x25)
    assert "voltage" in text and "overheating" in text and "overload" in text
    assert "unknown bits 0x42" in R.describe_hardware_error(0x42)
    assert "read-only" in R.describe_status_error(7)
    assert "hardware error" in R.describe_status_error(0x80)
    assert "unknown status error 99" in R.describe_status_error(99)
