"""Forward kinematics and contact Jacobians against MuJoCo, finite differences and by hand."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest

from dexctl.exceptions import InvalidInput
from dexctl.hand import HandModel, random_configurations


@pytest.fixture(params=["dex5", "four_fingers"])
def hand(request: pytest.FixtureRequest) -> HandModel:
    return request.getfixturevalue(request.param)


class MuJoCoWitness:
    """The same kinematics by MuJoCo: `mj_kinematics` and `mj_jac` on the hand's own file."""

    def __init__(self, hand: HandModel) -> None:
        self.hand = hand
        self.model = mujoco.MjModel.from_xml_path(str(hand.path))
        self.data = mujoco.MjData(self.model)
        joints = [self.model.joint(name) for name in hand.joint_names]
        self.qpos = [joint.qposadr[0] for joint in joints]
        self.dofs = [joint.dofadr[0] for joint in joints]
        self.bodies = [self.model.body(name).id for name in hand.fingertip_bodies]

    def at(self, q: np.ndarray) -> None:
        self.data.qpos[self.qpos] = q
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)

    def tips(self) -> np.ndarray:
        return np.array(
            [
                self.data.xpos[body] + self.data.xmat[body].reshape(3, 3) @ offset
                for body, offset in zip(self.bodies, self.hand.fingertip_offsets, strict=True)
            ]
        )

    def jacobian(self, points: np.ndarray) -> np.ndarray:
        rows = []
        for body, point in zip(self.bodies, points, strict=True):
            jacobian = np.zeros((3, self.model.nv))
            mujoco.mj_jac(self.model, self.data, jacobian, None, point, body)
            rows.append(jacobian[:, self.dofs])
        return np.array(rows)


def test_agrees_with_mujoco_over_random_configurations(hand: HandModel) -> None:
    witness = MuJoCoWitness(hand)
    rng = np.random.default_rng(0)
    for q in random_configurations(hand, 100, seed=0):
        witness.at(q)
        tips = witness.tips()
        np.testing.assert_allclose(hand.fingertip_positions(q), tips, rtol=0, atol=1e-9)
        points = tips + rng.uniform(-0.02, 0.02, tips.shape)
        np.testing.assert_allclose(
            hand.contact_jacobian(q, points), witness.jacobian(points), rtol=0, atol=1e-9
        )


def test_jacobian_agrees_with_finite_differences(hand: HandModel) -> None:
    step = 1e-6
    for q in random_configurations(hand, 100, seed=1):
        jacobian = hand.contact_jacobian(q, hand.fingertip_positions(q))
        # rows of the batch: q with one joint a step further, or back
        ahead = hand.fingertip_positions(q + step * np.eye(hand.nq))
        behind = hand.fingertip_positions(q - step * np.eye(hand.nq))
        slope = np.moveaxis((ahead - behind) / (2 * step), 0, -1)
        np.testing.assert_allclose(jacobian, slope, rtol=0, atol=1e-8)


def test_batch_equals_single_to_the_bit(hand: HandModel) -> None:
    q = random_configurations(hand, 12, seed=2).reshape(3, 4, hand.nq)
    points = hand.fingertip_positions(q) + 0.01
    batch = hand.contact_jacobian(q, points)
    assert batch.shape == (3, 4, hand.n_fingers, 3, hand.nq)
    for index in np.ndindex(3, 4):
        assert (hand.fingertip_positions(q[index]) == hand.fingertip_positions(q)[index]).all()
        np.testing.assert_allclose(
            hand.contact_jacobian(q[index], points[index]), batch[index], rtol=0, atol=1e-15
        )


def test_an_empty_batch_gives_empty_arrays(dex5: HandModel) -> None:
    assert dex5.fingertip_positions(np.zeros((0, 15))).shape == (0, 5, 3)


