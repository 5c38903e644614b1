"""The emulated servos in this process: rules of the table, errors, watchdog, random writes."""

from __future__ import annotations

import random
import struct

import numpy as np
import pytest

from dexctl.exceptions import InvalidInput, UnknownName
from hardware import registers as R  # noqa: N812
from hardware.emulator.chain import Chain
from hardware.emulator.dynamics import FirstOrderJoints
from hardware.emulator.faults import Faults
from hardware.protocol import BROADCAST, Instruction, Packet, Parser, build
from hardware.registers import OperatingMode, Register, StatusError


def make(count: int = 2, **settings: object) -> Chain:
    return Chain(FirstOrderJoints(np.zeros(count)), **settings)  # type: ignore[arg-type]


def ask(chain: Chain, servo: int, code: int, parameters: bytes = b"") -> list[Packet]:
    """Through the bytes of the wire, both ways."""
    parser = Parser()
    answers = []
    for packet in Parser().feed(build(servo, code, parameters)):
        for answer in chain.handle(packet):
            answers += parser.feed(answer.data)
    assert parser.crc_errors == 0
    return answers


def put(chain: Chain, register: Register, raw: int, servo: int = 1) -> int:
    data = struct.pack("<H", register.address) + register.encode(raw)
    (answer,) = ask(chain, servo, Instruction.WRITE, data)
    return answer.error


def get(chain: Chain, register: Register, servo: int = 1) -> int:
    head = struct.pack("<HH", register.address, register.size)
    (answer,) = ask(chain, servo, Instruction.READ, head)
    return register.decode(answer.data)


def test_eeprom_is_locked_while_torque_is_on() -> None:
    chain = make()
    assert put(chain, R.CURRENT_LIMIT, 200) == 0
    assert put(chain, R.TORQUE_ENABLE, 1) == 0
    assert put(chain, R.CURRENT_LIMIT, 300) == StatusError.ACCESS
    assert get(chain, R.CURRENT_LIMIT) == 200


def test_what_may_be_written() -> None:
    for register, raw, error in (
        (R.PRESENT_POSITION, 0, StatusError.ACCESS),
        (R.MODEL, 0, StatusError.ACCESS),
        (R.OPERATING_MODE, 2, StatusError.DATA_RANGE),
        (R.DRIVE_MODE, 1, StatusError.DATA_RANGE),
        (R.TORQUE_ENABLE, 2, StatusError.DATA_RANGE),
        (R.CURRENT_LIMIT, 1194, StatusError.DATA_RANGE),
        (R.BUS_WATCHDOG, -1, StatusError.DATA_RANGE),
        (R.GOAL_POSITION, 4096, StatusError.DATA_LIMIT),  # in position mode, past its limits
        (R.GOAL_POSITION, 4095, 0),
        (R.GOAL_VELOCITY, 331, StatusError.DATA_LIMIT),
        (R.GOAL_VELOCITY, -330, 0),
    ):
        assert put(make(), register, raw) == error, (register.name, raw)


def test_a_write_is_done_whole_or_not_at_all() -> None:
    chain = make()
    assert put(chain, R.OPERATING_MODE, 5) == 0
    head = struct.pack("<H", R.GOAL_CURRENT.address)
    good = struct.pack("<hiiii", 100, 0, 0, 25, 1500)  # current to goal position, 18 bytes
    assert ask(chain, 1, Instruction.WRITE, head + good)[0].error == 0
    assert (get(chain, R.GOAL_CURRENT), get(chain, R.GOAL_POSITION)) == (100, 1500)
    bad = struct.pack("<hiiii", 50, 0, 0, 25, 2_000_000)
    assert ask(chain, 1, Instruction.WRITE, head + bad)[0].error == StatusError.DATA_RANGE
    assert get(chain, R.GOAL_CURRENT) == 100
    cut = ask(chain, 1, Instruction.WRITE, head + good[:-1])
    assert cut[0].error == StatusError.DATA_LENGTH


def test_goal_current_stays_below_its_limit() -> None:
    chain = make()
    put(chain, R.CURRENT_LIMIT, 143)
    put(chain, R.OPERATING_MODE, OperatingMode.CURRENT_BASED_POSITION)
    assert put(chain, R.GOAL_CURRENT, 144) == StatusError.DATA_LIMIT
    assert put(chain, R.GOAL_CURRENT, -143) == 0


