"""What links weigh at the joints: against numbers by hand, energy, and servos that hold them."""

from __future__ import annotations

import threading
from pathlib import Path

import mujoco
import numpy as np
import pytest

import dexctl
from dexctl import HandModel
from dexctl.exceptions import InvalidInput
from dexctl.sim import BatchSimulator, LinkWeights, Scene

DOWN = np.array([0.0, 0.0, -9.81])
# two fingers of one link each, along x: 0.1 kg at 50 mm and, on `b`, twice that
PENDULA = """
<mujoco><option timestep="0.002"/><worldbody><body name="palm"><geom size="0.01" mass="1"/>
  {fingers}
</body></worldbody>{rest}</mujoco>"""
FINGER = """
  <body name="{name}" pos="0 {y} 0" gravcomp="{balanced}">
    <joint name="j{name}" axis="0 1 0" damping="0.1"/>
    <inertial pos="0.05 0 0" mass="{mass}" diaginertia="1e-5 1e-5 1e-5"/>
    <geom type="capsule" fromto="0 0 0 0.1 0 0" size="0.005"/>
  </body>"""


def pendula(folder: Path, rest: str = "", balanced: float = 0.0) -> HandModel:
    fingers = "".join(
        FINGER.format(name=name, y=y, mass=mass, balanced=balanced)
        for name, y, mass in (("a", -0.05, 0.1), ("b", 0.05, 0.2))
    )
    path = folder / "pendula.xml"
    path.write_text(PENDULA.format(fingers=fingers, rest=rest))
    return HandModel.from_mjcf(path, {"a": (0.1, 0, 0), "b": (0.1, 0, 0)})


def test_two_links_by_hand(tmp_path: Path) -> None:
    weights = LinkWeights(pendula(tmp_path))
    # a positive angle about y turns x down, so to hold a link up is negative
    level, lever = np.zeros(2), 9.81 * 0.05
    np.testing.assert_allclose(weights(level, DOWN), [-0.1 * lever, -0.2 * lever])
    np.testing.assert_allclose(weights(level, -DOWN), [0.1 * lever, 0.2 * lever])
    np.testing.assert_allclose(weights([np.pi / 2, np.pi / 3], DOWN), [0, -0.1 * lever], atol=1e-12)
    np.testing.assert_allclose(weights(level, [0.0, -9.81, 0.0]), 0.0, atol=1e-12)


def test_what_follows_weighs_on_its_master(tmp_path: Path) -> None:
    rest = '<equality><joint joint1="jb" joint2="ja" polycoef="0 0.5 0 0 0"/></equality>'
    hand = pendula(tmp_path, rest)
    assert hand.joint_names == ("ja",)
    # 0.1 kg, and 0.2 kg that move half as far
    np.testing.assert_allclose(LinkWeights(hand)([0.0], DOWN), [-(0.1 + 0.1) * 9.81 * 0.05])


def test_what_the_file_counts_as_balanced_weighs_nothing(tmp_path: Path) -> None:
    weights = LinkWeights(pendula(tmp_path, balanced=1.0))
    np.testing.assert_allclose(weights(np.zeros(2), DOWN), 0.0, atol=1e-12)


def test_it_is_the_slope_of_the_energy() -> None:
    hand = dexctl.hands.load("dex5")
    scene = Scene.build(hand, "cylinder")
    rng = np.random.default_rng(0)
    q = rng.uniform(hand.lower, hand.upper, (4, hand.nq))
    gravity = 9.81 * rng.normal(size=(4, 3))
    found = LinkWeights(hand, scene.model)(q, gravity)
    data, steps = mujoco.MjData(scene.model), 1e-6 * np.eye(hand.nq)

    def energy(joints: np.ndarray, pull: np.ndarray) -> float:
        data.qpos[scene.qpos_columns] = joints
        mujoco.mj_kinematics(scene.model, data)
        mujoco.mj_comPos(scene.model, data)
        return -float(scene.model.body_mass @ data.xipos @ pull)

    for i in range(4):
        slope = [
            (energy(q[i] + s, gravity[i]) - energy(q[i] - s, gravity[i])) / 2e-6 for s in steps
        ]
        np.testing.assert_allclose(found[i], slope, atol=1e-8)


def test_it_is_what_servos_hold_fingers_with_that_touch_nothing() -> None:
    scene = Scene.build("dex5", "cylinder", "up")
    weights = LinkWeights(scene.hand)
    with BatchSimulator(scene, 1, disturbance=0.0) as sim:
        for _ in range(40):
            sim.write(scene.open_q[None])
            sim.step()
        state = sim.read()[0]
    assert not state.in_contact.any()
    held = scene.stiffness * (state.q_target - state.q)
    np.testing.assert_allclose(held, weights(state.q, scene.gravity), atol=1e-4)
    assert np.abs(held).max() > 3e-3  # there is something to hold


def test_one_gravity_or_one_for_each(tmp_path: Path) -> None:
    weights = LinkWeights(pendula(tmp_path))
    q = np.random.default_rng(0).normal(size=(2, 3, 2))
    every = weights(q, np.tile(DOWN, (2, 3, 1)))
    np.testing.assert_array_equal(every, weights(q, DOWN))
    np.testing.assert_array_equal(every[1, 2], weights(q[1, 2], DOWN))
    assert weights(np.zeros((0, 2)), DOWN).shape == (0, 2)


def test_threads_take_turns(tmp_path: Path) -> None:
    weights = LinkWeights(pendula(tmp_path))
    q = np.random.default_rng(0).normal(size=(500, 2))
    pulls = [DOWN, -DOWN, 2 * DOWN, np.zeros(3)]
    alone = [weights(q, pull) for pull in pulls]
    found: dict[int, np.ndarray] = {}
    threads = [
        threading.Thread(target=lambda i=i, g=g: found.update({i: weights(q, g)}))
        for i, g in enumerate(pulls)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for i, one in enumerate(alone):
        np.testing.assert_array_equal(found[i], one)


def test_what_it_refuses(tmp_path: Path) -> None:
    weights = LinkWeights(pendula(tmp_path))
    with pytest.raises(InvalidInput, match=r"q has shape \(3,\); expected \(..., 2\)"):
        weights(np.zeros(3), DOWN)
    with pytest.raises(
        InvalidInput, match=r"gravity has shape \(2,\); expected \(3,\) or \(4, 3\)"
    ):
        weights(np.zeros((4, 2)), np.zeros(2))
