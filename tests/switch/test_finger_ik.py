"""FingerIK: reaches what forward kinematics can reach, says so where it cannot."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest

import dexctl.hands
from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.hand import HandModel, random_configurations
from dexctl.switch.chain import own_joints
from dexctl.switch.finger_ik import FingerIK, _bounded


@pytest.fixture(scope="module", params=["dex5", "four_fingers"])
def ik(request) -> FingerIK:
    return FingerIK(request.getfixturevalue(request.param))


def test_reachable_targets_are_reached_within_limits(ik: FingerIK):
    hand = ik.hand
    starts, goals = (random_configurations(hand, 60, seed) for seed in (0, 1))
    for i, (start, goal) in enumerate(zip(starts, goals, strict=True)):
        finger = i % hand.n_fingers
        target = hand.fingertip_positions(goal)[finger]
        result = ik.solve(start, finger, target)
        reached = hand.fingertip_positions(result.q)[finger]
        assert result.converged, f"target {i}: {result.error} m after {result.iterations}"
        assert np.linalg.norm(reached - target) < 1e-4
        assert result.error == pytest.approx(np.linalg.norm(reached - target))
        assert (result.q >= hand.lower).all()
        assert (result.q <= hand.upper).all()
        others = np.delete(np.arange(hand.nq), own_joints(hand, finger))
        np.testing.assert_array_equal(result.q[others], start[others])


def test_unreachable_target_tells_the_distance(ik: FingerIK):
    """The far point lies straight beyond the fingertip of the stretched finger."""
    hand = ik.hand
    q = np.clip(np.zeros(hand.nq), hand.lower, hand.upper)
    along = [0.0, 0.0, 1.0] if hand.n_fingers == 5 else [1.0, 0.0, 0.0]
    away = hand.fingertip_positions(q)[0] + along
    result = ik.solve(q, 0, away)
    assert not result.converged
    reached = hand.fingertip_positions(result.q)[0]
    assert result.error == pytest.approx(np.linalg.norm(reached - away))
    best = hand.fingertip_positions(random_configurations(hand, 2000, 0))[:, 0]
    assert result.error <= np.linalg.norm(best - away, axis=-1).min() + 1e-3
    assert result.iterations <= 200


def test_where_the_first_start_gets_stuck_another_one_gets_there():
    """From a folded finger to one bent outward at its limit: the plain steps end elsewhere."""
    ik = FingerIK(dexctl.hands.load("dex5"))
    start, goal = np.zeros(15), np.zeros(15)
    start[3:6], goal[3:6] = [-0.26, 0.22, -0.96], [0.42, 1.19, 0.25]
    target = ik.hand.fingertip_positions(goal)[1]
    stuck = ik.solve(start, 1, target, max_iterations=25)
    assert not stuck.converged
    assert stuck.error > 1e-4
    result = ik.solve(start, 1, target)
    assert result.converged
    assert result.iterations > 25


def test_same_question_same_answer(ik: FingerIK):
    q, goal = random_configurations(ik.hand, 2, 5)
    target = ik.hand.fingertip_positions(goal)[0]
    first = ik.solve(q, 0, target)
    ik.solve(goal, 1, ik.hand.fingertip_positions(q)[1])
    np.testing.assert_array_equal(ik.solve(q, 0, target).q, first.q)


def test_pickles(ik: FingerIK):
    q, goal = random_configurations(ik.hand, 2, 6)
    target = ik.hand.fingertip_positions(goal)[0]
    copy = pickle.loads(pickle.dumps(ik))
    np.testing.assert_array_equal(copy.solve(q, 0, target).q, ik.solve(q, 0, target).q)


def test_start_outside_its_limits_is_brought_in_and_frozen_joints_may_stay_outside(ik: FingerIK):
    hand = ik.hand
    q = hand.upper + 0.05
    target = hand.fingertip_positions(random_configurations(hand, 1, 8)[0])[1]
    result = ik.solve(q, 1, target)
    own = own_joints(hand, 1)
    assert result.converged
    assert (result.q[own] <= hand.upper[own]).all()
    others = np.delete(np.arange(hand.nq), own)
    np.testing.assert_array_equal(result.q[others], q[others])


def test_target_already_met_costs_nothing(ik: FingerIK):
    q = random_configurations(ik.hand, 1, 4)[0]
    result = ik.solve(q, 0, ik.hand.fingertip_positions(q)[0])
    assert result.converged
    assert result.iterations == 0
    np.testing.assert_array_equal(result.q, q)


# A hand inside a scene: a free ball before it, a wrist, and a tip joint that follows the one below
# it (through another follower), with one finger whose joint order is given the other way round.
SCENE = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="ball" pos="0 0 0.3"><freejoint/><geom size="0.03"/></body>
    <body name="palm">
      <joint name="wrist" axis="0 0 1" range="-1 1"/><geom size="0.02"/>
      <body pos="0.05 0 0"><joint name="a" axis="1 0 0" range="-0.8 0.8"/><geom size="0.01"/>
        <body pos="0 0 0.03"><joint name="b" axis="0 1 0" range="-1 1.5"/><geom size="0.01"/>
          <body pos="0 0 0.04"><joint name="c" axis="0 1 0" range="-1 1.2"/><geom size="0.01"/>
            <body name="tip1" pos="0 0 0.03">
              <joint name="d" axis="0 1 0" range="-0.1 0.1"/><geom size="0.01"/></body>
      </body></body></body>
      <body pos="-0.05 0 0"><joint name="e" axis="0 1 0" range="-1 1"/><geom size="0.01"/>
        <body name="tip2" pos="0 0 0.05"><geom size="0.01"/></body></body>
    </body>
  </worldbody>
  <equality><joint joint1="d" joint2="c" polycoef="0.1 0.8 0 0 0"/></equality>
</mujoco>
"""


