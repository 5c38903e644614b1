"""Bus on a bad line: one dead servo never hides the others, and every call ends."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator

import numpy as np
import pytest

from hardware import registers as R  # noqa: N812
from hardware.bus import Bus
from hardware.emulator import Emulator
from hardware.exceptions import PortLost, ServoError

PRESENT = [R.PRESENT_CURRENT, R.PRESENT_VELOCITY, R.PRESENT_POSITION]
TIMEOUT = 0.4


@pytest.fixture
def bus(emulator: Emulator) -> Iterator[Bus]:
    with Bus(emulator.port, range(1, 16), timeout=TIMEOUT) as opened:
        opened.read(R.MODEL)  # so that it knows about fast reads
        yield opened


def test_one_dead_servo(bus: Bus, emulator: Emulator) -> None:
    emulator.silence(3)
    for found in bus.read_many(PRESENT):
        assert found.missing == (3,)
        assert np.isnan(found.value[2]) and np.isfinite(np.delete(found.value, 2)).all()
    counts = bus.statistics
    assert counts.retries >= 1 and counts.timeouts >= 2
    with pytest.raises(ServoError, match="servo 3 does not answer .*check its ID, cable") as caught:
        bus.ping(3)
    assert caught.value.servo == 3 and not caught.value.answered
    emulator.speak(3)
    assert bus.read(R.PRESENT_POSITION).ok.all()


def test_all_dead(bus: Bus, emulator: Emulator) -> None:
    emulator.silence(*range(1, 16))
    assert bus.read(R.PRESENT_POSITION).missing == tuple(range(1, 16))


def test_an_alert_is_seen_in_every_kind_of_read(bus: Bus, emulator: Emulator) -> None:
    emulator.overload(5)
    found = bus.read(R.PRESENT_POSITION)
    assert found.ok.all() and np.flatnonzero(found.alert).tolist() == [4]
    emulator.silence(1)  # forces a plain sync read
    found = bus.read(R.PRESENT_POSITION)
    assert np.flatnonzero(found.alert).tolist() == [4]
    assert bus.read(R.PRESENT_POSITION, [5]).alert.tolist() == [True]
    assert bus.ping(5).error == R.ALERT
    assert bus.statistics.alerts >= 4


def test_lost_and_damaged_answers_are_asked_for_again(bus: Bus, emulator: Emulator) -> None:
    emulator.drop(1)
    assert bus.read(R.PRESENT_POSITION).ok.all()  # the fast one was lost, the plain one came
    assert bus.statistics.fast_fallbacks >= 1
    emulator.corrupt(1)
    assert bus.read(R.PRESENT_POSITION).ok.all()
    emulator.drop(1)
    assert bus.write_checked(R.LED, 1, 2) == 1
    assert bus.statistics.retries >= 1


def test_a_noisy_line_gives_no_wrong_value(emulator: Emulator) -> None:
    with Bus(emulator.port, range(1, 6), timeout=0.05, retries=3) as bus:
        sent = bus.write(R.GOAL_POSITION, np.linspace(0.5, 2.5, 5))
        emulator.corrupt(rate=0.2)
        emulator.drop(rate=0.1)
        fresh = 0
        for _ in range(40):
            found = bus.read(R.GOAL_POSITION)
            fresh += int(found.ok.sum())
            assert found.value[found.ok] == pytest.approx(sent[found.ok])
        assert fresh > 60  # of 200
        counts = bus.statistics
        assert counts.retries > 0 and counts.fast_fallbacks > 0
        assert counts.crc_errors + counts.skipped_bytes > 0


def test_a_late_answer_is_not_taken_for_the_next(emulator: Emulator) -> None:
    with Bus(emulator.port, [1, 2], timeout=0.2, retries=0) as bus:
        bus.write(R.GOAL_POSITION, [0.5, 0.6])
        emulator.delay(1.5)
        assert bus.read(R.GOAL_POSITION).missing == (1, 2)
        emulator.delay(0.0)
        sent = bus.write(R.GOAL_POSITION, [1.5, 1.6])
        for _ in range(20):  # a busy machine may miss one, but never answers with the old value
            found = bus.read(R.GOAL_POSITION)
            assert found.value[found.ok] == pytest.approx(sent[found.ok])
            if found.ok.all():
                break
        assert found.ok.all()


def test_every_call_ends_in_time(emulator: Emulator) -> None:
    emulator.silence(*range(1, 16))
    with Bus(emulator.port, range(1, 16), timeout=0.02, retries=2) as bus:
        for call in (
            lambda: bus.read(R.LED),
            lambda: bus.write(R.LED, 1),
            lambda: bus.ping(1),
            lambda: bus.write_checked(R.LED, 1, 1),
        ):
            start = time.monotonic()
            with contextlib.suppress(ServoError):
                call()
            assert time.monotonic() - start < 3.0  # about (2 + 2) x 2 x 0.02 s, and a busy machine


def test_unplugged() -> None:
    with Emulator(2) as emulator, Bus(emulator.port, [1, 2], timeout=TIMEOUT) as bus:
        bus.write(R.TORQUE_ENABLE, 1)
        assert bus.read(R.TORQUE_ENABLE).raw.tolist() == [1, 1]
        emulator.unplug()
        for call in (
            lambda: bus.read(R.LED),
            lambda: bus.write(R.TORQUE_ENABLE, 0),  # refused anew at every attempt, not once
            lambda: bus.write(R.TORQUE_ENABLE, 0),
            lambda: bus.ping(1),
        ):
            with pytest.raises(PortLost, match="torque state UNKNOWN"):
                call()
        assert emulator.state()["torque_on"] == [True, True]
        bus.close()
        with Bus(emulator.replug(), [1, 2], timeout=TIMEOUT) as again:
            assert again.read(R.TORQUE_ENABLE).raw.tolist() == [1, 1]
