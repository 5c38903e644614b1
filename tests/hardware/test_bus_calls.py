"""Bus against the emulator: what it reads and writes, what it refuses, whom it keeps out."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from dexctl.exceptions import InvalidInput
from hardware import registers as R  # noqa: N812
from hardware.bus import Bus
from hardware.emulator import Emulator
from hardware.exceptions import BusError, PortBusy, PortLost, ServoError

PRESENT = [R.PRESENT_CURRENT, R.PRESENT_VELOCITY, R.PRESENT_POSITION]


def test_ping(bus: Bus) -> None:
    assert bus.ping(3) == (1030, 48, 0)


def test_scan_finds_those_that_are_there(emulator: Emulator) -> None:
    with Bus(emulator.port, [1], timeout=0.5) as bus:
        assert list(bus.scan([1, 15, 16, 200])) == [1, 15]


def test_read_one_register_of_all(bus: Bus) -> None:
    found = bus.read(R.PRESENT_POSITION)
    assert found.ids == tuple(range(1, 16))
    assert found.raw.tolist() == [2048] * 15
    assert found.value == pytest.approx(np.full(15, np.pi))
    assert found.ok.all() and not found.alert.any() and not found.error.any()
    assert found.missing == ()
    assert bus.fast is True


def test_read_many_in_the_order_given(bus: Bus) -> None:
    voltage, model, watchdog = bus.read_many([R.PRESENT_VOLTAGE, R.MODEL, R.BUS_WATCHDOG], [4, 2])
    assert voltage.value == pytest.approx([12.0, 12.0])
    assert model.raw.tolist() == [1030, 1030]
    assert watchdog.raw.tolist() == [0, 0]
    assert bus.statistics.packets <= 3  # one, unless a busy machine is late


def test_signs_come_back(bus: Bus, emulator: Emulator) -> None:
    bus.write(R.OPERATING_MODE, 5)
    bus.write(R.TORQUE_ENABLE, 1, [1, 2])
    bus.write(R.GOAL_POSITION, [-1.0, 4.0], [1, 2])
    emulator.advance(0.02)
    current, velocity, _ = bus.read_many(PRESENT, [1, 2])
    assert velocity.value[0] < -1 and current.value[0] < -0.1
    assert velocity.value[1] > 0.5 and current.value[1] > 0.1
    emulator.advance(5.0)
    at = bus.read(R.PRESENT_POSITION, [1, 2])
    assert at.value == pytest.approx([-1.0, 4.0], abs=R.RADIANS_PER_TICK)  # below 0: multi-turn


def test_write_says_what_it_sent(bus: Bus) -> None:
    sent = bus.write(R.GOAL_POSITION, np.linspace(0, 3, 15))
    assert sent == pytest.approx(np.linspace(0, 3, 15), abs=R.RADIANS_PER_TICK / 2)
    assert bus.read(R.GOAL_POSITION).value == pytest.approx(sent)
    assert bus.write(R.GOAL_POSITION, 1.0, [3]).shape == (1,)


def test_a_bad_value_sends_nothing(bus: Bus) -> None:
    for bad in (np.nan, np.inf, -np.inf, 1e9):
        values = np.zeros(15)
        values[7] = bad
        with pytest.raises(InvalidInput, match="goal_position is"):
            bus.write(R.GOAL_POSITION, values)
        with pytest.raises(InvalidInput, match="goal_position is"):
            bus.write_checked(R.GOAL_POSITION, bad, 1)
    assert bus.statistics.packets == 0


def test_bad_arguments(bus: Bus, emulator: Emulator) -> None:
    with pytest.raises(InvalidInput, match="present_position is read-only"):
        bus.write(R.PRESENT_POSITION, 0.0)
    with pytest.raises(InvalidInput, match=r"values of shape \(3,\); expected one, or \(15,\)"):
        bus.write(R.GOAL_POSITION, [1, 2, 3])
    with pytest.raises(InvalidInput, match="no registers"):
        bus.read_many([])
    with pytest.raises(InvalidInput, match="servo ID is 253; expected 0 to 252"):
        bus.read(R.LED, [253])
    with pytest.raises(InvalidInput, match="none of them twice"):
        bus.read(R.LED, [1, 1])
    with pytest.raises(InvalidInput, match="at least one"):
        bus.read(R.LED, [])
    for settings, text in (
        ({"timeout": 0.0}, "timeout is 0.0"),
        ({"timeout": np.nan}, "timeout is nan"),
        ({"retries": -1}, "retries is -1"),
        ({"baudrate": 12345}, "baudrate is 12345; expected one of 9600"),
    ):
        with pytest.raises(InvalidInput, match=text):
            Bus(emulator.port, [1], **settings)  # type: ignore[arg-type]


def test_checked_writes_are_confirmed_or_refused(bus: Bus) -> None:
    assert bus.write_checked(R.CURRENT_LIMIT, 0.5, 2) == pytest.approx(0.5, abs=R.AMPERES / 2)
    with pytest.raises(ServoError, match="servo 2 refuses to write goal_current = 372") as caught:
        bus.write_checked(R.GOAL_CURRENT, 1.0, 2)
    assert caught.value.status == R.StatusError.DATA_LIMIT and not caught.value.alert
    bus.write_checked(R.TORQUE_ENABLE, 1, 2)
    with pytest.raises(ServoError, match="locked while torque is on"):
        bus.write_checked(R.OPERATING_MODE, 5, 2)


def test_another_program_is_kept_out(bus: Bus) -> None:
    with pytest.raises(PortBusy, match="another program holds this port"):
        Bus(bus.port, [1])
    assert bus.ping(1).error == 0  # and has disturbed nothing
    bus.close()
    bus.close()
    with pytest.raises(BusError, match="the port is closed"):
        bus.ping(1)
    with Bus(bus.port, [1], timeout=0.5) as again:
        again.ping(1)


def test_no_such_port(tmp_path: object) -> None:
    with pytest.raises(PortLost, match="/dev/ttyNONE: no such port"):
        Bus("/dev/ttyNONE", [1])
    with pytest.raises(BusError, match="/dev/null: cannot be opened as a serial port"):
        Bus("/dev/null", [1])


def test_threads_wait_for_each_other(bus: Bus) -> None:
    wrong: list[object] = []

    def work(servo: int) -> None:
        for _ in range(50):
            bus.write(R.GOAL_POSITION, 0.1 * servo, [servo])
            found = bus.read(R.GOAL_POSITION, [servo])
            if abs(found.value[0] - 0.1 * servo) > R.RADIANS_PER_TICK:
                wrong.append(found)

    threads = [threading.Thread(target=work, args=(servo,)) for servo in (1, 2, 3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert wrong == []
    assert bus.statistics.status_errors == 0


def test_servos_without_fast_reads() -> None:
    with (
        Emulator(3, ids=[7, 5, 9], fast=False) as old,
        Bus(old.port, [5, 7, 9], timeout=0.5) as bus,
    ):
        for _ in range(120):  # more than three only where a busy machine loses plain answers too
            found = bus.read(R.SERVO_ID)
            assert found.raw[found.ok].tolist() == np.array([5, 7, 9])[found.ok].tolist()
            if bus.fast is False:
                break
        assert bus.fast is False
        assert bus.statistics.fast_fallbacks >= 3
        assert bus.read(R.SERVO_ID).raw.tolist() == [5, 7, 9]


def test_reboot(bus: Bus, emulator: Emulator) -> None:
    bus.write(R.TORQUE_ENABLE, 1, [4])
    emulator.overload(4)
    assert bus.read(R.HARDWARE_ERROR, [4]).raw[0] == R.HardwareError.OVERLOAD
    done = threading.Event()

    def tick() -> None:  # its boot takes emulated time
        while not done.wait(0.05):
            emulator.advance(0.05)

    ticking = threading.Thread(target=tick)
    ticking.start()
    try:
        assert bus.reboot(4) == (1030, 48, 0)
    finally:
        done.set()
        ticking.join()
    found = bus.read_many([R.HARDWARE_ERROR, R.TORQUE_ENABLE], [4])
    assert [reading.raw[0] for reading in found] == [0, 0]


def test_reads_of_one_servo_do_not_speak_against_fast_reads(bus: Bus) -> None:
    for _ in range(20):
        assert bus.read(R.PRESENT_POSITION, [1]).ok.all()
    assert bus.read(R.PRESENT_POSITION).ok.all()
    assert bus.fast is True
