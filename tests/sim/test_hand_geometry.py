"""Links and fingertips of many hands at once, against MuJoCo's and pinocchio's kinematics."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from dexctl.exceptions import InvalidInput
from dexctl.hand import HandModel, random_configurations
from dexctl.sim import Scene
from dexctl.sim.hand_geometry import HandGeometry


@pytest.fixture(scope="module", params=["dex5", "four_fingers"])
def scene(request: pytest.FixtureRequest) -> Scene:
    hand = request.getfixturevalue("dex5" if request.param == "dex5" else "four_fingers")
    return Scene.build(hand, "sphere", "up")


def test_links_are_where_mujoco_has_them(scene: Scene) -> None:
    geometry, model = HandGeometry(scene), scene.model
    data, q = mujoco.MjData(model), random_configurations(scene.hand, 5, 0)
    poses = geometry.poses(q)
    tips, links = poses.centres(geometry.tips), poses.centres(geometry.links)
    for i, row in enumerate(q):
        data.qpos[scene.qpos_columns] = row
        mujoco.mj_kinematics(model, data)
        for finger, name in enumerate(scene.hand.fingertip_bodies):
            geom = int(np.flatnonzero(model.geom_bodyid == model.body(name).id)[0])
            away = np.linalg.norm(tips[i, finger] - data.geom_xpos[geom])
            half = model.geom_size[geom, 1]  # 0 for a sphere; the ball is a capsule's end
            assert away == pytest.approx(half, abs=1e-9)
        # each ball is inside a geom of the hand
        for ball, radius in zip(links[i], geometry.links.radius, strict=True):
            gaps = np.linalg.norm(data.geom_xpos - ball, axis=1)
            assert (gaps - model.geom_rbound + radius).min() < 1e-6


def test_tips_are_the_hand_models(dex5: HandModel) -> None:
    geometry = HandGeometry(Scene.build(dex5, "cube", "up"))
    q = random_configurations(dex5, 20, 1)
    tips = geometry.poses(q).centres(geometry.tips)
    np.testing.assert_allclose(tips, dex5.fingertip_positions(q), atol=1e-12)
    np.testing.assert_allclose(geometry.tips.radius, 0.014)


def test_jacobian_is_the_difference_quotient(scene: Scene) -> None:
    geometry, hand = HandGeometry(scene), scene.hand
    q = random_configurations(hand, 3, 2)
    poses = geometry.poses(q)
    tip = poses.centres(geometry.tips)
    jacobian = geometry.tip_jacobian(poses, tip)
    step = 1e-6
    for finger in range(hand.n_fingers):
        for place in range(int(hand.moves[finger].sum())):
            moved = q.copy()
            moved[:, hand.finger_joints[finger, place]] += step
            after = geometry.poses(moved).centres(geometry.tips)[:, finger]
            np.testing.assert_allclose(
                (after - tip[:, finger]) / step, jacobian[:, finger, :, place], atol=1e-6
            )


def test_joints_carry_the_weight_of_the_links(scene: Scene) -> None:
    geometry, model = HandGeometry(scene), scene.model
    data, q = mujoco.MjData(model), random_configurations(scene.hand, 4, 3)
    gravity = np.array([1.0, -2.0, -9.0])
    torque = geometry.carrying(geometry.poses(q), gravity)
    model.opt.gravity[:] = gravity
    for row, own in zip(q, torque, strict=True):
        data.qpos[scene.qpos_columns] = row
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(own, data.qfrc_bias[scene.qvel_columns], atol=1e-9)
    model.opt.gravity[:] = scene.gravity


def test_a_fingertip_that_is_no_ball_is_the_ball_of_the_toml(
    dex5: HandModel, tmp_path: Path
) -> None:
    ball, box = 'class="dex5_tip"/>', 'class="dex5_tip" type="box" size="0.01 0.01 0.01"/>'
    assert dex5.path.read_text().count(ball) == 5
    boxes = tmp_path / "boxes.xml"
    boxes.write_text(dex5.path.read_text().replace(ball, box))
    hand = replace(dex5.config, description=boxes).build()
    geometry = HandGeometry(Scene.build(hand, "cube"))
    q = random_configurations(hand, 3, 1)
    tips = geometry.poses(q).centres(geometry.tips)
    np.testing.assert_allclose(tips, hand.fingertip_positions(q), atol=1e-12)
    np.testing.assert_allclose(geometry.tips.radius, 0.014)
    bare = replace(hand.config, fingertip_radius=0.0).build()
    with pytest.raises(InvalidInput, match=r"'f1_tip' is neither.*write fingertip_radius \[m\]"):
        HandGeometry(Scene.build(bare, "cube"))
