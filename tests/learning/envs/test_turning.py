"""Reward, tilt and rotation: hand-computed numbers, and properties."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexctl.exceptions import DexctlError
from dexctl.rotations import from_rotation_vector, multiply, shortest, twist_angle
from dexctl.settings import from_plain
from dexctl.sim import SceneConfig, Simulation
from dexctl.state import GraspState
from learning.envs import EnvConfig
from learning.envs.task import Step
from learning.envs.tasks import TaskConfig
from learning.envs.turning import (
    Motion,
    Turning,
    TurningConfig,
    reward,
    tilt,
)

Z = np.array([0.0, 0.0, 1.0])
ONE = np.array([1.0, 0.0, 0.0, 0.0])


def about(axis: np.ndarray, angle: float) -> np.ndarray:
    return np.array([np.cos(angle / 2), *(np.sin(angle / 2) * np.asarray(axis))])


def test_the_equation_case_by_case() -> None:
    motion = Motion(
        speed=np.array([0.3, 0.9, -0.2, 0.3, 0.3, 0.3, -0.2]),
        tilt=np.array([0.0, 0.5, 0.0, 0.51, 0.0, 0.0, 0.6]),
        fingertips=np.array([3, 5, 4, 5, 2, 4, 1]),
        fingertips_only=np.array([True, True, True, True, True, False, False]),
        away=np.array([0.0, 0.0, 0.01, 0.01, 0.0, 0.02, 0.0]),
        dropped=np.array([False, True, False, True, False, False, False]),
    )
    expected = np.array([0.3, 0.5, -0.2, 0.0, 0.0, 0.0, -0.2])
    np.testing.assert_array_equal(reward(motion, TurningConfig()), expected)

    links = reward(motion, TurningConfig(only_fingertips=False))
    np.testing.assert_array_equal(links, [0.3, 0.5, -0.2, 0.0, 0.0, 0.3, -0.2])
    told = TurningConfig(keep_speed=True)
    commanded = reward(motion, told, np.full(motion.speed.shape, 0.4))
    np.testing.assert_array_equal(commanded, reward(motion, TurningConfig(wanted_speed=0.4)))
    kept = reward(motion, TurningConfig(wanted_speed=0.4))  # 0.9 is 0.5 too fast
    assert kept == pytest.approx([0.3, -0.1, -0.2, 0, 0, 0, -0.2])


def test_tilt_by_hand() -> None:
    x = np.array([1.0, 0.0, 0.0])
    assert tilt(about(x, 0.4), ONE, Z) == pytest.approx(0.4)
    assert tilt(about(Z, 2.0), ONE, Z) == pytest.approx(0.0, abs=1e-7)
    assert tilt(about(Z, 2.0), about(Z, 0.7), x) == pytest.approx(1.3)
    both = multiply(about(x, 0.3), about(Z, 1.0))  # turned, then tilted
    assert tilt(both, ONE, Z) == pytest.approx(0.3)


@given(
    st.floats(-3, 3),
    st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1),
    st.floats(0, 1.2),
)
def test_tilting_alone_is_no_rotation(
    angle: float, direction: tuple[float, float, float], lean: float
) -> None:
    axis = np.array(direction) / np.linalg.norm(direction)
    sideways = np.cross(axis, [0.3, 0.5, 0.8])
    if np.linalg.norm(sideways) < 1e-3:
        return
    sideways /= np.linalg.norm(sideways)
    quaternion = multiply(about(sideways, lean), about(axis, angle))
    assert shortest(twist_angle(quaternion, axis) - angle) == pytest.approx(0.0, abs=1e-9)
    assert tilt(quaternion, ONE, axis) == pytest.approx(lean, abs=1e-6)


def test_rotation_is_unwrapped_over_many_turns() -> None:
    config = from_plain(SceneConfig, {"object": "cylinder", "threads": 1})
    with Simulation(config, 2) as simulation:
        task, state = TaskConfig().build(simulation), simulation.state
    assert isinstance(task, Turning)
    start = about(Z, 0.4)

    def at(*quaternions: np.ndarray) -> GraspState:
        return replace(state, object_quaternion=np.array(quaternions))

    task.begin(np.array([True, True]), at(start, start))
    step = 1.3
    for k in range(1, 21):  # four turns forwards, four back; quaternions of either sign
        sign = 1 if k % 2 else -1
        now = at(about(Z, 0.4 + step * k), sign * about(Z, 0.4 - step * k))
        position, nobody = now.object_position, np.zeros(2, bool)
        assert position is not None
        found = task.judge(Step(now, np.zeros((2, 3)), ~nobody, position, nobody))
        assert not found.dropped.any() and not found.succeeded.any()
    np.testing.assert_allclose(found.info["rotation"], [26.0, -26.0])
    task.begin(np.array([True, False]), at(start, start))
    np.testing.assert_allclose(task.rotation, [0.0, -26.0])


def test_commands_change_the_axis() -> None:
    """Speed, tilt and rotation are about the axis commanded now; the policy sees it."""
    scene = from_plain(SceneConfig, {"object": "cylinder", "threads": 1})
    names = ("x", "-z", "any")
    turning = TurningConfig(commands=names, command_seconds=0.2, command_speed_range=(0.1, 0.3))
    with Simulation(scene, 300) as simulation:
        task, state = TaskConfig(turning=turning).build(simulation), simulation.state
        assert isinstance(task, Turning)
        everybody, nobody = np.ones(300, bool), np.zeros(300, bool)
        task.begin(everybody, state)
        told = task.with_goal(state).goal_angular_velocity
        assert told is not None
        np.testing.assert_allclose(np.linalg.norm(told, axis=1), task.speed)
        assert 0.1 <= task.speed.min() < 0.12 and 0.28 < task.speed.max() <= 0.3
        share = [(told / task.speed[:, None] @ axis > 1 - 1e-9).mean() for axis in ([1, 0, 0], -Z)]
        np.testing.assert_allclose(share, 1 / 3, atol=0.1)
        assert state.object_quaternion is not None
        assert state.object_position is not None
        # an episode may begin on another face of the object than the settled one
        now = multiply(about(np.array([1.0, 0.0, 0.0]), 1.2), state.object_quaternion)
        task.begin(everybody, replace(state, object_quaternion=now))
        for _ in range(4):  # until the next command: 1 rad/s about the axis, worth the speed wanted
            now = multiply(from_rotation_vector(0.05 * task.axis), now)
            step = Step(
                replace(state, object_quaternion=now, in_contact=np.ones((300, 5), bool)),
                task.axis.copy(), everybody, state.object_position, nobody,
            )  # fmt: skip
            before = task.axis.copy(), task.speed.copy()
            found = task.judge(step)
            np.testing.assert_allclose(found.reward, before[1])
            np.testing.assert_allclose(found.info["speed"], 1.0)
            np.testing.assert_allclose(found.info["tilt"], 0.0, atol=1e-6)
        np.testing.assert_allclose(found.info["rotation"], 0.2)
        assert (task.axis != before[0]).any(axis=1).mean() > 0.5  # new ones are drawn
        found = task.judge(step._replace(angular_velocity=np.zeros((300, 3))))
        # from where the object was then: its tilt is gone, its rotation is kept
        np.testing.assert_allclose(found.info["rotation"], 0.2, atol=1e-9)
        np.testing.assert_allclose(found.info["tilt"], 0.0, atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"commands": ("up",)}, "command 'up'"),
        ({"commands": ("x",)}, "does not tell what is wanted; expected goal_angular_velocity"),
        ({"command_speed_range": (0.5, 0.1)}, r"command_speed_range is \(0.5, 0.1\)"),
        ({"command_seconds": 0.0}, "command_seconds is 0.0"),
    ],
)
def test_bad_commands(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(DexctlError, match=message):
        from_plain(EnvConfig, changes)


@pytest.mark.parametrize("value", [0.5, (0.5,), "ab"])
def test_speeds_that_are_told_are_two(value: Any) -> None:
    with pytest.raises(DexctlError, match="command_speed_range is .*; expected two finite"):
        TurningConfig(command_speed_range=value)


def test_speed_is_measured_at_control_rate() -> None:
    """The speed in info is the pose difference over one control step."""
    from dexctl import controllers
    from dexctl.rotations import inverse, rotation_vector
    from learning.envs import EnvConfig, make_vector

    axis = np.array([0.0, 0.6, 0.8])
    envs = make_vector(
        from_plain(EnvConfig, {"object": "cylinder", "axis": (0.0, 3.0, 4.0), "threads": 1}),
        2,
        seed=0,
    )
    igm = controllers.make("igm", envs.hand)
    for _ in range(5):
        before = envs.state.object_quaternion
        _, rewards, _, _, info = envs.step(envs.change_to_action(igm.act(envs.state)))
        after = envs.state.object_quaternion
        assert before is not None
        assert after is not None
        expected = rotation_vector(multiply(after, inverse(before))) @ axis / 0.05
        np.testing.assert_allclose(info["speed"], expected, atol=1e-12)
        assert info["fingertips_only"].all()
        np.testing.assert_allclose(rewards, np.minimum(expected, 0.5), atol=1e-12)
