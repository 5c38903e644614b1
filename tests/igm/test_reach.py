"""Reach: each end by hand-made fingers and finite differences, and a closed loop that stops."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dexctl import CoordinatedGait, FingerGaiting, HandModel, InGraspManipulation, InvalidInput
from dexctl.igm import InGraspManipulationConfig
from dexctl.igm.reach import Reach
from dexctl.sim import BatchSimulator, Scene

FAR = {"reach_margin": 0.0, "link_limit": 1.0, "damping": 1e-6}


def reach(
    hand: HandModel,
    q: np.ndarray,
    velocity: Any,
    normal: Any = (0, 0, 0),
    *,
    turn: Any = (0, 0, 0),
    lever: Any = (0, 0, 0),
    lead: Any = 0.0,
    **settings: Any,
) -> float:
    """Reach of a hand whose first finger is to move at ``velocity``, or with a turn; the others do
    not count."""
    config = InGraspManipulationConfig(**{**FAR, "reach_distance": 1.0, **settings})
    now = hand.configuration(q[None])
    tip = now.fingertip_position
    fingers = np.arange(hand.n_fingers)[None] == 0
    facing = np.zeros_like(tip)
    facing[0, 0] = normal
    twist = np.array([[*velocity, *turn]], float)
    levers = np.zeros_like(tip) + lever
    ahead = q + np.asarray(lead)
    found = Reach(hand, config)(now, q[None], ahead[None], twist, tip, facing, levers, fingers)
    return float(found[0])


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> HandModel:
    """A finger in the xz plane, two links of 0.05 m, that also slides 0.1 m along y."""
    mass = '<inertial pos="0 0 0" mass="0.01" diaginertia="1e-5 1e-5 1e-5"/>'
    path: Path = tmp_path_factory.mktemp("arm") / "arm.xml"
    path.write_text(
        '<mujoco><compiler angle="radian" autolimits="true"/><worldbody><body>'
        f'<joint name="y" type="slide" axis="0 1 0" range="-0.1 0.1"/>{mass}'
        f'<body><joint name="a" axis="0 1 0" range="-3 3"/>{mass}<body pos="0 0 .05">'
        f'<joint name="b" axis="0 1 0" range="-3 3"/>{mass}<body name="tip" pos="0 0 .05"/>'
        "</body></body></body></worldbody></mujoco>"
    )
    return HandModel.from_mjcf(path, ["tip"])


def test_a_joint_ends_at_its_limit(arm: HandModel) -> None:
    q = np.array([0.06, 0.4, 1.0])
    assert reach(arm, q, (0, 0.02, 0)) == pytest.approx(0.04)  # however fast
    assert reach(arm, q, (0, 0.5, 0)) == pytest.approx(0.04)
    assert reach(arm, q, (0, -0.02, 0)) == pytest.approx(0.16)
    assert reach(arm, q, (0, 0.02, 0), reach_distance=0.02, reach_margin=0.03) == pytest.approx(0.5)
    assert reach(arm, np.array([0.11, 0.4, 1.0]), (0, 0.02, 0)) == 0.0
    assert reach(arm, q, (0, 0, 0)) == 1.0


def test_a_finger_ends_where_it_is_stretched_and_comes_back(arm: HandModel) -> None:
    """Near the end 1/g falls linearly with the distance to it, which is then Newton's step."""
    for bend, rel in ((0.2, 0.02), (0.1, 0.005)):
        q = np.array([0.0, -0.5 * bend, bend])  # the tip is straight above
        left = 0.1 * (1.0 - np.cos(0.5 * bend))
        assert reach(arm, q, (0, 0, 0.01), reach_distance=0.01) == pytest.approx(
            left / 0.01, rel=rel
        )
        assert reach(arm, q, (0, 0, -0.01), reach_distance=0.005) == 1.0