def test_current_and_speed_are_limited() -> None:
    """143 units are 0.5 N m: blocked, the shaft feels no more; free, it keeps to its profile."""
    chain = make()
    put(chain, R.OPERATING_MODE, OperatingMode.CURRENT_BASED_POSITION)
    put(chain, R.GOAL_CURRENT, 143)
    put(chain, R.PROFILE_VELOCITY, 25)
    put(chain, R.TORQUE_ENABLE, 1)
    put(chain, R.GOAL_POSITION, 2048 + 1024)
    chain.advance(1.0)
    assert chain.joints.q[0] == pytest.approx(0.6, abs=0.05)
    assert get(chain, R.PRESENT_VELOCITY) == 25
    Faults(chain).block([1])
    chain.advance(3.0)
    assert get(chain, R.PRESENT_CURRENT) == 143
    assert chain.joints.torque[0] == pytest.approx(0.5, abs=0.002)
    Faults(chain).block([1], blocked=False)
    chain.advance(9.0)
    assert get(chain, R.PRESENT_POSITION) == 2048 + 1024


def test_profile_acceleration() -> None:
    """From rest to rest over 1 rad at 1 rad/s^2 without a speed limit takes 2 s."""
    joints = FirstOrderJoints(np.zeros(1))
    c = joints.commands
    c.torque_on[:], c.goal[:], c.acceleration[:] = True, 1.0, 1.0
    c.kp[:], c.limit[:] = 100.0, 10.0
    joints.advance(1.0)
    assert joints.reference[0] == pytest.approx(0.5, abs=0.01)
    assert joints.reference_speed[0] == pytest.approx(1.0, abs=0.02)
    joints.advance(1.1)
    assert joints.reference[0] == pytest.approx(1.0, abs=1e-3)


def test_other_modes() -> None:
    chain = make(3)
    for servo, mode in ((1, OperatingMode.VELOCITY), (2, OperatingMode.CURRENT)):
        put(chain, R.OPERATING_MODE, mode, servo)
        put(chain, R.GOAL_VELOCITY if servo == 1 else R.GOAL_CURRENT, 0, servo)
        put(chain, R.TORQUE_ENABLE, 1, servo)
    put(chain, R.GOAL_VELOCITY, 40, 1)
    put(chain, R.GOAL_CURRENT, -50, 2)
    chain.advance(1.0)
    assert get(chain, R.PRESENT_VELOCITY, 1) == pytest.approx(40, abs=1)
    assert get(chain, R.PRESENT_CURRENT, 2) == -50
    assert chain.joints.q[1] < -0.1 and chain.joints.q[2] == 0


def test_status_return_level() -> None:
    chain = make()
    put(chain, R.STATUS_RETURN_LEVEL, 1)
    head = struct.pack("<H", R.LED.address)
    assert ask(chain, 1, Instruction.WRITE, head + b"\x01") == []
    assert get(chain, R.LED) == 1
    ask(chain, 1, Instruction.WRITE, struct.pack("<H", R.STATUS_RETURN_LEVEL.address) + b"\0")
    assert ask(chain, 1, Instruction.READ, struct.pack("<HH", R.LED.address, 1)) == []
    assert len(ask(chain, 1, Instruction.PING)) == 1


def test_broadcast() -> None:
    chain = make(3)
    assert [packet.id for packet in ask(chain, BROADCAST, Instruction.PING)] == [1, 2, 3]
    head = struct.pack("<H", R.LED.address)
    assert ask(chain, BROADCAST, Instruction.WRITE, head + b"\x01") == []
    assert [get(chain, R.LED, servo) for servo in (1, 2, 3)] == [1, 1, 1]


def test_a_new_id() -> None:
    chain = make(1)
    put(chain, R.SERVO_ID, 77)
    assert ask(chain, 1, Instruction.PING) == []
    assert ask(chain, 77, Instruction.PING)[0].id == 77


def test_watchdog_trips_and_is_cleared() -> None:
    chain = make()
    put(chain, R.PROFILE_VELOCITY, 25)
    put(chain, R.BUS_WATCHDOG, 5)  # 100 ms
    put(chain, R.TORQUE_ENABLE, 1)
    put(chain, R.GOAL_POSITION, 3000)
    for _ in range(10):  # reads feed it
        chain.advance(chain.now + 0.09)
        chain.watch()
        assert get(chain, R.BUS_WATCHDOG) == 5
    moved = chain.joints.q[0]
    chain.advance(chain.now + 0.11)
    chain.watch()
    assert get(chain, R.BUS_WATCHDOG) == -1
    assert get(chain, R.PROFILE_VELOCITY) == 0
    assert put(chain, R.GOAL_POSITION, 2048) == StatusError.DATA_RANGE
    assert get(chain, R.TORQUE_ENABLE) == 1  # torque stays
    chain.advance(chain.now + 2.0)
    assert chain.joints.q[0] < moved + 0.1  # and the motion has stopped
    assert put(chain, R.BUS_WATCHDOG, 0) == 0
    assert put(chain, R.GOAL_POSITION, 2048) == 0


def test_watchdog_sleeps_while_torque_is_off() -> None:
    chain = make()
    put(chain, R.BUS_WATCHDOG, 1)
    chain.advance(10.0)
    chain.watch()
    assert get(chain, R.BUS_WATCHDOG) == 1