def test_dex5_by_hand(dex5: HandModel) -> None:
    # all joints at zero: fingers straight up, 0.02 + 0.075 + 0.075 m on a circle of 0.055 m
    angle = 2 * np.pi * np.arange(5) / 5
    up = np.stack([0.055 * np.cos(angle), 0.055 * np.sin(angle), np.full(5, 0.17)], axis=-1)
    np.testing.assert_allclose(dex5.fingertip_positions(np.zeros(15)), up, atol=1e-8)

    # finger 1: the roll axis is x through the base, so its tip, 0.17 m up, moves along -y
    jacobian = dex5.contact_jacobian(np.zeros(15), dex5.fingertip_positions(np.zeros(15)))
    np.testing.assert_allclose(jacobian[0, :, 0], [0, -0.17, 0], atol=1e-9)
    # flexions about y, 0.15 and 0.075 m below the tip: it moves along +x, outward
    np.testing.assert_allclose(jacobian[0, :, 1], [0.15, 0, 0], atol=1e-9)
    np.testing.assert_allclose(jacobian[0, :, 2], [0.075, 0, 0], atol=1e-9)
    # the other fingers' joints do not move it
    assert (jacobian[0, :, 3:] == 0).all()


def test_dex5_joints_and_limits(dex5: HandModel) -> None:
    assert (dex5.nq, dex5.n_fingers, dex5.shares_joints) == (15, 5, False)
    assert dex5.joint_names[:4] == ("f1_roll", "f1_flexion1", "f1_flexion2", "f2_roll")
    assert dex5.fingertip_names == ("f1_tip", "f2_tip", "f3_tip", "f4_tip", "f5_tip")
    np.testing.assert_allclose(dex5.lower[:3], [-0.7, -0.5, -2.2])
    np.testing.assert_allclose(dex5.upper[:3], [0.7, 1.4, 0.3])
    np.testing.assert_allclose(dex5.effort, 0.5)
    assert dex5.ignored_joints == ()
    assert (dex5.clip(np.full(15, 9.0)) == dex5.upper).all()
    assert "5 fingers, 15 joints" in repr(dex5)


@pytest.mark.parametrize("shape", [(14,), (), (2, 16)])
def test_a_wrong_number_of_joints_is_an_error(dex5: HandModel, shape: tuple[int, ...]) -> None:
    with pytest.raises(InvalidInput, match=r"expected \(\.\.\., 15\)"):
        dex5.fingertip_positions(np.zeros(shape))


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e7, -1e300, 1j])
def test_joints_that_cannot_be_are_refused_in_one_line(
    dex5: HandModel, batch: tuple[int, ...], value: complex
) -> None:
    q = np.zeros((*batch, dex5.nq), type(value))
    q[(*(-1 for _ in batch), 4)] = value
    points = np.zeros((*batch, 5, 3))
    at = " " if value == 1j else {(): " ", (3,): r"\[2\] ", (2, 3): r"\[1, 2\] "}[batch]
    for function in (
        dex5.configuration,
        dex5.fingertip_positions,
        lambda q: dex5.contact_jacobian(q, points),
    ):
        with pytest.raises(InvalidInput, match=f"^q{at}.*; expected ") as error:
            function(q)
        assert "\n" not in str(error.value) and len(str(error.value)) < 200
    with pytest.raises(InvalidInput, match="^contact_position is not an array of numbers"):
        dex5.contact_jacobian(np.zeros(q.shape), points + 1j)


@pytest.mark.parametrize("value", ["x", None, [1.0, 2.0], 1.0, [[1.0], [1.0, 2.0]], {}])
def test_what_is_no_joints_is_refused_in_one_line(dex5: HandModel, value: Any) -> None:
    angles: Any = value or []
    for function in (dex5.configuration, dex5.clip):
        with pytest.raises(InvalidInput, match="^q ") as error:
            function(value)
        assert "\n" not in str(error.value)
    with pytest.raises(InvalidInput, match="^angles is .*; expected angles by"):
        dex5.posture(angles)


def test_clip_takes_what_has_an_order(dex5: HandModel) -> None:
    for q in (np.full(15, np.nan), np.zeros(15) + 1j):
        with pytest.raises(InvalidInput, match="^q is"):
            dex5.clip(q)
    np.testing.assert_array_equal(dex5.clip(np.full((2, 15), np.inf)), [dex5.upper] * 2)
    np.testing.assert_array_equal(dex5.clip([-1e300] * 15), dex5.lower)


def test_contact_points_of_another_shape_are_an_error(dex5: HandModel) -> None:
    with pytest.raises(InvalidInput, match=r"\(4, 3\); expected \(5, 3\)"):
        dex5.contact_jacobian(np.zeros(15), np.zeros((4, 3)))
