"""Goal orientations: yaw and tilt are reached by a kinematic tree, what cannot be is said."""

from __future__ import annotations

import numpy as np
import pytest

from dexctl.exceptions import InvalidInput
from dexctl.planning import Bounds, Frame, GoalOrientations, Kinematic, Metric, grow, holding
from dexctl.planning.nodes import root_of
from dexctl.rotations import angle_between, from_rotation_vector, multiply
from dexctl.sim import Scene


@pytest.fixture(scope="module")
def cube() -> Scene:
    return Scene.build("dex5", "cube", "up")


def turned(cube: Scene, *vectors: tuple[float, float, float]) -> tuple:
    """The cube's settled orientation, turned by each rotation vector."""
    root = root_of(cube).object_quaternion[0]
    return tuple(
        tuple(multiply(from_rotation_vector(np.array(vector)), root).tolist()) for vector in vectors
    )


def test_yaw_both_ways_and_tilt_are_reached(cube: Scene) -> None:
    wanted = turned(cube, (0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (0.55, 0.0, 0.0))
    goals = GoalOrientations(orientations=wanted, angle=0.1)
    tree = grow(cube, Kinematic(batch=64), goals=goals, nodes=8000, seed=0, threads=1)
    assert len(tree) < 8000
    assert (goals.away(tree.nodes.object_quaternion) <= 0.1).all()
    paths = tree.paths(3, goal_quaternion=wanted)
    ends = [path[-1] for path in paths]
    assert all((tree.parent[path[1:]] == path[:-1]).all() for path in paths)
    reached = tree.nodes.object_quaternion[ends]
    assert (angle_between(reached, goals.quaternion) <= 0.1).all()
    np.testing.assert_allclose(tree.rotation[ends], [1.0, -1.0, 0.0], atol=0.12)
    lean = np.linalg.norm(tree.frame.tilt(reached), axis=1)
    assert lean[2] > Bounds().tilt  # further than trees lean that have no goals
    assert holding(cube, tree, ends, threads=1).all()
    assert tree.header.settings["bounds"]["tilt"] == pytest.approx(0.85)
    # one orientation, several paths: each ends elsewhere, nearest first
    many = [path[-1] for path in tree.paths(4, goal_quaternion=wanted[0])]
    left = angle_between(tree.nodes.object_quaternion[many], goals.quaternion[0])
    assert len(set(many)) == 4 and (np.diff(left) >= 0).all()
    beyond = turned(cube, (2.0, 0.0, 0.0))[0]
    with pytest.raises(InvalidInput, match=r"is 1\.\d\d rad from the nearest of \d+ nodes"):
        tree.paths(1, goal_quaternion=beyond)
    with pytest.raises(InvalidInput, match=r"has shape \(3, 4\); expected \(4,\) or \(2, 4\)"):
        tree.paths(2, goal_quaternion=wanted)
    with pytest.raises(InvalidInput, match="both given"):
        tree.paths(1, 0.5, goal_quaternion=wanted[0])


def test_targets_are_goals_or_on_the_way(cube: Scene) -> None:
    root = root_of(cube)
    frame, metric, rng = Frame.of("z", root), Metric(), np.random.default_rng(0)
    goals = GoalOrientations(orientations=turned(cube, (0.0, 0.0, -1.2)), share=0.5, margin=0.2)
    bounds = goals.widened(Bounds(), frame)
    assert bounds.rotation == (pytest.approx(-1.4), 7.0) and bounds.tilt == Bounds().tilt
    limits = (np.asarray(cube.lower), np.asarray(cube.upper))
    targets = bounds.targets(frame, metric, root.q[0], limits, rng, 400)
    drawn = goals.drawn(frame, metric, targets, rng)
    at_goal = np.abs(drawn[:, -6:] - [0, 0, 0, 0, 0, -1.2]).max(axis=1) < 1e-6
    assert 0.4 < at_goal.mean() < 0.6
    assert -1.4 <= drawn[:, -1].min() < -1.3 and 0.1 < drawn[:, -1].max() <= 0.2
    np.testing.assert_array_equal(drawn[:, :-6], targets[:, :-6])
    nothing = GoalOrientations()
    assert nothing.widened(bounds, frame) is bounds
    assert nothing.drawn(frame, metric, targets, rng) is targets


def test_goals_that_are_refused(cube: Scene) -> None:
    for wrong in ((1.0, 1.0, 0.0, 0.0), (np.nan, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0)):
        with pytest.raises(InvalidInput, match=r"a goal is \(.*\); expected a unit quaternion"):
            GoalOrientations(orientations=(wrong,))  # type: ignore[arg-type]
    with pytest.raises(InvalidInput, match="angle is 0"):
        GoalOrientations(angle=0)
    over = GoalOrientations(orientations=turned(cube, (np.pi, 0.0, 0.0)))
    with pytest.raises(InvalidInput, match=r"leans 3\.1\d rad from the axis \(0\.0, 0\.0, 1\.0\)"):
        grow(cube, Kinematic(), goals=over)