def test_turns_are_lost_at_a_reboot() -> None:
    chain = make()
    put(chain, R.OPERATING_MODE, OperatingMode.EXTENDED_POSITION)
    put(chain, R.TORQUE_ENABLE, 1)
    put(chain, R.GOAL_POSITION, -3000)
    chain.advance(10.0)
    assert get(chain, R.PRESENT_POSITION) == -3000
    ask(chain, 1, Instruction.REBOOT)
    assert ask(chain, 1, Instruction.PING) == []  # it takes its time
    chain.advance(11.0)
    assert get(chain, R.PRESENT_POSITION) == -3000 + 4096
    assert get(chain, R.GOAL_POSITION) == -3000 + 4096
    assert get(chain, R.TORQUE_ENABLE) == 0
    assert get(chain, R.OPERATING_MODE) == OperatingMode.EXTENDED_POSITION  # EEPROM


def test_mounting() -> None:
    joints = FirstOrderJoints(np.array([0.5, 0.5]))
    chain = Chain(joints, zeros=[1000, 1000], signs=[1, -1])
    away = round(0.5 / R.RADIANS_PER_TICK)
    assert get(chain, R.PRESENT_POSITION, 1) == 1000 + away
    assert get(chain, R.PRESENT_POSITION, 2) == 1000 - away
    for servo in (1, 2):
        put(chain, R.TORQUE_ENABLE, 1, servo)
        put(chain, R.GOAL_POSITION, 1100, servo)
    chain.advance(5.0)
    assert joints.q == pytest.approx(np.array([100, -100]) * R.RADIANS_PER_TICK)


def test_hardware_errors() -> None:
    chain = make(3)
    faults = Faults(chain)
    put(chain, R.TORQUE_ENABLE, 1)
    faults.make("overheat", ids=[1], celsius=79)
    assert get(chain, R.HARDWARE_ERROR) == 0 and get(chain, R.PRESENT_TEMPERATURE) == 79
    faults.make("overheat", ids=[1], celsius=81)
    assert get(chain, R.HARDWARE_ERROR) == R.HardwareError.OVERHEATING
    assert get(chain, R.TORQUE_ENABLE) == 0
    assert put(chain, R.TORQUE_ENABLE, 1) == R.ALERT | StatusError.RESULT_FAIL
    put(chain, R.TORQUE_ENABLE, 1, 2)
    faults.make("voltage", volts=9.0, ids=[2])  # a brown-out reports, and torque stays
    assert get(chain, R.HARDWARE_ERROR, 2) == R.HardwareError.INPUT_VOLTAGE
    assert get(chain, R.TORQUE_ENABLE, 2) == 1
    faults.make("voltage", volts=0.0)
    assert ask(chain, 2, Instruction.PING) == []
    faults.make("voltage", volts=12.0)
    chain.advance(1.0)
    assert get(chain, R.HARDWARE_ERROR, 2) == 0 and get(chain, R.TORQUE_ENABLE, 2) == 0


def test_bad_faults_are_refused() -> None:
    faults = Faults(make())
    with pytest.raises(UnknownName, match="unknown fault 'fire'; known: drop, corrupt"):
        faults.make("fire")
    with pytest.raises(UnknownName, match="unknown servo 9; known: 1, 2"):
        faults.make("overload", ids=[9])
    with pytest.raises(InvalidInput, match="delay is 99"):
        faults.make("delay", seconds=99)
    with pytest.raises(InvalidInput, match="fault silence: .*'ids'"):
        faults.make("silence")


def test_random_writes() -> None:
    """10,000 random writes and other packets: no exception, no goal beyond its limits."""
    source = random.Random(2)
    chain = make(4)
    codes = [int(code) for code in Instruction] + [0x99]
    starts = [register.address for register in R.REGISTERS]
    for i in range(10_000):
        address = source.choice(starts) if source.random() < 0.8 else source.randrange(65536)
        data = source.randbytes(source.choice([0, 1, 1, 2, 2, 4, 4, 8, 18]))
        code, servo = Instruction.WRITE, source.randrange(1, 5)
        if source.random() < 0.2:
            code, servo = source.choice(codes), source.choice([1, 2, 3, 4, 9, BROADCAST])
        ask(chain, servo, code, struct.pack("<H", address) + data)
        if i % 50 == 0:
            chain.advance(chain.now + 0.02)
            chain.watch()
            _check_goals(chain)
            for servo_ in chain.servos:  # they may have taken other IDs or gone quiet
                servo_.put(R.SERVO_ID, servo_.row + 1)
                servo_.put(R.STATUS_RETURN_LEVEL, 2)


def _check_goals(chain: Chain) -> None:
    assert np.isfinite(chain.joints.q).all()
    for servo in chain.servos:
        for register in R.REGISTERS:
            if register.writable and register is not R.BUS_WATCHDOG:
                assert register.low <= servo.get(register) <= register.high, register.name
        assert abs(chain.joints.torque[servo.row]) <= 3.0 * 1.4
