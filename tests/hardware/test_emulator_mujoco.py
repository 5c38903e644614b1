"""The MuJoCo hand behind the emulated servos: it follows the bare simulator, holds and feels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dexctl.exceptions import InvalidInput
from dexctl.settings import changed
from dexctl.sim import BatchSimulator, Scene, SceneConfig
from hardware import registers as R  # noqa: N812
from hardware.bus import Bus
from hardware.emulator import Emulator
from hardware.emulator.mujoco_hand import MujocoHand
from hardware.scene import EMPTY, HOLDING
from hardware.units import ServoGains, SimGains, to_servo, to_sim

GAINS = to_servo(SimGains(kp=3.0, kv=0.15, torque_limit=0.5, speed_limit=0.6))
STEP = 0.005


@pytest.fixture(scope="module")
def hand() -> Iterator[Emulator]:
    pytest.importorskip("dynamixel_sdk", reason="needs the extra 'hardware'")
    with Emulator(dynamics="mujoco", manual=True) as emulator:
        yield emulator


def holding(**changes: Any) -> MujocoHand:
    return MujocoHand(changed(replace(HOLDING, object=("cube",)), changes), seed=3)


def test_the_object_is_the_one_asked_for() -> None:
    usual, other = holding(), holding(object_mass=0.2, object_size=0.07, gravity="down")
    for hand, mass, width, down in ((usual, 0.1, 0.1, -9.81), (other, 0.2, 0.07, 9.81)):
        scene = hand._sim.sim.groups[0].scene
        assert scene.model.body("object").mass == pytest.approx(mass)
        assert (scene.object_width, scene.model.opt.gravity[2]) == pytest.approx((width, down))
        assert hand.grasp() == pytest.approx(scene.settled.q_target.tolist())
    assert MujocoHand(EMPTY).grasp() is None


def test_joints_are_told_with_noise_and_late_and_move_as_before() -> None:
    plain, noisy = holding(), holding(joint_noise=0.01, force_noise=0.1, sensor_latency=0.02)
    for hand in (plain, noisy):
        hand.advance(0.1)
    assert np.array_equal(plain.q, noisy.q)
    assert np.array_equal(plain.measured, plain.q)
    assert 0.003 < np.abs(noisy.measured - noisy.q).mean() < 0.03
    assert noisy.touch()["age"] == pytest.approx(0.025)  # and the physics step that touch is late


def test_pushes_move_what_nobody_holds() -> None:
    moved = []
    for hand in (holding(), holding(push_force=5.0)):
        hand.support(False)
        start = np.array(hand.touch()["object_position"])
        hand.advance(0.2)
        moved.append(np.array(hand.touch()["object_position"]) - start)
    assert np.linalg.norm(moved[1] - moved[0]) > 1e-3


@pytest.mark.parametrize("name", ["cylinder", "l_shape", "cuboid_long"])
def test_an_object_that_a_finger_presses_on_softly_is_let_go_too(name: str) -> None:
    assert not held_after(1.0, replace(HOLDING, object=(name,)))


@pytest.mark.parametrize("seed", [0, 2, 3])
def test_an_object_that_not_all_fingers_reach_is_let_go_too(seed: int) -> None:
    """Joint origins that are off: one or two fingers press less, or nowhere."""
    sensing = replace(HOLDING.sensing, joint_offset=0.05)
    assert not held_after(3.0, replace(HOLDING, object=("l_shape",), sensing=sensing), seed)


def held_after(seconds: float, scene: SceneConfig, seed: int = 0) -> bool:
    """Whether somebody still holds the object, so long after the hand has gone to its grasp."""
    joints = MujocoHand(scene, seed)
    c = joints.commands
    c.torque_on[:], c.kp[:], c.kd[:], c.limit[:], c.speed[:] = True, 3.0, 0.15, 0.5, 0.6
    c.goal[:] = joints.reference[:] = np.array(joints.grasp())
    assert joints.supported
    joints.advance(seconds)
    return joints.supported


def test_several_objects_do_not_fit() -> None:
    with pytest.raises(InvalidInput, match="object is cube, sphere; expected one"):
        holding(object=("cube", "sphere"))


def arm(bus: Bus, gains: ServoGains = GAINS, speed: int | None = None) -> None:
    bus.write(R.OPERATING_MODE, R.OperatingMode.CURRENT_BASED_POSITION)
    bus.write(R.POSITION_P_GAIN, gains.p)
    bus.write(R.POSITION_D_GAIN, gains.d)
    bus.write(R.GOAL_CURRENT, gains.current * R.AMPERES)
    profile = gains.profile_velocity if speed is None else speed
    bus.write(R.PROFILE_VELOCITY, profile * R.RADIANS_PER_SECOND)
    bus.write(R.GOAL_POSITION, bus.read(R.PRESENT_POSITION).value)
    bus.write(R.TORQUE_ENABLE, 1)


def test_nothing_moves_before_torque_is_on(hand: Emulator) -> None:
    before = np.array(hand.state()["position"])
    hand.advance(1.0)
    assert np.array(hand.state()["position"]) == pytest.approx(before, abs=0.05)
    assert hand.touch()["supported"]  # type: ignore[index]


def test_it_grips_and_then_holds_by_itself(hand: Emulator) -> None:
    hand.reset()
    settled = Scene.build("dex5", "cylinder").settled
    with Bus(hand.port, range(1, 16), timeout=1.0) as bus:
        arm(bus)
        bus.write(R.GOAL_POSITION, settled.q_target + np.pi)
        hand.advance(2.0)
        feel = hand.touch()
        assert feel is not None and not feel["supported"]
        start = np.array(feel["object_position"])
        hand.advance(2.0)
        feel = hand.touch()
        assert feel is not None
        assert np.array(feel["force"]) == pytest.approx(np.full(5, 2.0), abs=0.4)
        assert all(feel["in_contact"])
        assert np.linalg.norm(feel["normal"], axis=1) == pytest.approx(np.ones(5))
        assert np.array(feel["object_position"]) == pytest.approx(start, abs=0.003)
        # what the servos measure is what the shafts do
        shafts = np.array(hand.state()["position"])
        present = bus.read(R.PRESENT_POSITION).value - np.pi
        assert present == pytest.approx(shafts, abs=R.RADIANS_PER_TICK)
        bus.write(R.TORQUE_ENABLE, 0)
        hand.advance(1.5)
        feel = hand.touch()
        assert (
            feel is not None and np.linalg.norm(np.subtract(feel["object_position"], start)) > 0.01
        )


def test_same_trace_as_the_bare_simulator() -> None:
    """No object, set-points every 20 ms: within 3 mrad RMS through bus and registers."""
    scene = Scene.build("dex5", "cube")
    # the gains that the registers can hold, so that only ticks and the wire are between the two
    gains = to_sim(GAINS)
    below = scene.grasp_centre + np.array([0.0, 0.0, -10.0])
    with (
        BatchSimulator(scene, control_period=STEP, substeps=1, disturbance=0.0) as bare,
        Emulator(dynamics="mujoco", scene=EMPTY, manual=True) as emulator,
        Bus(emulator.port, range(1, 16), timeout=1.0) as bus,
    ):
        bare.set_parameters(kp=gains.kp, kv=gains.kv)
        bare.set_grasp(scene.open_q, scene.open_q, below, [1.0, 0, 0, 0])
        arm(bus, speed=0)
        start, apart = scene.open_q, []
        bus.write(R.GOAL_POSITION, start + np.pi)
        for i in range(150):
            goal = start + 0.2 * np.sin(2 * np.pi * 0.5 * i * 0.02 + np.arange(15))
            goal = np.clip(goal, scene.lower, scene.upper)
            bus.write(R.GOAL_POSITION, goal + np.pi)
            bare.write(goal)
            present = bus.read(R.PRESENT_POSITION).value - np.pi  # also a barrier for the write
            emulator.advance(0.02)
            for _ in range(4):
                bare.step()
            present = bus.read(R.PRESENT_POSITION).value - np.pi
            apart.append(present - bare.read().q)
    rms = np.sqrt(np.mean(np.square(apart)))
    assert rms < 0.003


def test_current_limit_and_torque_off_bound_the_torque() -> None:
    hand = MujocoHand(EMPTY)
    c = hand.commands
    c.torque_on[:], c.mode[:] = True, int(R.OperatingMode.CURRENT_BASED_POSITION)
    c.kp[:], c.kd[:], c.limit[:] = 3.0, 0.15, 0.02
    c.goal[:] = hand.q + 0.3
    hand.advance(0.5)
    assert np.abs(hand.torque).max() <= 0.02 + 1e-12
    c.torque_on[:] = False
    hand.advance(0.1)
    assert (hand.torque == 0).all()


def test_the_object_of_an_empty_hand_falls_and_is_no_fault() -> None:
    hand = MujocoHand(EMPTY)
    hand.advance(5.0)  # 120 m
    assert not hand._sim.diverged
    assert hand.touch()["object_position"] is None
