"""Distances by hand, brute force against the plain one, bounds, the frame of a tree."""

from __future__ import annotations

import numpy as np
import pytest

from dexctl.exceptions import InvalidInput
from dexctl.planning import Bounds, Frame, Metric, Nodes, Stability
from dexctl.planning.metric import Nearest


def turned(axis: list[float], angle: float) -> np.ndarray:
    return np.array([np.cos(angle / 2), *(np.sin(angle / 2) * np.array(axis))])


def node(quaternion: np.ndarray, rotation: float, position: tuple = (0.0, 0.0, 0.0)) -> Nodes:
    return Nodes(
        q=np.zeros((1, 2)), q_target=np.zeros((1, 2)), object_position=np.array([position]),
        object_quaternion=quaternion[None], joint_velocity=np.zeros((1, 2)),
        object_velocity=np.zeros((1, 6)), in_contact=np.ones((1, 3), bool),
        rotation=np.array([rotation]), cost=np.zeros(1),
    )  # fmt: skip


def test_tilt_is_the_lean_of_the_carried_axis_and_rotation_is_not() -> None:
    start = turned([0.0, 0.0, 1.0], 0.7)
    frame = Frame.of((0, 0, 1), node(start, 0.0))
    spun = turned([0.0, 0.0, 1.0], 0.7 + 2.9)
    np.testing.assert_allclose(frame.tilt(spun), 0.0, atol=1e-12)
    assert frame.rotation(spun, np.array(2.0)) == pytest.approx(2.9)
    assert frame.rotation(spun, np.array(8.0)) == pytest.approx(2.9 + 2 * np.pi)
    assert frame.rotation(start, np.array(-6.0)) == pytest.approx(-2 * np.pi)
    leaning = turned([1.0, 0.0, 0.0], 0.3)
    frame = Frame.of((0, 0, 1), node(np.array([1.0, 0.0, 0.0, 0.0]), 0.0))
    tilt = frame.tilt(leaning)
    assert np.linalg.norm(tilt) == pytest.approx(0.3)
    np.testing.assert_allclose(tilt @ frame.across, [0, -0.3, 0], atol=1e-12)
    for over in (np.pi, np.pi - 1e-6):  # exactly upside down is as far as can be, not upright
        tilt = frame.tilt(turned([1.0, 0.0, 0.0], over))
        assert np.linalg.norm(tilt) == pytest.approx(over, abs=1e-5)
    np.testing.assert_allclose(frame.across @ frame.across.T, np.eye(2), atol=1e-12)


def test_a_full_turn_is_far_from_the_root() -> None:
    root = node(np.array([1.0, 0.0, 0.0, 0.0]), 0.0)
    frame = Frame.of("z", root)
    around = node(np.array([1.0, 0.0, 0.0, 0.0]), 2 * np.pi, (0.01, 0.0, 0.0))
    metric = Metric()
    apart = metric.of(frame, around) - metric.of(frame, root)
    assert np.linalg.norm(apart) == pytest.approx(np.hypot(2 * np.pi, 0.1), rel=1e-6)
    with pytest.raises(InvalidInput, match="all weights of the metric are 0"):
        Metric(joints=0, position=0, tilt=0, rotation=0)
    with pytest.raises(InvalidInput, match="tilt is -1"):
        Metric(tilt=-1)


def test_nearest_is_the_nearest() -> None:
    rng = np.random.default_rng(0)
    search = Nearest(6)
    points = rng.normal(size=(9000, 6)).astype(np.float32)
    for part in np.array_split(points, 7):
        search.add(part)
    targets = rng.normal(size=(50, 6)).astype(np.float32)
    plain = np.linalg.norm(points[None] - targets[:, None], axis=-1).argmin(axis=1)
    assert len(search) == 9000
    np.testing.assert_array_equal(search(targets), plain)


def test_bounds() -> None:
    frame = Frame.of("z", node(np.array([1.0, 0.0, 0.0, 0.0]), 0.0))
    bounds = Bounds(displacement=0.02, tilt=0.4, rotation=(-0.5, 7.0))
    still = np.array([1.0, 0.0, 0.0, 0.0])
    for quaternion, rotation, position, inside in (
        (still, 0.0, (0.0, 0.0, 0.0), True),
        (still, 0.0, (0.0, 0.021, 0.0), False),
        (turned([1.0, 0.0, 0.0], 0.39), 0.0, (0.0, 0.0, 0.0), True),
        (turned([1.0, 0.0, 0.0], 0.41), 0.0, (0.0, 0.0, 0.0), False),
        (still, -0.6, (0.0, 0.0, 0.0), False),
        (still, 6.9, (0.0, 0.0, 0.0), True),
        (still, 0.0, (np.nan, 0.0, 0.0), False),
    ):
        assert bounds.hold(frame, node(quaternion, rotation, position))[0] == inside
    rng, metric = np.random.default_rng(0), Metric()
    limits = (np.full(2, -0.1), np.full(2, 0.3))
    drawn = bounds.targets(frame, metric, np.zeros(2), limits, rng, 500)
    assert drawn.shape == (500, 8)
    joints = drawn[:, :2] / metric.joints
    assert joints.min() >= -0.1001 and joints.max() <= 0.3001
    assert np.linalg.norm(drawn[:, 2:5], axis=1).max() <= 0.2 + 1e-6
    assert 0 <= drawn[:, 7].min() < 0.1 and 6.9 < drawn[:, 7].max() <= 7.0
    with pytest.raises(InvalidInput, match=r"rotation is \(1, 2\)"):
        Bounds(rotation=(1, 2))
    with pytest.raises(InvalidInput, match="fingertips_only is 1; expected a bool"):
        Stability(fingertips_only=1)  # type: ignore[arg-type]