def test_scene_with_other_bodies_wrist_and_follower(tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text(SCENE)
    tips = {"tip1": [0.0, 0.005, 0.02], "tip2": [0.0, 0.0, 0.0]}
    hand = HandModel.from_mjcf(path, tips, joints=["e", "c", "wrist", "b", "a"])
    ik = FingerIK(hand)
    for start, goal in zip(
        *(random_configurations(hand, 20, seed) for seed in (0, 1)), strict=True
    ):
        goal[2] = start[2]  # the wrist is not the finger's to move
        result = ik.solve(start, 0, hand.fingertip_positions(goal)[0])
        assert result.converged
        np.testing.assert_array_equal(result.q[[0, 2]], start[[0, 2]])


def test_finger_without_joints_of_its_own(tmp_path):
    path = tmp_path / "fork.xml"
    path.write_text(
        '<mujoco><worldbody><body name="palm"><joint name="w1"/><joint name="w2" axis="1 0 0"/>'
        '<geom size="0.02"/>'
        '<body name="l" pos="0 0 0.1"/><body name="r" pos="0 0.1 0"/></body></worldbody></mujoco>'
    )
    ik = FingerIK(HandModel.from_mjcf(path, ["l", "r"]))
    with pytest.raises(InvalidInput, match="'r' has no joint of its own"):
        ik.solve([0.0, 0.0], 1, [0, 0, 0])


def test_bad_input(ik: FingerIK):
    q = np.zeros(ik.hand.nq)
    with pytest.raises(UnknownName, match="unknown finger 9"):
        ik.solve(q, 9, [0, 0, 0])
    with pytest.raises(InvalidInput, match="q is .*expected"):
        ik.solve(q[:3], 0, [0, 0, 0])
    with pytest.raises(InvalidInput, match="target_position is .*nan"):
        ik.solve(q, 0, [0, np.nan, 0])
    with pytest.raises(InvalidInput, match="tolerance is 0"):
        ik.solve(q, 0, [0, 0, 0], tolerance=0)
    with pytest.raises(InvalidInput, match="max_iterations is 0"):
        ik.solve(q, 0, [0, 0, 0], max_iterations=0)


RING = Path(__file__).resolve().parents[1] / "hands" / "ring.urdf"


def test_a_hand_from_a_urdf_is_moved_as_well():
    """No simulator reads the file: what swings go by is there for every hand."""
    hand = HandModel.from_urdf(RING, [f"f{i}_tip" for i in range(1, 6)])
    ik, (start, goal) = FingerIK(hand), random_configurations(hand, 2, 3)
    for finger, target in enumerate(hand.fingertip_positions(goal)):
        assert ik.solve(start, finger, target).converged


def test_a_step_is_the_least_within_its_bounds():
    """x'Hx/2 - b'x over a box: by its optimality conditions, some on bounds and some not."""
    rng = np.random.default_rng(0)
    held = 0
    for _ in range(200):
        root, linear = rng.normal(size=(4, 4)), rng.normal(size=4)
        hessian = root @ root.T + 0.1 * np.eye(4)
        lower, upper = -rng.uniform(0.0, 1.0, 4), rng.uniform(0.0, 1.0, 4)
        lower[0] = upper[0] = 0.0  # a joint without room
        x = _bounded(hessian, linear, lower, upper)
        slope = hessian @ x - linear
        assert ((lower <= x) & (x <= upper)).all()
        inside = (x > lower + 1e-9) & (x < upper - 1e-9)
        assert np.abs(slope[inside]).max(initial=0.0) < 1e-9
        assert (slope[(x <= lower + 1e-9) & (lower < upper)] > -1e-9).all()
        assert (slope[(x >= upper - 1e-9) & (lower < upper)] < 1e-9).all()
        held += 3 - inside.sum()
    assert 100 < held < 500
