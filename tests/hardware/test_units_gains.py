"""The unit converter: hand-computed numbers, both ways, and the step responses of both worlds."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexctl.exceptions import InvalidInput
from dexctl.sim import BatchSimulator, Scene
from hardware import registers as R  # noqa: N812
from hardware.emulator.dynamics import STALL_TORQUE, FirstOrderJoints
from hardware.emulator.mujoco_hand import MujocoHand
from hardware.emulator.servo import Servo
from hardware.scene import EMPTY
from hardware.units import LoopScale, ServoGains, SimGains, to_servo, to_sim


def program(servo: Servo, gains: ServoGains, goal: int) -> None:
    """Write registers as a driver would."""
    for register, raw in (
        (R.OPERATING_MODE, R.OperatingMode.CURRENT_BASED_POSITION),
        (R.POSITION_P_GAIN, gains.p),
        (R.POSITION_D_GAIN, gains.d),
        (R.GOAL_CURRENT, gains.current),
        (R.PROFILE_VELOCITY, gains.profile_velocity),
        (R.TORQUE_ENABLE, 1),
        (R.GOAL_POSITION, goal),
    ):
        assert servo.write(register.address, register.encode(int(raw))) == 0


def test_by_hand() -> None:
    """kp 3 N m/rad at 1.3 N m/A is 2.308 A/rad, or 3.540 mA = 1.316 units a tick; x 128 = 168."""
    found = to_servo(SimGains(kp=3.0, kv=0.15, torque_limit=0.5, speed_limit=0.6))
    assert found.p == 168
    # 0.15 / 1.3 A per rad/s is 42.89 units per rad/s = 65.80 units per tick/ms; x 16 = 1053
    assert found.d == 1053
    assert found.current == 143
    assert found.profile_velocity == 25


@given(st.integers(1, 16383), st.integers(1, 16383), st.integers(1, 1193), st.integers(1, 32767))
def test_registers_to_si_and_back(p: int, d: int, current: int, speed: int) -> None:
    registers = ServoGains(p, d, current, speed)
    assert to_servo(to_sim(registers)) == registers


def test_the_scale_is_the_servos_own() -> None:
    weak = LoopScale(torque_constant=0.65)
    one, other = to_servo(SimGains(1, 0.05, 0.2, 0)), to_servo(SimGains(1, 0.05, 0.2, 0), weak)
    assert other.p == pytest.approx(2 * one.p, abs=1)
    assert other.current == pytest.approx(2 * one.current, abs=1)
    with pytest.raises(InvalidInput, match="torque_constant is 0; expected"):
        LoopScale(torque_constant=0)


@pytest.mark.parametrize(
    ("gains", "text"),
    [
        (SimGains(np.nan, 0.1, 0.5, 0.6), "kp is nan; expected 0 to"),
        (SimGains(-1, 0.1, 0.5, 0.6), "kp is -1"),
        (SimGains(1e6, 0.1, 0.5, 0.6), "kp is 1000000.0; expected 0 to .* N m/rad"),
        (SimGains(3, 0.1, 50, 0.6), "torque_limit is 50; expected 0 to 4.172 N m"),
        (SimGains(3, 0.1, 0.5, 1e-6), "speed_limit is 1e-06; the least that profile_velocity"),
    ],
)
def test_what_no_register_holds(gains: SimGains, text: str) -> None:
    with pytest.raises(InvalidInput, match=text):
        to_servo(gains)


def test_step_response_of_the_first_order_servo() -> None:
    """Its registers' time constant is the one that the converted gains say: (b + kv) / kp."""
    wanted = SimGains(kp=3.0, kv=0.15, torque_limit=3.0, speed_limit=0.0)
    joints = FirstOrderJoints(np.zeros(1), timestep=0.001)
    program(Servo(1, joints, 0, 2048, 1), to_servo(wanted), 2048 + 200)
    goal = 200 * R.RADIANS_PER_TICK
    constant = (joints.viscosity + wanted.kv) / wanted.kp
    joints.advance(constant)
    assert joints.q[0] == pytest.approx(goal * (1 - np.exp(-1)), rel=0.01)
    assert joints.viscosity == pytest.approx(STALL_TORQUE / 8.06)


@pytest.mark.parametrize("gains", [SimGains(3.0, 0.15, 0.5, 0.0), SimGains(1.0, 0.04, 0.5, 0.0)])
def test_step_response_of_mujoco(gains: SimGains) -> None:
    """A servo with converted gains moves the hand's joints as MuJoCo's own actuator does."""
    hand = MujocoHand(EMPTY)
    scene = Scene.build("dex5", "cube")
    below = scene.grasp_centre - np.array([0.0, 0.0, 10.0])
    with BatchSimulator(scene, control_period=0.005, substeps=1, disturbance=0.0) as bare:
        bare.set_parameters(kp=gains.kp, kv=gains.kv)
        bare.set_grasp(scene.open_q, scene.open_q, below, [1.0, 0.0, 0.0, 0.0])
        servos = [Servo(i + 1, hand, i, 2048, 1) for i in range(15)]
        goals = [servo.ticks(float(hand.q[i])) + 100 for i, servo in enumerate(servos)]
        for servo, goal in zip(servos, goals, strict=True):
            program(servo, to_servo(gains), goal)
        bare.write((np.array(goals) - 2048) * R.RADIANS_PER_TICK)
        step, apart = 100 * R.RADIANS_PER_TICK, []
        for _ in range(100):
            hand.advance(0.005)
            bare.step()
            apart.append(np.abs(hand.q - bare.read().q).max())
        moved = bare.read().q - scene.open_q
    assert np.median(moved) == pytest.approx(step, rel=0.2)
    assert max(apart) < 0.02 * step
