"""MJCF hands: what files of other people hold, and what must be refused with a clear line."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from dexctl.exceptions import HandModelError, UnknownName
from dexctl.hand import HandModel, random_configurations

# A wrist under two fingers; references other than zero; two joints with anchors on one body; a
# tilted frame; tips on a jointless body and on a site; a drive that two joints follow; a lamp.
BODY = """
<body name="palm" pos="0.1 0.2 0.3" euler="20 -30 40">
  <joint name="wrist" axis="0 1 0" range="-30 30" ref="10"/>
  <geom size="0.02"/>
  <body name="a1" pos="0.03 0 0.02" euler="0 40 0">
    <joint name="a_roll" axis="1 0.5 0" pos="0.01 0 -0.005" range="-40 40" actuatorfrcrange="-2 2"/>
    <joint name="a_flex" axis="0 1 0" pos="0 0.004 0.01" range="-40 60" ref="-15"/>
    <geom size="0.01"/>
    <body name="a2" pos="0 0 0.05">
      <joint name="a_slide" type="slide" axis="0 0.3 1" range="-0.01 0.02" ref="0.004"/>
      <geom size="0.01"/>
      <body name="a_tip" pos="0.003 0 0.03" euler="0 0 30"><geom size="0.01"/></body>
    </body>
  </body>
  <body name="b1" pos="-0.03 0 0.02">
    <joint name="b_flex" axis="1 0 0" ref="5"/>
    <geom size="0.01"/>
    <body name="b2" pos="0 0 0.05">
      <joint name="b_tied" axis="0 1 0" range="-90 90"/>
      <geom size="0.01"/>
      <site name="b_tip" pos="0 0.002 0.03"/>
    </body>
  </body>
  <body name="lamp"><joint name="lamp" axis="0 0 1"/><geom size="0.01"/></body>