def test_the_growth_is_that_of_finite_differences(dex5: HandModel) -> None:
    """The distance to the singular posture, g |v| / g', for a general posture and twist."""
    rng = np.random.default_rng(0)
    seen = 0
    for _ in range(40):
        q = rng.uniform(-0.5, 0.5, dex5.nq) + np.tile([0.0, 0.4, -0.9], 5)
        v = rng.normal(size=3)

        def measure(q: np.ndarray, v: np.ndarray = v) -> tuple[float, np.ndarray]:
            now = dex5.configuration(q)
            jacobian = now.contact_jacobian(now.fingertip_position)[0]
            inverse = np.linalg.inv(jacobian @ jacobian.T + 1e-12 * np.eye(3))
            return float(v @ inverse @ v), jacobian.T @ inverse @ v

        g, rate = measure(q)
        growth = (measure(q + 1e-6 * rate)[0] - measure(q - 1e-6 * rate)[0]) / 2e-6
        own = np.where(rate > 0, dex5.upper, dex5.lower) - q
        moving = np.abs(rate) > 0
        limit = float((own[moving] / rate[moving]).min())
        expected = np.linalg.norm(v) * min(limit, g / growth if growth > 0 else np.inf)
        if growth > 0 and g / growth < limit:
            seen += 1
        found = reach(dex5, q, v, reach_distance=10.0)
        assert found == pytest.approx(np.clip(expected / 10.0, 0.0, 1.0), rel=1e-4, abs=1e-9)
    assert seen > 5


def test_a_contact_ends_where_it_has_rolled_to_the_link(arm: HandModel) -> None:
    q = np.array([0.0, 0.3, 0.6])
    angle = 0.9  # of the link, from z towards x; it goes back along -(sin, 0, cos)
    back = -np.array([np.sin(angle), 0.0, np.cos(angle)])
    across = np.array([np.cos(angle), 0.0, -np.sin(angle)])
    # a velocity that turns the link one way rolls the contact towards it, the other away
    found = {
        sign: reach(arm, q, (sign * 0.02, 0, 0), across, reach_distance=1e-3, link_limit=-0.001)
        for sign in (1, -1)
    }
    assert sorted(found.values()) == [0.0, 1.0]
    for sign in (1, -1):
        assert reach(arm, q, (sign * 0.02, 0, 0), -back, reach_distance=1e-3) == 1.0


def test_it_ends_where_friction_does(arm: HandModel) -> None:
    """A finger that pushes along y with half of what it presses with along x."""
    q = np.array([0.0, 0.7, -1.4])  # the tip is straight above the first joint
    across = 0.05 * np.cos(0.7) * np.array([2.0, 1.0])  # of the tip along x, by joints a and b

    def left(speed: float, limit: float, y: float = 1e-3, x: float = 2e-3) -> float:
        lead, turn = np.array([y, *(x * across)]), (0, 0, -speed)  # J^T f; about z, at x = -1
        settings = {"reach_distance": 1e-3, "slip_limit": limit}
        at = {"lever": (-1, 0, 0), "lead": lead}
        assert reach(arm, q, (0, speed, 0), (1, 0, 0), **at, **settings) == 1.0  # along a line
        return reach(arm, q, (0, 0, 0), (1, 0, 0), turn=turn, **at, **settings)

    for speed in (0.02, 0.3):
        for hard in (1.0, 5.0):
            found = left(speed, 0.6, 1e-3 * hard, 2e-3 * hard)
            assert found == pytest.approx((1.0 - 0.5 / 0.6) / 0.3, rel=1e-6)
    assert left(0.02, 0.49) == 0.0
    assert left(-0.02, 0.49) == 1.0  # it goes back
    assert left(0.02, 0.0) == 1.0  # does not count
    assert left(0.02, 0.75) == 1.0  # not near it
    assert left(0.02, 5.0, x=0.0) == left(0.02, 5.0, x=-2e-3) == 0.0  # nothing presses
    assert left(0.0, 0.1) == 1.0


