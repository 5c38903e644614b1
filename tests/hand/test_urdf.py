"""URDF hands: against pinocchio's own reader, which is an independent witness."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio
import pytest

from dexctl.exceptions import HandModelError, UnknownName
from dexctl.hand import HandModel, random_configurations

# A wrist, a prismatic joint, fixed links, rotated and tilted frames, an axis that is not a unit
# vector, a mimic joint, a joint that moves no fingertip.
LINKS = "base forearm palm a1 a2 a_tip b1 b2 b_pad b_tip lamp"
JOINTS = """
<joint name="mount" type="fixed"><parent link="base"/><child link="forearm"/>
  <origin xyz="0.1 -0.2 0.3" rpy="0.3 -0.4 1.2"/></joint>
<joint name="wrist" type="revolute"><parent link="forearm"/><child link="palm"/>
  <origin xyz="0 0 0.1" rpy="0.1 0.2 -0.3"/><axis xyz="0 1 0"/>
  <limit lower="-0.5" upper="0.6" effort="7" velocity="2"/></joint>
<joint name="a_slide" type="prismatic"><parent link="palm"/><child link="a1"/>
  <origin xyz="0.03 0.01 0.02" rpy="0 0.7 0"/><axis xyz="0 0 2"/>
  <limit lower="-0.01" upper="0.02" effort="3" velocity="0.1"/></joint>
<joint name="a_flex" type="revolute"><parent link="a1"/><child link="a2"/>
  <origin xyz="0 0 0.04" rpy="1.5 0 0.2"/><axis xyz="1 1 0"/>
  <limit lower="-1" upper="1.5" effort="1" velocity="4"/></joint>
<joint name="a_fix" type="fixed"><parent link="a2"/><child link="a_tip"/>
  <origin xyz="0.01 0.02 0.05" rpy="0.1 0 0"/></joint>
<joint name="b_spin" type="continuous"><parent link="palm"/><child link="b1"/>
  <origin xyz="-0.03 0 0.02" rpy="0 -0.5 0"/><axis xyz="0 0 1"/>
  <limit effort="1" velocity="4"/></joint>
<joint name="b_flex" type="revolute"><parent link="b1"/><child link="b2"/>
  <origin xyz="0 0.01 0.04"/><limit lower="-1" upper="1" effort="1" velocity="4"/></joint>
<joint name="b_mimic" type="revolute"><parent link="b2"/><child link="b_pad"/>
  <origin xyz="0 0 0.03" rpy="0 0.2 0"/><axis xyz="1 0 0"/>
  <limit lower="-3" upper="3" effort="1" velocity="4"/>
  <mimic joint="b_flex" multiplier="0.7" offset="0.1"/></joint>
<joint name="b_fix" type="fixed"><parent link="b_pad"/><child link="b_tip"/>
  <origin xyz="0 0 0.025"/></joint>
<joint name="lamp_joint" type="revolute"><parent link="palm"/><child link="lamp"/>
  <axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
