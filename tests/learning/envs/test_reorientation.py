"""Goal orientations: reward and criteria by hand, which goals are drawn, and episodes of them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import pytest

import learning
from dexctl.exceptions import DexctlError
from dexctl.rotations import angle_between, from_rotation_vector, inverse, multiply, rotate
from dexctl.settings import from_plain
from dexctl.sim import SceneConfig, Simulation
from dexctl.streams import Streams
from learning.envs import EnvConfig, make_vector
from learning.envs.goals import CUBE, GOALS, draw
from learning.envs.reorientation import (
    Moved,
    Reorientation,
    ReorientationConfig,
    criteria,
    reward,
)
from learning.envs.task import Step
from learning.envs.tasks import TaskConfig

Z = np.array([0.0, 0.0, 1.0])
PARTS = ("q", "q_target", "touch", "goal_rotation")


def about(axis: np.ndarray, angle: float) -> np.ndarray:
    return from_rotation_vector(angle * np.asarray(axis, float))


def test_the_equation_case_by_case() -> None:
    """r = c max(min(Delta_t - Delta_{t-1}, eps), -eps) + c_success [success], with c < 0."""
    config = ReorientationConfig(distance_scale=-10.0, distance_clip=0.1, success_reward=7.0)
    nearer = np.array([0.05, -0.05, 0.3, -0.3, 0.05])
    still = np.zeros(5)
    moved = Moved(np.array([1.0, 1.0, 1.0, 1.0, 0.1]), nearer, still, still, still)
    success = np.asarray(criteria(moved, config).all(axis=-1))
    np.testing.assert_array_equal(success, [False, False, False, False, True])
    np.testing.assert_allclose(reward(moved, success, config), [0.5, -0.5, 1.0, -1.0, 7.5])


@pytest.mark.parametrize(
    ("name", "number"),
    [("distance", 0.2), ("joint_speed", 1.0), ("object_speed", 0.05), ("turning_speed", 0.5)],
)
def test_each_criterion_alone_fails(name: str, number: float) -> None:
    within = Moved(*(np.array(0.0),) * 5)
    config = ReorientationConfig()
    assert criteria(within, config).all()
    beyond = within._replace(**{name: np.array(number)})
    assert criteria(beyond, config).sum() == 3
    assert criteria(beyond._replace(**{name: np.array(0.99 * number)}), config).all()


def test_the_cube_has_24_orientations() -> None:
    """They are a group: each product is one of them, and they take the axes to the axes."""
    products = multiply(CUBE[:, None], CUBE[None])
    nearest = angle_between(products[:, :, None], CUBE).min(axis=-1)
    assert len(CUBE) == 24
    np.testing.assert_allclose(nearest, 0.0, atol=1e-7)
    axes = rotate(CUBE[:, None], np.broadcast_to(np.eye(3), (24, 3, 3)))
    assert len(np.unique(np.round(axes, 6).reshape(24, -1), axis=0)) == 24
    np.testing.assert_allclose(np.abs(axes).max(axis=-1), 1.0)


def test_what_is_drawn() -> None:
    count = 4000
    upright = np.tile(about(np.array([1.0, 2.0, 0.5]), 0.7), (count, 1))
    now = multiply(np.tile(about(Z, 1.1), (count, 1)), upright)
    every = np.ones(count, bool)

    def drawn(goals: Any) -> np.ndarray:
        return draw(
            goals, Streams(3, (count,)), every, now=now, upright=upright, axis=Z, least_angle=0.5
        )

    np.testing.assert_array_equal(drawn("root"), upright)
    yaw = multiply(drawn("yaw"), inverse(upright))
    np.testing.assert_allclose(yaw[:, 1:3], 0.0, atol=1e-12)
    assert angle_between(drawn("yaw"), now).min() >= 0.5 - 1e-9
    cube = multiply(inverse(upright), drawn("cube"))
    which = angle_between(cube[:, None], CUBE).argmin(axis=1)
    far = angle_between(multiply(upright[0], CUBE), now[0]) >= 0.5
    assert set(which) == set(np.flatnonzero(far))  # all of them, and none that is too near
    share = np.bincount(which, minlength=24)[far] / count
    np.testing.assert_allclose(share, 1.0 / far.sum(), atol=0.015)
    # of uniform turns, (angle - sin(angle)) / pi are within an angle
    angle = angle_between(drawn("uniform"), now)
    for limit in (0.8, 1.6, 2.4):
        assert (angle < limit).mean() == pytest.approx((limit - np.sin(limit)) / np.pi, abs=0.02)


def setting(**changes: Any) -> EnvConfig:
    usual = {"threads": 1, "goals": "yaw", "parts": PARTS, "disturbance": 0.0}
    return from_plain(EnvConfig, usual | changes)


def test_goals_follow_each_other() -> None:
    """Reached, held and missed goals of a hand that is placed where it is wanted."""
    config = from_plain(SceneConfig, {"threads": 1})
    asked = TaskConfig(
        goals="cube", reorientation=ReorientationConfig(goal_count=2, goal_seconds=0.2)
    )
    with Simulation(config, 3) as simulation:
        task, state = asked.build(simulation), simulation.state
        assert isinstance(task, Reorientation)
        nobody, everybody = np.zeros(3, bool), np.ones(3, bool)
        task.begin(everybody, state)
        assert state.object_position is not None
        assert state.object_quaternion is not None

        def judged(quaternion: np.ndarray, away: float = 0.0) -> Any:
            now = replace(state, object_quaternion=quaternion)
            start = state.object_position + np.array([0.0, 0.0, away])
            return task.judge(Step(now, np.zeros((3, 3)), everybody, start, nobody))

        first = task.goal.copy()
        start = state.object_quaternion
        there = np.where(np.array([[True], [False], [False]]), first, start)
        found = judged(there)
        np.testing.assert_array_equal(found.info["goal_reached"], [True, False, False])
        np.testing.assert_allclose(found.info["goal_time"], 0.05)
        # clipped progress, and the success
        np.testing.assert_allclose(found.reward, [22.0, 0.0, 0.0], atol=1e-6)
        assert not found.succeeded.any()
        assert (task.goal[0] != first[0]).any()  # the next is another: it is far enough away
        np.testing.assert_array_equal(task.goal[1:], first[1:])
        for _ in range(2):
            found = judged(there)
            assert not found.info["goal_missed"].any()
        found = judged(there)  # the fourth step of 0.05 s: the time of 0.2 s is over
        np.testing.assert_array_equal(found.info["goal_missed"], [False, True, True])
        found = judged(task.goal.copy())
        np.testing.assert_allclose(found.info["goal_time"], [0.2, 0.05, 0.05])
        np.testing.assert_array_equal(found.succeeded, [True, False, False])
        np.testing.assert_array_equal(found.info["goals"], [2, 1, 1])
        # an object that is lost reaches nothing
        found = judged(task.goal.copy(), away=0.06)
        assert found.dropped.all() and not found.info["goal_reached"].any()


def test_what_is_wanted_is_told() -> None:
    envs = make_vector(setting(parts=("goal_quaternion", "goal_rotation"), goals="uniform"), 4, 5)
    seen, _ = envs.reset(seed=5)
    state = envs.state
    assert state.goal_quaternion is not None
    assert state.object_quaternion is not None
    goal = np.where(state.goal_quaternion[:, :1] < 0, -state.goal_quaternion, state.goal_quaternion)
    np.testing.assert_allclose(seen[:, :4], goal, atol=1e-6)
    turn = multiply(state.goal_quaternion, inverse(state.object_quaternion))
    for i, axis in enumerate(np.eye(3)[:2]):
        columns = seen[:, 4 + 3 * i : 7 + 3 * i]
        np.testing.assert_allclose(columns, rotate(turn, np.tile(axis, (4, 1))), atol=1e-6)
    # a turn of hand and goal alike changes nothing but the frame
    turned = state.in_frame(np.zeros(3), about(Z, 0.8))
    assert turned.goal_quaternion is not None
    assert turned.object_quaternion is not None
    np.testing.assert_allclose(
        angle_between(turned.goal_quaternion, turned.object_quaternion),
        angle_between(state.goal_quaternion, state.object_quaternion),
    )
    envs.close()


@pytest.mark.parametrize("goals", GOALS)
def test_an_environment_of_a_batch_is_as_alone(goals: str) -> None:
    config = setting(goals=goals, goal_seconds=0.3)
    batch, alone = make_vector(config, 3, 11), make_vector(config, 1, 13)
    random = np.random.default_rng(0)
    for _ in range(12):  # beyond the time of a goal
        action = random.uniform(-1, 1, (3, batch.hand.nq))
        many, one = batch.step(action), alone.step(action[2:])
        for a, b in zip(many[:4], one[:4], strict=True):
            np.testing.assert_array_equal(a[2:], b)
        assert alone.task.with_goal(alone.state).goal_quaternion is not None
    batch.close()
    alone.close()


def test_saved_and_restored() -> None:
    envs = make_vector(setting(goals="uniform", goal_seconds=0.3), 2, 1)
    random = np.random.default_rng(0)
    actions = random.uniform(-1, 1, (20, 2, envs.hand.nq))
    for action in actions[:7]:
        envs.step(action)
    saved = envs.save()
    first = [envs.step(action)[:2] for action in actions[7:]]
    envs.restore(saved)
    for action, (seen, worth) in zip(actions[7:], first, strict=True):
        again = envs.step(action)
        np.testing.assert_array_equal(again[0], seen)
        np.testing.assert_array_equal(again[1], worth)
    envs.close()


def test_registered() -> None:
    single = gymnasium.make(learning.REORIENTATION, goals="uniform", threads=1)
    observation, _ = single.reset(seed=0)
    assert single.observation_space.contains(observation)
    _, _, _, _, info = single.step(np.zeros(single.action_space.shape))  # type: ignore[arg-type]
    assert {"distance", "goals", "goal_reached", "goal_missed", "goal_time"} <= set(info)
    single.close()
    many = gymnasium.make_vec(learning.REORIENTATION, num_envs=2, threads=1)
    assert many.reset(seed=0)[0].shape == (2, *observation.shape)
    many.close()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"goals": "sideways"}, "goals is 'sideways'"),
        ({"distance_scale": 1.0}, "distance_scale is 1.0; expected a finite number below 0"),
        ({"goal_angle": 0.0}, "goal_angle is 0.0"),
        ({"goal_count": 0}, "goal_count is 0"),
        ({"least_goal_angle": 2.0}, "least_goal_angle is 2.0; expected 0 to 1.5"),
        ({"parts": ("q",)}, "goals is 'yaw', and parts is q, which does not tell"),
        ({"goals": "none"}, "parts has goal_rotation, and goals is 'none'"),
        ({"parts": ("goal_angular_velocity",)}, "goals is 'yaw', where there is none"),
    ],
)
def test_bad_settings(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(DexctlError, match=message):
        setting(**changes)