</body>
"""
TIE = '<joint joint1="b_tied" joint2="b_flex" polycoef="0.1 0.7 0 0 0"/>'
SCENE = """
<body name="ball" pos="0 0 1"><freejoint name="ball"/><geom size="0.03"/></body>
<body name="cart" pos="1 0 0"><joint name="cart" type="slide"/><geom size="0.1"/></body>
"""
TIPS = ["a_tip", "b_tip"]


def mjcf(path: Path, body: str = BODY, equality: str = TIE, actuator: str = "") -> Path:
    path.write_text(
        f"<mujoco><worldbody>{SCENE}{body}</worldbody><equality>{equality}</equality>"
        f"<actuator>{actuator}</actuator></mujoco>"
    )
    return path


@pytest.fixture
def hand(tmp_path: Path) -> HandModel:
    actuator = '<position joint="a_flex" gear="-3" forcerange="-0.2 0.1"/>'
    return HandModel.from_mjcf(mjcf(tmp_path / "hand.xml", actuator=actuator), TIPS)


def mujoco_tips(hand: HandModel, q: np.ndarray) -> np.ndarray:
    """The tips of this file by MuJoCo, with the tied joint put where its equality wants it."""
    model = mujoco.MjModel.from_xml_path(str(hand.path))
    data = mujoco.MjData(model)
    for name, value in zip(hand.joint_names, q, strict=True):
        data.joint(name).qpos = value
    deflection = data.joint("b_flex").qpos - model.qpos0[model.joint("b_flex").qposadr]
    data.joint("b_tied").qpos = 0.1 + 0.7 * deflection
    mujoco.mj_kinematics(model, data)
    return np.array([data.body("a_tip").xpos, data.site("b_tip").xpos])


def test_joints_limits_and_what_moves_what(hand: HandModel) -> None:
    assert hand.joint_names == ("wrist", "a_roll", "a_flex", "a_slide", "b_flex")
    assert hand.shares_joints
    moves = [[True, True, True, True, False], [True, False, False, False, True]]
    assert hand.moves.tolist() == moves
    assert hand.ignored_joints == ("ball", "cart", "lamp")
    assert hand.fingertip_bodies == ("a_tip", "b2")
    np.testing.assert_allclose(hand.lower, [*np.radians([-30, -40, -40]), -0.01, -np.inf])
    np.testing.assert_array_equal(hand.effort, [np.inf, 2, 3 * 0.2, np.inf, np.inf])


def test_agrees_with_mujoco(hand: HandModel) -> None:
    for q in random_configurations(hand, 100, seed=0):
        np.testing.assert_allclose(
            hand.fingertip_positions(q), mujoco_tips(hand, q), rtol=0, atol=1e-12
        )


def test_jacobian_through_wrist_anchors_and_couplings(hand: HandModel) -> None:
    step = 1e-6
    for q in random_configurations(hand, 20, seed=1):
        differences = [
            mujoco_tips(hand, q + d) - mujoco_tips(hand, q - d) for d in step * np.eye(hand.nq)
        ]
        slope = np.stack(differences, axis=-1) / (2 * step)
        jacobian = hand.contact_jacobian(q, hand.fingertip_positions(q))
        np.testing.assert_allclose(jacobian, slope, rtol=0, atol=1e-8)
        assert np.abs(jacobian[:, :, 0]).max(axis=1).all(), "the wrist moves both fingers"


def test_a_mapping_gives_tips_an_offset(hand: HandModel) -> None:
    moved = HandModel.from_mjcf(hand.path, {"b2": (0, 0.002, 0.03), "a_tip": (0, 0, 0)})
    q = random_configurations(hand, 3, seed=2)
    order = [hand.joint_names.index(name) for name in moved.joint_names]
    np.testing.assert_allclose(
        moved.fingertip_positions(q[:, order]), hand.fingertip_positions(q)[:, ::-1], atol=1e-15
    )
    assert moved.joint_names == ("wrist", "b_flex", "a_roll", "a_flex", "a_slide")


def test_a_joint_without_a_master_is_held(tmp_path: Path) -> None:
    path = mjcf(tmp_path / "hand.xml", equality='<joint joint1="b_tied" polycoef="0.25 0 0 0 0"/>')
    hand = HandModel.from_mjcf(path, TIPS)
    assert "b_tied" not in hand.joint_names
    tied = HandModel.from_mjcf(mjcf(tmp_path / "free.xml", equality=""), TIPS)
    assert tied.joint_names[-1] == "b_tied"
    q = random_configurations(hand, 1, seed=3)[0]
    np.testing.assert_allclose(
        hand.fingertip_positions(q), tied.fingertip_positions([*q, 0.25]), atol=1e-15
    )


def test_a_finger_all_of_whose_joints_are_held_is_an_error(tmp_path: Path) -> None:
    held = "".join(f'<joint joint1="{name}"/>' for name in ("wrist", "b_flex", "b_tied"))
    with pytest.raises(HandModelError, match="every joint above the fingertip 'b_tip' is held"):
        HandModel.from_mjcf(mjcf(tmp_path / "hand.xml", equality=held), TIPS)


def test_a_master_may_be_on_no_finger(tmp_path: Path) -> None:
    path = mjcf(
        tmp_path / "hand.xml",
        equality='<joint joint1="b_tied" joint2="lamp" polycoef="0 2 0 0 0"/>',
    )
    hand = HandModel.from_mjcf(path, TIPS)
    assert hand.joint_names[-1] == "lamp"
    assert hand.moves[:, -1].tolist() == [False, True]
    assert "lamp" not in hand.ignored_joints


def test_a_coupling_elsewhere_in_the_scene_does_not_matter(tmp_path: Path) -> None:
    path = mjcf(
        tmp_path / "hand.xml", equality='<joint joint1="lamp" joint2="cart" polycoef="0 1 2 0 0"/>'
    )
    assert HandModel.from_mjcf(path, TIPS).ignored_joints == ("ball", "cart", "lamp")


def test_pickled_and_read_again(hand: HandModel) -> None:
    other = pickle.loads(pickle.dumps(hand))
    q = random_configurations(hand, 4, seed=4)
    assert other.joint_names == hand.joint_names
    assert (other.fingertip_positions(q) == hand.fingertip_positions(q)).all()


@pytest.mark.parametrize(
    "tips",
    [
        [],
        (),
        {},
        "a_tip",
        None,
        2,
        b"a_tip",
        np.zeros(()),
        [None],
        ["a_tip", 2],
        [["a_tip"]],
        {2: "x"},
    ],
)
def test_no_list_of_fingertips_is_an_error(hand: HandModel, tips: list[str]) -> None:
    with pytest.raises(HandModelError, match="expected a list of body or site names"):
        HandModel.from_mjcf(hand.path, tips)


@pytest.mark.parametrize("joints", [[], 3, np.zeros(()), "wrist", [None], [["wrist"]]])
def test_no_list_of_joints_is_an_error(hand: HandModel, joints: Any) -> None:
    with pytest.raises(HandModelError, match="joints is .*; expected joint names"):
        HandModel.from_mjcf(hand.path, ["a_tip", "b_tip"], joints=joints)


def test_an_unknown_fingertip_lists_the_known(hand: HandModel) -> None:
    with pytest.raises(UnknownName, match="unknown fingertip 'c_tip'.*a_tip.*b_tip"):
        HandModel.from_mjcf(hand.path, ["a_tip", "c_tip"])


def test_a_fingertip_named_twice_is_an_error(hand: HandModel) -> None:
    with pytest.raises(HandModelError, match="twice"):
        HandModel.from_mjcf(hand.path, ["a_tip", "a_tip"])


@pytest.mark.parametrize("offset", [(0, 0), "low", (0, 0, np.nan), np.zeros(3) + 1j])
def test_an_offset_that_is_no_point_is_an_error(hand: HandModel, offset: object) -> None:
    with pytest.raises(HandModelError, match="a_tip.*offset"):
        HandModel.from_mjcf(hand.path, {"a_tip": offset, "b_tip": (0, 0, 0)})  # type: ignore[dict-item]


def test_joint_order(hand: HandModel) -> None:
    order = ["b_flex", "a_slide", "a_flex", "a_roll", "wrist"]
    other = HandModel.from_mjcf(hand.path, TIPS, joints=order)
    assert other.joint_names == tuple(order)
    q = random_configurations(hand, 4, seed=5)
    np.testing.assert_allclose(
        other.fingertip_positions(q[:, ::-1]), hand.fingertip_positions(q), atol=1e-15
    )
    with pytest.raises(HandModelError, match="b_flex.*wrist, a_roll, a_flex, a_slide, b_flex"):
        HandModel.from_mjcf(hand.path, TIPS, joints=["b_flex"])


@pytest.mark.parametrize(
    ("body", "equality", "message"),
    [
        (
            BODY.replace(
                '<joint name="wrist" axis="0 1 0" range="-30 30" ref="10"/>',
                '<freejoint name="wrist"/>',
            ),
            TIE,
            "'wrist'.*'free'.*base must be fixed",
        ),
        (
            BODY.replace('name="b_flex" axis="1 0 0" ref="5"', 'name="b_flex" type="ball"'),
            "",
            "'b_flex'.*'ball'",
        ),
        (BODY, TIE.replace("0.1 0.7 0", "0.1 0.7 0.2"), "'b_tied'.*polynomial.*linear"),
        (BODY, TIE + '<joint joint1="b_flex" joint2="b_tied"/>', "follows itself"),
        (BODY.replace("</body>", "", 1), TIE, "cannot compile"),
        (BODY.replace('size="0.02"', 'size="-1"'), TIE, "cannot compile"),
    ],
)
def test_hands_that_cannot_be_are_refused(
    tmp_path: Path, body: str, equality: str, message: str
) -> None:
    with pytest.raises(HandModelError, match=message):
        HandModel.from_mjcf(mjcf(tmp_path / "hand.xml", body, equality), TIPS)


def test_a_fingertip_that_nothing_moves(tmp_path: Path) -> None:
    path = mjcf(tmp_path / "hand.xml", BODY + '<body name="post"><geom size="0.01"/></body>')
    with pytest.raises(HandModelError, match="no joint moves the fingertip 'post'"):
        HandModel.from_mjcf(path, ["a_tip", "post"])


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(HandModelError, match=r"absent\.xml: no such file"):
        HandModel.from_mjcf(tmp_path / "absent.xml", TIPS)


def test_a_hand_out_of_a_scene(menagerie: Path, tmp_path: Path) -> None:
    file = menagerie / "wonik_allegro" / "right_hand.xml"
    tips = ["ff_tip", "mf_tip", "rf_tip", "th_tip"]
    (tmp_path / "scene.xml").write_text(
        f"""<mujoco><include file="{file}"/><worldbody>
        <body><freejoint/><geom type="sphere" size="0.03"/></body>
        </worldbody></mujoco>"""
    )
    scene = HandModel.from_mjcf(tmp_path / "scene.xml", tips)
    alone = HandModel.from_mjcf(file, tips)
    assert scene.joint_names == alone.joint_names
    assert len(scene.ignored_joints) == 1  # the object's free joint
    q = random_configurations(alone, 5, seed=6)
    assert (scene.fingertip_positions(q) == alone.fingertip_positions(q)).all()
