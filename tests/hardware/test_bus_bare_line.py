"""Bus on a pseudo-terminal without servos: deaf, babbling, or answering nonsense."""

from __future__ import annotations

import os
import random
import threading
import time
import tty
from collections.abc import Iterator

import pytest

from hardware import registers as R  # noqa: N812
from hardware.bus import Bus
from hardware.exceptions import BusError
from hardware.protocol import build_fast_status, build_status

IDS = (1, 2, 3)
SOON = 10.0  # s; each call is bound to a fraction of a second, a busy machine to nothing


@pytest.fixture
def line() -> Iterator[tuple[int, str]]:
    """The other end of a line, and its port."""
    pytest.importorskip("dynamixel_sdk", reason="needs the extra 'hardware'")
    master, slave = os.openpty()
    tty.setraw(slave)
    yield master, os.ttyname(slave)
    os.close(slave)
    os.close(master)


def test_nobody_takes_the_bytes(line: tuple[int, str]) -> None:
    _, port = line
    with Bus(port, IDS, timeout=0.02) as bus:

        def flood() -> None:
            for _ in range(20_000):
                bus.write(R.GOAL_POSITION, 1.0)

        start = time.monotonic()
        with pytest.raises(BusError, match="the port took no bytes for 0.02 s"):
            flood()
        assert time.monotonic() - start < 6 * SOON


def test_a_babbling_line_does_not_hold_a_call(line: tuple[int, str]) -> None:
    master, port = line
    os.set_blocking(master, False)
    source, done = random.Random(0), threading.Event()

    def babble() -> None:
        while not done.is_set():
            try:
                os.read(master, 4096)
                os.write(master, source.randbytes(64))
            except BlockingIOError:
                done.wait(0.001)

    with Bus(port, IDS, timeout=0.05, retries=1) as bus:
        talker = threading.Thread(target=babble)
        talker.start()
        try:
            start = time.monotonic()
            found = bus.read_many([R.PRESENT_CURRENT, R.PRESENT_POSITION])
            assert time.monotonic() - start < SOON
        finally:
            done.set()
            talker.join()
    assert all(reading.missing == IDS for reading in found)
    assert bus.statistics.timeouts > 0


@pytest.mark.parametrize(
    "answer",
    [
        build_fast_status([(1, 0, b"\0" * 4)]),  # too few
        build_fast_status([(1, 0, b"\0" * 4), (2, 0, b"\0" * 4), (9, 0, b"\0" * 4)]),  # a stranger
        build_fast_status([(i, 0, b"\0" * 2) for i in IDS]),  # too short
        build_status(1, 0, b"\0" * 3),  # too short
        build_status(9, 0, b"\0" * 4),  # a stranger
        build_status(1, 0, b""),  # no data, no error
    ],
)
def test_nonsense_is_not_taken_for_an_answer(line: tuple[int, str], answer: bytes) -> None:
    master, port = line
    done = threading.Event()
    os.set_blocking(master, False)

    def reply() -> None:
        while not done.is_set():
            try:
                if os.read(master, 4096):
                    os.write(master, answer)
            except BlockingIOError:
                done.wait(0.001)

    with Bus(port, IDS, timeout=0.05, retries=0) as bus:
        talker = threading.Thread(target=reply)
        talker.start()
        try:
            found = bus.read(R.PRESENT_POSITION)
        finally:
            done.set()
            talker.join()
    assert found.missing == IDS
    assert not found.error.any()


def test_no_latency_timer_here(line: tuple[int, str]) -> None:
    with Bus(line[1], IDS) as bus:
        assert bus.latency_timer is None