"""


def urdf(path: Path, joints: str = JOINTS, links: str = LINKS) -> Path:
    bodies = "".join(f'<link name="{name}"/>' for name in links.split())
    path.write_text(f'<robot name="test">{bodies}{joints}</robot>')
    return path


@pytest.fixture
def hand(tmp_path: Path) -> HandModel:
    return HandModel.from_urdf(urdf(tmp_path / "hand.urdf"), ["a_tip", "b_tip"])


def test_joints_limits_and_what_moves_what(hand: HandModel) -> None:
    assert hand.joint_names == ("wrist", "a_slide", "a_flex", "b_spin", "b_flex")
    assert hand.shares_joints
    assert hand.moves.tolist() == [
        [True, True, True, False, False],
        [True, False, False, True, True],
    ]
    assert hand.ignored_joints == ("lamp_joint",)
    np.testing.assert_array_equal(hand.lower, [-0.5, -0.01, -1, -np.inf, -1])
    np.testing.assert_array_equal(hand.upper, [0.6, 0.02, 1.5, np.inf, 1])
    np.testing.assert_array_equal(hand.effort, [7, 3, 1, 1, 1])
    np.testing.assert_array_equal(hand.velocity, [2, 0.1, 4, 4, 4])


def test_agrees_with_pinocchios_reader(hand: HandModel) -> None:
    model = pinocchio.buildModelFromUrdf(str(hand.path))
    data = model.createData()
    frames = [model.getFrameId(name) for name in hand.fingertip_names]

    def full(q: np.ndarray) -> np.ndarray:
        values = dict(zip(hand.joint_names, q, strict=True))
        values |= {"b_mimic": 0.7 * values["b_flex"] + 0.1, "lamp_joint": 0.0}
        configuration = pinocchio.neutral(model)
        for name, value in values.items():
            joint = model.joints[model.getJointId(name)]
            # continuous joints are (cos, sin) in pinocchio
            entry = value if joint.nq == 1 else [np.cos(value), np.sin(value)]
            configuration[joint.idx_q : joint.idx_q + joint.nq] = entry
        return configuration

    def tips(q: np.ndarray) -> np.ndarray:
        pinocchio.framesForwardKinematics(model, data, full(q))
        return np.array([data.oMf[frame].translation for frame in frames])

    for q in random_configurations(hand, 100, seed=0):
        np.testing.assert_allclose(hand.fingertip_positions(q), tips(q), rtol=0, atol=1e-12)
    step = 1e-6
    q = random_configurations(hand, 1, seed=1)[0]
    slope = np.stack(
        [(tips(q + d) - tips(q - d)) / (2 * step) for d in step * np.eye(hand.nq)], axis=-1
    )
    jacobian = hand.contact_jacobian(q, hand.fingertip_positions(q))
    np.testing.assert_allclose(jacobian, slope, rtol=0, atol=1e-9)


def test_joints_in_the_order_asked_for(hand: HandModel) -> None:
    order = ["b_flex", "wrist", "a_flex", "b_spin", "a_slide"]
    other = HandModel.from_urdf(hand.path, ["a_tip", "b_tip"], joints=order)
    assert other.joint_names == tuple(order)
    index = [hand.joint_names.index(name) for name in order]
    q = random_configurations(hand, 5, seed=3)
    np.testing.assert_allclose(
        other.fingertip_positions(q[:, index]), hand.fingertip_positions(q), atol=1e-15
    )
    points = hand.fingertip_positions(q)
    np.testing.assert_allclose(
        other.contact_jacobian(q[:, index], points),
        hand.contact_jacobian(q, points)[..., index],
        atol=1e-15,
    )
    np.testing.assert_array_equal(other.effort, hand.effort[index])
    np.testing.assert_array_equal(other.moves, hand.moves[:, index])


@pytest.mark.parametrize(
    "order",
    [
        ["wrist"],
        ["wrist", "a_slide", "a_flex", "b_spin", "b_mimic"],
        ["wrist", "wrist", "a_slide", "a_flex", "b_spin", "b_flex"],
    ],
)
def test_an_order_that_is_none_is_an_error(hand: HandModel, order: list[str]) -> None:
    with pytest.raises(HandModelError, match="wrist, a_slide, a_flex, b_spin, b_flex"):
        HandModel.from_urdf(hand.path, ["a_tip", "b_tip"], joints=order)


def replaced(old: str, new: str) -> str:
    assert old in JOINTS
    return JOINTS.replace(old, new)


@pytest.mark.parametrize(
    ("joints", "message"),
    [
        (replaced('type="prismatic"', 'type="floating"'), "a_slide.*floating"),
        (replaced('type="prismatic"', 'type="planar"'), "a_slide.*planar"),
        (replaced('<child link="a1"/>', '<child link="a9"/>'), "a_slide.*a9.*links: base"),
        (replaced('<child link="a1"/>', ""), "a_slide.*lacks parent or child"),
        (replaced('mimic joint="b_flex"', 'mimic joint="b_flux"'), "b_mimic.*b_flux.*not there"),
        (replaced('mimic joint="b_flex"', 'mimic joint="b_mimic"'), "b_mimic.*follows itself"),
        (replaced("0.1 -0.2 0.3", "0.1 -0.2"), "mount.*xyz.*0.1 -0.2"),
        (replaced("0.1 -0.2 0.3", "0.1 nan 0.3"), "mount.*xyz.*nan"),
        (replaced('xyz="1 1 0"', 'xyz="0 0 0"'), "a_flex.*axis of length zero"),
        (replaced('lower="-1" upper="1.5"', 'lower="low" upper="1.5"'), "a_flex.*lower.*low"),
        (replaced('multiplier="0.7"', 'multiplier="x"'), "b_mimic.*multiplier.*x"),
        (
            JOINTS
            + '<joint name="loop" type="fixed"><parent link="a_tip"/><child link="base"/></joint>',
            "the links base, forearm, .* form a loop",
        ),
        (
            JOINTS
            + '<joint name="again" type="fixed"><parent link="b1"/><child link="a1"/></joint>',
            "a1.*two joints, 'a_slide' and 'again'",
        ),
        (replaced('name="b_fix"', 'name="a_fix"'), "several joints are called 'a_fix'"),
    ],
)
def test_broken_files_are_named(tmp_path: Path, joints: str, message: str) -> None:
    with pytest.raises(HandModelError, match=message):
        HandModel.from_urdf(urdf(tmp_path / "hand.urdf", joints), ["a_tip", "b_tip"])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not well-formed"),
        ("<robot", "not well-formed"),
        ("<mujoco/>", "<mujoco>"),
        ('<robot name="x"/>', "unknown fingertip 'a_tip'; known: none"),
    ],
)
def test_files_that_are_no_urdf(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "hand.urdf"
    path.write_text(text)
    with pytest.raises((HandModelError, UnknownName), match=message):
        HandModel.from_urdf(path, ["a_tip"])


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(HandModelError, match=r"absent\.urdf: no such file"):
        HandModel.from_urdf(tmp_path / "absent.urdf", ["a_tip"])
    with pytest.raises(HandModelError, match="no such file"):  # a folder
        HandModel.from_urdf(tmp_path, ["a_tip"])


def test_a_fingertip_on_the_base_is_an_error(hand: HandModel) -> None:
    with pytest.raises(HandModelError, match="no joint moves the fingertip 'forearm'"):
        HandModel.from_urdf(hand.path, ["a_tip", "forearm"])


def test_a_zero_where_nobody_knew_the_limit_is_none(tmp_path: Path) -> None:
    text = JOINTS.replace('effort="7" velocity="2"', 'effort="0" velocity="0.0"')
    hand = HandModel.from_urdf(urdf(tmp_path / "hand.urdf", text), ["a_tip", "b_tip"])
    assert hand.effort[0] == hand.velocity[0] == np.inf
