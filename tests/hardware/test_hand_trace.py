"""The same controller in the simulator, and through bus and emulated servos."""

from __future__ import annotations

import numpy as np
import pytest

import dexctl
from dexctl.sim import BatchSimulator, Scene
from hardware.bus import Bus
from hardware.emulator import Emulator
from hardware.exceptions import BusError
from hardware.hand import ServoHand
from hardware.limits import Limits
from hardware.motions import Sine
from hardware.scene import EMPTY
from hardware.state_machine import Torque
from hardware.units import SimGains, to_servo

# Real-time loops: on a machine that others keep busy their deadlines pass, as they should.
pytestmark = pytest.mark.slow

PERIOD, TICKS = 0.02, 150
# the emulator's time stands still between ticks; the wall clock says nothing
LIMITS = Limits(watchdog=2.0, state_age=10.0, command_age=10.0)


def sine(hand: dexctl.HandModel) -> Sine:
    return Sine(hand, control_period=PERIOD, amplitude=0.1, frequency=0.5)


def test_without_an_object_the_joints_trace_the_same_path(dex5: dexctl.HandModel) -> None:
    scene = Scene.build(dex5, "cube", "up")
    far = scene.grasp_centre + 10.0 * scene.gravity / np.linalg.norm(scene.gravity)
    with BatchSimulator(scene, control_period=PERIOD, substeps=4, disturbance=0.0) as sim:
        sim.set_grasp(scene.open_q, scene.open_q, far, [1.0, 0.0, 0.0, 0.0])
        controller, bare = sine(dex5), []
        for _ in range(TICKS):
            state = sim.read()
            bare.append(state.q)
            sim.write(state.q_target + controller.act(state))
            sim.step()
    gains = to_servo(SimGains(3.0, 0.15, 0.5, 0.6))
    with (
        Emulator(dynamics="mujoco", scene=EMPTY, manual=True) as emulator,
        Bus(emulator.port, range(1, 16), timeout=0.05) as bus,
    ):
        hand = ServoHand(bus, dex5, limits=LIMITS, gains=gains, control_period=PERIOD)
        hand.arm()
        controller, emulated = sine(dex5), []
        for _ in range(TICKS):
            state = hand.read()
            emulated.append(state.q)
            sent = hand.write(state.q_target + controller.act(state))
            # the set-point that is sent on is within half a tick of the servo
            assert np.abs(hand.q_target - sent).max() == 0
            emulator.advance(PERIOD)
        assert hand.disarm().state is Torque.OFF
    rms = np.sqrt(np.mean((np.array(bare) - np.array(emulated)) ** 2))
    assert rms < 3e-3, f"{1e3 * rms:.2f} mrad"


def test_a_hand_that_is_not_armed_takes_no_set_points(dex5: dexctl.HandModel) -> None:
    with Emulator(15) as emulator, Bus(emulator.port, range(1, 16), timeout=0.05) as bus:
        hand = ServoHand(bus, dex5, limits=LIMITS)
        assert isinstance(hand, dexctl.Plant)
        with pytest.raises(BusError, match="armed hand; the torque is unknown"):
            hand.write(np.zeros(15))
        with pytest.raises(BusError, match="not configured"):
            hand.read()
        with hand:
            hand.arm()
            assert all(emulator.state()["torque_on"])
            with pytest.raises(dexctl.InvalidInput, match=r"shape \(3,\); expected \(15,\)"):
                hand.write(np.zeros(3))
            np.testing.assert_allclose(hand.write(np.full(15, 1.0)), 0.012, atol=1e-3)
        assert not any(emulator.state()["torque_on"])


def test_gravity_is_as_the_hand_is_mounted(dex5: dexctl.HandModel) -> None:
    """So a policy that observes it is asked the same as in simulation."""
    with Emulator(15) as emulator, Bus(emulator.port, range(1, 16), timeout=0.05) as bus:
        for told, known in (("down", [0.0, 0.0, 9.81]), ((0.0, 3.0, -9.0), [0.0, 3.0, -9.0])):
            hand = ServoHand(bus, dex5, limits=LIMITS, gravity=told)
            hand.configure()
            np.testing.assert_array_equal(hand.read().gravity, known)
        with pytest.raises(dexctl.UnknownName, match="unknown gravity 'sideways'"):
            ServoHand(bus, dex5, gravity="sideways")
        hand = ServoHand(bus, dex5, limits=LIMITS)
        hand.configure()
        assert hand.read().gravity is None


def test_arming_stops_where_a_joint_is_out_of_range(dex5: dexctl.HandModel) -> None:
    start = [0.0] * 15
    start[3] = 1.5  # f2_roll ends at 0.7
    with Emulator(15, start=start) as emulator, Bus(emulator.port, range(1, 16)) as bus:
        hand = ServoHand(bus, dex5, limits=LIMITS)
        with pytest.raises(dexctl.InvalidInput, match="f2_roll"):
            hand.arm()
        assert hand.torque is Torque.OFF and not any(emulator.state()["torque_on"])


def test_arming_stops_where_a_servo_is_silent(dex5: dexctl.HandModel) -> None:
    with Emulator(15) as emulator, Bus(emulator.port, range(1, 16)) as bus:
        emulator.silence(8)
        with pytest.raises(BusError, match="no answer from servo 8 about torque_enable"):
            ServoHand(bus, dex5, limits=LIMITS).arm()
        assert not any(emulator.state()["torque_on"])
