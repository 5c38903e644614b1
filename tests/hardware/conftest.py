"""Emulated servos for the hardware tests; skipped where the `hardware` extra is missing."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from hardware.bus import Bus
from hardware.emulator import Emulator

# Far more than a busy machine needs; only servos that are silent on purpose make a test wait.
PATIENT = 0.5


@pytest.fixture(scope="module")
def shared_emulator() -> Iterator[Emulator]:
    """Fifteen first-order joints in manual time, started once for a module's tests."""
    pytest.importorskip("dynamixel_sdk", reason="needs the extra 'hardware'")
    with Emulator(manual=True) as running:
        yield running


@pytest.fixture
def emulator(shared_emulator: Emulator) -> Emulator:
    """The shared emulator with its servos as new and no faults."""
    shared_emulator.reset()
    return shared_emulator


@pytest.fixture
def bus(emulator: Emulator) -> Iterator[Bus]:
    """A patient bus on the shared emulator."""
    with Bus(emulator.port, range(1, 16), timeout=PATIENT) as opened:
        yield opened