def test_the_object_that_something_stops(dex5: HandModel) -> None:
    """It is not turned on where it does not follow: friction is what gives way at last."""
    sim = BatchSimulator(Scene.build(dex5, "sphere", "up"), 1, seed=0)
    state, found = sim.read(), {}
    for limit in (0.0, 0.35):
        sim.reset(0)
        controller = InGraspManipulation(dex5, slip_limit=limit, engine="plain")
        state = sim.read()
        where = np.asarray(state.q).copy()
        target = np.asarray(state.q_target).copy()
        for _ in range(40):  # joints that stand still while set-points go on
            target = target + controller.act(replace(state, q=where, q_target=target))
        found[limit] = controller.diagnostics["reach"][0], np.abs(target - where).mean()
    assert found[0.0][0] == 1.0 and found[0.35][0] < 0.2
    assert found[0.35][1] < 0.85 * found[0.0][1]


def test_the_thesis_goes_on_regardless(dex5: HandModel, grasp_of: Callable[..., Any]) -> None:
    stretched = grasp_of(dex5, np.tile([-0.69, 0.1, 0.0], 5))
    for kind in (InGraspManipulationConfig.thesis(), InGraspManipulationConfig(reach_distance=0.0)):
        controller = InGraspManipulation(dex5, kind)
        controller.act(stretched)
        assert controller.diagnostics["reach"] == 1.0
    assert FingerGaiting(dex5).in_grasp.config.reach_distance == 0.0
    controller = InGraspManipulation(dex5)
    controller.act(stretched)
    assert controller.diagnostics["reach"] < 1.0


def test_one_hand_and_a_batch(dex5: HandModel, grasp_of: Callable[..., Any]) -> None:
    q = np.tile([0.0, 0.5, -0.85], (3, 5))
    q[1, 0], q[2, 2] = -0.6, -0.1
    controller = InGraspManipulation(dex5, reach_distance=0.05)
    controller.act(grasp_of(dex5, q))
    batch = controller.diagnostics["reach"]
    assert len(set(batch)) > 1
    for i in range(3):
        single = InGraspManipulation(dex5, reach_distance=0.05)
        single.act(grasp_of(dex5, q[i]))
        assert single.diagnostics["reach"] == pytest.approx(batch[i])


@pytest.mark.parametrize("name", ["reach_distance", "reach_margin", "link_limit", "slip_limit"])
def test_bad_settings(name: str) -> None:
    with pytest.raises(InvalidInput, match=f"{name} is -2"):
        InGraspManipulationConfig(**{name: -2.0})  # type: ignore[arg-type]


@pytest.mark.parametrize("shape", ["cylinder", "cube"])
def test_it_stops_holds_and_goes_back(dex5: HandModel, shape: str) -> None:
    sim = BatchSimulator(Scene.build(dex5, shape, "up"), 2, seed=0)
    there = InGraspManipulation(dex5)
    state = sim.read()
    for _ in range(160):
        sim.write(state.q_target + there.act(state))
        sim.step()
        state = sim.read()
    assert (there.diagnostics["reach"] < 0.15).all()
    assert (state.in_contact.sum(axis=1) >= 4).all()
    turned = 2 * np.arcsin(np.asarray(state.object_quaternion)[:, 3])
    back = InGraspManipulation(dex5, twist=(0, 0, 0, 0, 0, -0.4))
    back.act(state)
    assert (back.diagnostics["reach"] == 1.0).all()
    for _ in range(30):
        sim.write(state.q_target + back.act(state))
        sim.step()
        state = sim.read()
    after = 2 * np.arcsin(np.asarray(state.object_quaternion)[:, 3])
    assert (turned - after > 0.3).all()


def test_the_gait_keeps_its_own_end(dex5: HandModel) -> None:
    assert CoordinatedGait(dex5).config.in_grasp.reach_distance == 0.0
