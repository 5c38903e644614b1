"""Emulated servos whose set-points take effect late, and shafts turned by hand."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from dexctl.exceptions import InvalidInput
from dexctl.limits import HandLimits
from dexctl.sim import SceneConfig
from hardware import registers as R  # noqa: N812
from hardware.bus import Bus
from hardware.emulator import Emulator
from hardware.emulator.dynamics import FirstOrderJoints
from hardware.exceptions import BusError

IDS = range(1, 4)


def late_by(seconds: float) -> SceneConfig:
    return SceneConfig(limits=HandLimits(action_latency=seconds))


@pytest.fixture
def late() -> Iterator[Emulator]:
    pytest.importorskip("dynamixel_sdk", reason="needs the extra 'hardware'")
    with Emulator(3, manual=True, scene=late_by(0.05)) as emulator:
        yield emulator


@pytest.fixture
def bus(late: Emulator) -> Iterator[Bus]:
    with Bus(late.port, IDS, timeout=1.0) as bus:
        bus.write(R.OPERATING_MODE, R.OperatingMode.CURRENT_BASED_POSITION)
        yield bus


def reference(emulator: Emulator) -> np.ndarray:
    return np.array(emulator.state()["reference"])


def test_a_goal_takes_effect_after_the_latency(late: Emulator, bus: Bus) -> None:
    bus.write(R.TORQUE_ENABLE, 1)
    bus.write(R.GOAL_POSITION, np.pi + 0.1)
    bus.read(R.GOAL_POSITION)  # the writes have arrived
    late.advance(0.048)
    assert np.array_equal(reference(late), np.zeros(3))
    late.advance(0.004)
    assert reference(late) == pytest.approx(np.full(3, 0.1), abs=R.RADIANS_PER_TICK)


def test_what_a_limp_servo_was_asked_does_not_move_it_later(late: Emulator, bus: Bus) -> None:
    bus.write(R.GOAL_POSITION, np.pi + 0.5)
    late.advance(0.02)
    bus.write(R.GOAL_POSITION, np.pi)
    late.advance(0.002)
    bus.write(R.TORQUE_ENABLE, 1)
    for _ in range(20):
        late.advance(0.005)
        assert np.abs(reference(late)).max() <= R.RADIANS_PER_TICK


def test_bad_latency() -> None:
    joints = FirstOrderJoints(np.zeros(3))
    for latency in (-0.1, 2.0, float("nan")):
        with pytest.raises(InvalidInput, match=f"action_latency is {latency}; expected 0 to 1 s"):
            joints.set_action_latency(latency)
    with pytest.raises(BusError, match="does not start: action_latency is 2.0"):
        Emulator(3, scene=late_by(2.0))


def test_limp_shafts_are_turned_by_hand(late: Emulator, bus: Bus) -> None:
    late.turn([0.1, -0.2, 3.0])
    found = bus.read(R.PRESENT_POSITION).value - np.pi
    np.testing.assert_allclose(found, [0.1, -0.2, 3.0], atol=R.RADIANS_PER_TICK)
    with pytest.raises(BusError, match="2 angles; expected 3"):
        late.turn([0.0, 0.0])
    bus.write(R.TORQUE_ENABLE, 1)
    bus.read(R.TORQUE_ENABLE)  # the write has arrived
    with pytest.raises(BusError, match="the torque is on"):
        late.turn([0.0, 0.0, 0.0])
