"""Reorientation: the object is to be brought to one goal orientation after another (chapter 5)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from dexctl.exceptions import InvalidInput
from dexctl.rotations import angle_between, inverse, multiply, shortest, twist_angle
from dexctl.state import Bools, Floats, GraspState
from dexctl.validation import check_numbers, check_whole
from learning.envs.goals import Goals, draw
from learning.envs.holding import HoldingConfig, distance_from_start
from learning.envs.task import Judgement, Step, Task
from learning.envs.turning import uprights

if TYPE_CHECKING:
    from dexctl.sim import Simulation


@dataclass(frozen=True, kw_only=True)
class ReorientationConfig:
    """What reaching goal orientations is worth, and when one is reached.

    The thesis gives the reward and the four criteria (chapter 5, eq. reward_ar) without their
    numbers: these are ours. One control step is worth what it brought the object nearer to the
    goal, in rad/s with a control period of 0.05 s, so that it compares with `TurningConfig`'s.

    Raises:
        InvalidInput: a setting is wrong; the message names it.
    """

    distance_scale: float = -20.0
    """Reward of each radian that the object comes further from the goal; below 0 (c)."""
    distance_clip: float = 0.1
    """A control step counts as no more than so much nearer or further [rad] (epsilon)."""
    success_reward: float = 20.0
    """Reward of a goal that is reached (c_success)."""
    goal_angle: float = 0.2
    """A goal is reached within this angle [rad] (theta_thresh), ..."""
    success_joint_speed: float = 1.0
    """... with joints slower than this, as the norm over all of them [rad/s] (q_thresh), ..."""
    success_object_speed: float = 0.05
    """... the object slower than this [m/s] (x_thresh), ..."""
    success_turning_speed: float = 0.5
    """... and turning slower than this [rad/s] (omega_thresh); speeds are means over a control
    step."""
    goal_count: int = 20
    """The episode ends, as a success, when so many goals have been reached, each drawn when the one
    before was; in the thesis 1. With the goal root it is 1: there is no other goal to go on to."""
    goal_seconds: float = 30.0
    """Time for each goal; then it is missed, and the next one drawn [s]."""
    least_goal_angle: float = 0.5
    """Goals of yaw and cube are drawn at least so far from where the object is [rad]."""

    def __post_init__(self) -> None:
        check_numbers(
            self,
            positive=(
                "distance_clip",
                "goal_angle",
                "success_joint_speed",
                "success_object_speed",
                "success_turning_speed",
                "goal_seconds",
            ),
            not_negative=("success_reward", "least_goal_angle"),
        )
        check_whole(self, goal_count=1)
        if not -np.inf < self.distance_scale < 0:
            raise InvalidInput(
                f"distance_scale is {self.distance_scale!r}; expected a finite number below 0: the "
                "distance to the goal is to fall"
            )
        if self.least_goal_angle > 1.5:
            raise InvalidInput(
                f"least_goal_angle is {self.least_goal_angle}; expected 0 to 1.5: some goals of a "
                "cube are a quarter turn away"
            )


class Moved(NamedTuple):
    """What a control step did; arrays are ``(...)``.

    Attributes:
        distance: angle to the goal now (Delta_t) [rad].
        nearer: how much smaller it has become [rad].
        joint_speed: norm of the joints' velocities, mean over the step [rad/s].
        object_speed: of the object's centre [m/s].
        turning_speed: of the object [rad/s].
    """

    distance: Floats
    nearer: Floats
    joint_speed: Floats
    object_speed: Floats
    turning_speed: Floats


def criteria(moved: Moved, config: ReorientationConfig) -> Bools:
    """Whether each of the four criteria of success holds, ``(..., 4)`` (thesis, chapter 5).

    In the thesis's order: orientation, joints' speed, object's speed, object's angular velocity.
    """
    return np.stack(
        [
            moved.distance < config.goal_angle,
            moved.joint_speed < config.success_joint_speed,
            moved.object_speed < config.success_object_speed,
            moved.turning_speed < config.success_turning_speed,
        ],
        axis=-1,
    )


def reward(moved: Moved, success: Bools, config: ReorientationConfig) -> Floats:
    """The reward of one control step ``(...)`` (thesis, chapter 5, eq. reward_ar).

    r = c max(min(Delta_t - Delta_{t-1}, epsilon), -epsilon) + c_success [success], with c < 0.
    """
    clipped = np.clip(-moved.nearer, -config.distance_clip, config.distance_clip)
    return config.distance_scale * clipped + config.success_reward * success


class Reorientation(Task):
    """The object is brought to one goal orientation after another; dropped, the episode ends.

    Args:
        config: what it is worth.
        goals: which orientations are asked for.
        simulation: the environments'.
        axis: that goals of "yaw" are turned about, unit ``(3,)``.
        holding: when an object is lost, and what holding it badly costs.

    Attributes:
        goal: the orientation wanted, ``(N, 4)`` wxyz.
        reached: goals reached in the episode, ``(N,)``.
        rotation: unwrapped turn about the axis since the start, ``(N,)`` [rad].
    """

    def __init__(
        self,
        config: ReorientationConfig,
        goals: Goals,
        simulation: Simulation,
        *,
        axis: Floats,
        holding: HoldingConfig,
    ) -> None:
        if goals == "root":
            config = replace(config, goal_count=1)
        self.config = config
        self.goals: Goals = goals
        self._simulation, self._axis, self._holding = simulation, axis, holding
        count = simulation.num_envs
        self._upright = uprights(simulation)
        self.goal = self._upright.copy()
        self.reached = np.zeros(count, np.int64)
        self._distance = np.zeros(count)
        self._since = np.zeros(count, np.int64)  # steps since the goal was given
        self.rotation = np.zeros(count)
        self._angle = np.zeros(count)  # of the twist since the start, not unwrapped
        state = simulation.state
        assert state.object_position is not None
        assert state.object_quaternion is not None
        self._start = state.object_quaternion.copy()
        self._q, self._position = state.q.copy(), state.object_position.copy()

    def begin(self, chosen: Bools, state: GraspState) -> None:
        assert state.object_position is not None
        assert state.object_quaternion is not None
        for own, value in (
            (self._start, state.object_quaternion),
            (self._q, state.q),
            (self._position, state.object_position),
        ):
            own[chosen] = value[chosen]
        self.reached[chosen] = 0
        self.rotation[chosen] = self._angle[chosen] = 0.0
        self._ask(chosen, state.object_quaternion)

    def _ask(self, chosen: Bools, now: Floats) -> None:
        """New goals in the environments chosen, whose objects are as ``now`` ``(N, 4)``."""
        found = draw(
            self.goals,
            self._simulation.task_streams,
            chosen,
            now=now,
            upright=self._upright,
            axis=self._axis,
            least_angle=self.config.least_goal_angle,
        )
        self.goal = np.where(chosen[:, None], found, self.goal)
        self._distance = np.where(chosen, angle_between(now, self.goal), self._distance)
        self._since[chosen] = 0

    def with_goal(self, state: GraspState) -> GraspState:
        return replace(state, goal_quaternion=self.goal)

    def judge(self, step: Step) -> Judgement:
        config, period = self.config, self._simulation.control_period
        position, quaternion = step.state.object_position, step.state.object_quaternion
        assert position is not None
        assert quaternion is not None
        distance = angle_between(quaternion, self.goal)
        moved = Moved(
            distance=distance,
            nearer=np.where(step.diverged, 0.0, self._distance - distance),
            joint_speed=np.linalg.norm(step.state.q - self._q, axis=-1) / period,
            object_speed=np.linalg.norm(position - self._position, axis=-1) / period,
            turning_speed=np.linalg.norm(step.angular_velocity, axis=-1),
        )
        away = distance_from_start(step)
        dropped = self._holding.lost(away, step)
        lost = dropped | step.diverged
        success = criteria(moved, config).all(axis=-1) & ~lost
        self.reached = self.reached + success
        self._since = self._since + 1
        time = self._since * period
        missed = (time >= config.goal_seconds - 0.5 * period) & ~success & ~lost
        self._turn(quaternion)
        info = {
            "distance": distance,
            "goal_reached": success,
            "goal_missed": missed,
            "goal_time": time,
            "goals": self.reached.copy(),
            "rotation": self.rotation.copy(),
        }
        worth = self._holding.charged(
            reward(moved, success, config), away=away, lost=dropped, links=~step.fingertips_only
        )
        succeeded = self.reached >= config.goal_count
        self._q, self._position = step.state.q.copy(), position.copy()
        self._distance = distance
        new = (success | missed) & ~succeeded
        if new.any():
            self._ask(new, quaternion)
        return Judgement(
            reward=np.where(step.diverged, 0.0, worth),
            dropped=dropped,
            succeeded=succeeded,
            info=info,
        )

    def _turn(self, quaternion: Floats) -> None:
        angle = twist_angle(multiply(quaternion, inverse(self._start)), self._axis)
        self.rotation = self.rotation + shortest(angle - self._angle)
        self._angle = angle

    def _arrays(self) -> dict[str, np.ndarray]:
        return {
            "goal": self.goal,
            "reached": self.reached,
            "distance": self._distance,
            "since": self._since,
            "rotation": self.rotation,
            "angle": self._angle,
            "start": self._start,
            "q": self._q,
            "position": self._position,
        }

    def save(self) -> dict[str, Any]:
        return {name: array.copy() for name, array in self._arrays().items()}

    def restore(self, saved: dict[str, Any]) -> None:
        found = {name: saved[name].copy() for name in self._arrays()}
        self.goal, self.reached, self.rotation = (
            found[name] for name in ("goal", "reached", "rotation")
        )
        self._distance, self._since = found["distance"], found["since"]
        self._angle, self._start = found["angle"], found["start"]
        self._q, self._position = found["q"], found["position"]
