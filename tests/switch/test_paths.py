"""Joint paths of a swing: from the optimiser and from inverse kinematics."""

from __future__ import annotations

import copy
import pickle
from pathlib import Path

import numpy as np
import pytest

from dexctl import HandModel
from dexctl.switch.chain import own_joints
from dexctl.switch.landing import Landing, turned
from dexctl.switch.paths import JointPath, SwingPaths

Z = np.array([0.0, 0.0, 1.0])
RING = Path(__file__).resolve().parents[1] / "hands" / "ring.urdf"
CLEARANCE, RADIUS = 0.015, 0.014
FINGER = 2


@pytest.fixture
def q(dex5: HandModel) -> np.ndarray:
    return np.tile([0.0, 0.4, -0.8], 5)


@pytest.fixture
def paths(dex5: HandModel) -> SwingPaths:
    return SwingPaths(dex5, Z, CLEARANCE, speed=0.2)


def swing(hand: HandModel, q: np.ndarray, angle: float) -> tuple[np.ndarray, np.ndarray, Landing]:
    """Tip, inward normal, and where the tip would be ``angle`` further round the axis."""
    tip = hand.fingertip_positions(q)[FINGER]
    outward = tip * [1, 1, 0] / np.linalg.norm(tip[:2])
    there = turned(outward, angle, Z)
    radius = np.linalg.norm(tip[:2])
    return tip, -outward, Landing(np.array([0, 0, tip[2]]) + radius * there, -there)


def tips(hand: HandModel, q: np.ndarray, path: JointPath, times: np.ndarray) -> np.ndarray:
    rows = np.tile(q, (len(times), 1))
    rows[:, path.joints] = [path.at(time) for time in times]
    return hand.fingertip_positions(rows)[:, FINGER]


def test_straight_between_knots_and_held_outside():
    path = JointPath(
        np.array([3, 4]), np.array([0.0, 1.0, 3.0]), np.array([[0, 0], [1, -2], [5, 0]])
    )
    np.testing.assert_allclose(path.at(0.5), [0.5, -1.0])
    np.testing.assert_allclose(path.at(2.0), [3.0, -1.0])
    np.testing.assert_allclose(path.at(-1.0), [0.0, 0.0])
    np.testing.assert_allclose(path.at(9.0), [5.0, 0.0])


@pytest.mark.parametrize("angle", [-0.4, 0.3])
def test_a_planned_swing_keeps_clear_of_both_planes(dex5, q, paths, angle):
    tip, normal, landing = swing(dex5, q, angle)
    path = paths.planned(q, FINGER, tip, tip + RADIUS * normal, normal, landing)
    assert path is not None
    np.testing.assert_array_equal(path.joints, own_joints(dex5, FINGER))
    np.testing.assert_allclose(path.at(0.0), q[path.joints], atol=1e-6)
    line = tips(dex5, q, path, np.linspace(0, path.time[-1], 60))
    # the gap of the fingertip to the plane that it left, and to the plane where it lands
    leave = -(line - tip) @ normal
    land = -(line - landing.tip) @ landing.normal
    assert leave.min() > -1e-3 and land[30:].min() > 0.4 * CLEARANCE - 1e-3
    middle = slice(27, 33)
    assert leave[middle].min() > CLEARANCE - 1e-3 and land[middle].min() > CLEARANCE - 1e-3
    # ends just above touch, in front of the landing
    above = landing.tip - 0.4 * CLEARANCE * landing.normal
    np.testing.assert_allclose(line[-1], above, atol=2e-3)


def test_no_plan_for_a_landing_out_of_reach(dex5, q, paths):
    tip, normal, landing = swing(dex5, q, 0.3)
    far = Landing(landing.tip + np.array([0.0, 0.0, 1.0]), landing.normal)
    assert paths.planned(q, FINGER, tip, tip + RADIUS * normal, normal, far) is None


@pytest.mark.parametrize("angle", [0.6, -0.6])
def test_a_far_path_goes_round_the_axis(dex5, q, paths, angle):
    tip, _, landing = swing(dex5, q, angle)
    goal = landing.tip - CLEARANCE * landing.normal
    origin = np.array([0.0, 0.0, 0.13])
    path = paths.far(q, FINGER, tip, goal, origin, 0.0)
    assert path is not None
    np.testing.assert_allclose(path.at(0.0), q[path.joints])
    knots = tips(dex5, q, path, path.time)
    np.testing.assert_allclose(knots[-1], goal, atol=5e-4)
    radius = np.linalg.norm(knots[1:, :2], axis=-1)
    assert radius.min() > np.linalg.norm(goal[:2]) - 1e-3
    speed = np.linalg.norm(np.diff(knots, axis=0), axis=-1) / np.diff(path.time)
    np.testing.assert_allclose(speed, 0.2, rtol=0.02)
    lower, upper = dex5.lower[path.joints], dex5.upper[path.joints]
    assert (path.q >= lower - 1e-9).all() and (path.q <= upper + 1e-9).all()


def test_no_far_path_out_of_reach(dex5, q, paths):
    tip, _, landing = swing(dex5, q, 0.3)
    assert paths.far(q, FINGER, tip, landing.tip * 5.0, np.zeros(3), 0.0) is None


def test_paths_are_the_same_every_time(dex5, q, paths):
    tip, normal, landing = swing(dex5, q, 0.3)
    found = []
    for one in (paths, paths, copy.deepcopy(paths), pickle.loads(pickle.dumps(paths))):
        plan = one.planned(q, FINGER, tip, tip + RADIUS * normal, normal, landing)
        goal = landing.tip - CLEARANCE * landing.normal
        far = one.far(q, FINGER, tip, goal, np.zeros(3), 0.0)
        assert plan is not None and far is not None
        found.append(np.concatenate([plan.q, far.q]))
    for other in found[1:]:
        np.testing.assert_array_equal(other, found[0])


def test_a_hand_from_a_urdf_swings_as_well():
    """By either way; the gait of such a hand ended amid a run where a swing was a far one."""
    hand = HandModel.from_urdf(RING, [f"f{i}_tip" for i in range(1, 6)])
    bent = np.tile([0.0, 0.4, -0.8], 5)
    tip = hand.fingertip_positions(bent)[FINGER]
    axis = np.array([1.0, 0.0, 0.0])  # its palm looks along x
    outward = tip * [0, 1, 1] / np.linalg.norm(tip[1:])
    there = turned(outward, 0.3, axis)
    goal = Landing(tip * [1, 0, 0] + np.linalg.norm(tip[1:]) * there, -there)
    paths = SwingPaths(hand, axis, CLEARANCE, speed=0.2)
    before = goal.tip - CLEARANCE * goal.normal
    far = paths.far(bent, FINGER, tip, before, np.array([0.13, 0.0, 0.0]), 0.0)
    assert far is not None
    np.testing.assert_allclose(tips(hand, bent, far, far.time)[-1], before, atol=5e-4)
    planned = paths.planned(bent, FINGER, tip, tip - RADIUS * outward, -outward, goal)
    assert planned is not None
