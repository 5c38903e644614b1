"""Turning: the object is to be turned about an axis by gaiting fingers (thesis, chapter 3)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from dexctl.exceptions import InvalidInput
from dexctl.rotations import inverse, multiply, rotate, shortest, twist_angle
from dexctl.settings import Names, Range, Vector
from dexctl.state import Bools, Floats, GraspState
from dexctl.validation import AXES, check_name, check_numbers, check_pair, check_whole, unit_axis
from learning.envs.holding import HoldingConfig, distance_from_start
from learning.envs.observation import ANY
from learning.envs.task import Judgement, Step, Task

if TYPE_CHECKING:
    from dexctl.sim import Scene, Simulation


@dataclass(frozen=True, kw_only=True)
class TurningConfig:
    """What turning an object is worth.

    Raises:
        UnknownName, InvalidInput: a setting is wrong; the message names it.
    """

    axis: Vector = "z"
    """Hand axis to turn the object about: x, y, z, -x, -y, -z, or a vector of any length."""
    max_reward: float = 0.5
    """Angular velocity beyond which the reward grows no more [rad/s] (r_max)."""
    max_tilt: float = 0.5
    """Tilt of the object up to which turning is rewarded [rad] (phi_max)."""
    min_fingertips: int = 3
    """Turning is rewarded where at least so many fingertips touch, ..."""
    only_fingertips: bool = True
    """... and nothing else of the hand does; off, for hands that hold with their last links too."""
    wanted_speed: float | None = None
    """A speed to keep: beyond it the reward falls as it rose before [rad/s]. None: the faster the
    better, up to max_reward."""
    commands: Names = ()
    """Axes of which one after the other is drawn, in place of the one axis: x, y, z, -x, -y, -z, or
    any, which is any direction; the policy sees them in goal_angular_velocity."""
    command_seconds: float = 10.0
    """How long a command holds before the next is drawn [s]."""
    command_speed_range: Range = (0.5, 0.5)
    """The wanted speed is drawn from this range with each command; turning faster is worth no more,
    whatever max_reward [rad/s]."""
    keep_speed: bool = False
    """Whether a command's speed, max_reward without commands, is one to keep, as wanted_speed is,
    and not only the most that is worth anything."""

    def __post_init__(self) -> None:
        check_numbers(
            self,
            positive=("max_reward", "max_tilt", "command_seconds"),
            optional=("wanted_speed",),
        )
        check_whole(self, min_fingertips=0)
        unit_axis(self.axis)
        for name in self.commands:
            check_name("command", name, (*AXES, ANY))
        expected = "two finite numbers above 0, the lower one first"
        low, high = check_pair("command_speed_range", self.command_speed_range, expected)
        if not 0 < low <= high:
            raise InvalidInput(
                f"command_speed_range is {self.command_speed_range}; expected {expected}"
            )

    @property
    def direction(self) -> tuple[float, float, float]:
        """``axis`` as a unit vector."""
        return unit_axis(self.axis)


class Motion(NamedTuple):
    """What a control step did to the object; arrays are ``(...)``.

    Attributes:
        speed: angular velocity about the axis, mean over the control step [rad/s].
        tilt: phi, angle between the axis and where the object's own axis is now [rad].
        fingertips: n_c, how many touch.
        fingertips_only: whether nothing of the hand but fingertips touches the object.
        away: how far the object's centre is from where it started [m].
        dropped: whether the object is lost in this step.
    """

    speed: Floats
    tilt: Floats
    fingertips: np.ndarray
    fingertips_only: Bools
    away: Floats
    dropped: Bools


def reward(motion: Motion, config: TurningConfig, most: Floats | None = None) -> Floats:
    """The reward of one control step ``(...)`` [rad/s] (thesis, chapter 3, eq. reward).

    r = min(r_max, w . k) where at least ``min_fingertips`` and nothing but fingertips touch and
    the tilt is at most phi_max; min(0, w . k) elsewhere. The equation leaves "nothing but
    fingertips" to its text. With a speed v to keep (chapter 5, which gives no equation), w . k
    counts as min(w . k, 2 v - w . k). ``most`` ``(...)`` stands for r_max where it is given, and
    for v with ``keep_speed``. What `HoldingConfig` costs is not in it.
    """
    speed = motion.speed
    most = np.full_like(speed, config.max_reward) if most is None else most
    kept = most if config.keep_speed else config.wanted_speed
    if kept is not None:
        speed = np.minimum(speed, 2.0 * kept - speed)
    good = (
        (motion.fingertips >= config.min_fingertips)
        & (motion.fingertips_only | (not config.only_fingertips))
        & (motion.tilt <= config.max_tilt)
    )
    return np.where(good, np.minimum(speed, most), np.minimum(speed, 0.0))


class Turning(Task):
    """The object is turned about an axis; dropped, the episode ends.

    Args:
        config: what it is worth.
        simulation: the environments'.
        holding: when an object is lost, and what holding it badly costs.

    Attributes:
        axis: about which each object is wanted to turn, unit ``(N, 3)``.
        speed: how fast, ``(N,)`` [rad/s].
        rotation: unwrapped turn about the axes wanted since the start, ``(N,)`` [rad].
    """

    def __init__(
        self, config: TurningConfig, simulation: Simulation, holding: HoldingConfig
    ) -> None:
        self.config = config
        self._simulation, self._holding = simulation, holding
        count = simulation.num_envs
        self.axis = np.tile(config.direction, (count, 1))
        self.speed = np.full(count, config.max_reward)
        self._upright = uprights(simulation)
        self._reference = self._upright.copy()  # what tilt is measured from
        self.rotation = np.zeros(count)
        self._angle = np.zeros(count)  # of the twist since the start, not unwrapped
        self._start = np.tile((1.0, 0.0, 0.0, 0.0), (count, 1))
        self._since = np.zeros(count, np.int64)  # steps since the command

    def begin(self, chosen: Bools, state: GraspState) -> None:
        assert state.object_quaternion is not None
        self.rotation[chosen] = 0.0
        self._command(chosen, state.object_quaternion)
        if not self.config.commands:  # a state of a file may be on its way there
            self._reference[chosen] = self._upright[chosen]

    def _command(self, chosen: Bools, now: Floats) -> None:
        """Turning begins anew in the environments chosen, about other axes where they are drawn."""
        self._start[chosen] = self._reference[chosen] = now[chosen]
        self._angle[chosen] = 0.0
        self._since[chosen] = 0
        if not self.config.commands:
            return
        number = self._simulation.task_streams.uniform((4,), chosen)
        low, high = self.config.command_speed_range
        commands = np.array(self.config.commands)
        names = commands[(number[:, 0] * len(commands)).astype(int)]
        # any direction: height and azimuth of a point on the sphere (Archimedes)
        height, azimuth = 2.0 * number[:, 1] - 1.0, 2.0 * np.pi * number[:, 2]
        flat = np.sqrt(1.0 - height**2)
        axis = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), height], axis=1)
        for name, vector in AXES.items():
            axis[names == name] = vector
        self.axis = np.where(chosen[:, None], axis, self.axis)
        self.speed = np.where(chosen, low + number[:, 3] * (high - low), self.speed)

    def with_goal(self, state: GraspState) -> GraspState:
        return replace(state, goal_angular_velocity=self.speed[:, None] * self.axis)

    def judge(self, step: Step) -> Judgement:
        quaternion = step.state.object_quaternion
        assert quaternion is not None
        away = distance_from_start(step)
        dropped = self._holding.lost(away, step)
        speed = np.einsum("ni,ni->n", step.angular_velocity, self.axis)
        motion = Motion(
            speed=np.where(step.diverged, 0.0, speed),
            tilt=tilt(quaternion, self._reference, self.axis),
            fingertips=step.state.in_contact.sum(axis=-1),
            fingertips_only=step.fingertips_only,
            away=away,
            dropped=dropped,
        )
        angle = twist_angle(multiply(quaternion, inverse(self._start)), self.axis)
        self.rotation = self.rotation + shortest(angle - self._angle)
        self._angle = angle
        worth = self._holding.charged(
            reward(motion, self.config, self.speed),
            away=away,
            lost=dropped,
            links=~step.fingertips_only,
        )
        info = {**motion._asdict(), "rotation": self.rotation.copy()}
        self._since = self._since + 1
        if self.config.commands:
            over = self._since * self._simulation.control_period >= self.config.command_seconds
            if over.any():
                self._command(over, quaternion)
        return Judgement(
            reward=np.where(step.diverged, 0.0, worth),
            dropped=dropped,
            succeeded=np.zeros(len(away), bool),  # it can always be turned further
            info=info,
        )

    def _arrays(self) -> dict[str, np.ndarray]:
        return {
            "rotation": self.rotation,
            "angle": self._angle,
            "start": self._start,
            "axis": self.axis,
            "speed": self.speed,
            "reference": self._reference,
            "since": self._since,
        }

    def save(self) -> dict[str, Any]:
        return {name: array.copy() for name, array in self._arrays().items()}

    def restore(self, saved: dict[str, Any]) -> None:
        found = {name: saved[name].copy() for name in self._arrays()}
        self.rotation, self._angle, self._start = (
            found[name] for name in ("rotation", "angle", "start")
        )
        self.axis, self.speed = found["axis"], found["speed"]
        self._reference, self._since = found["reference"], found["since"]


def uprights(simulation: Simulation) -> Floats:
    """The objects' orientations in the settled grasps, wxyz ``(N, 4)``."""
    sim = simulation.sim
    rows = [
        np.tile(upright_of(group.scene), (rows.stop - rows.start, 1))
        for group, rows in zip(sim.groups, sim.slices, strict=True)
    ]
    return np.concatenate(rows)


def upright_of(scene: Scene) -> Floats:
    """The object's orientation in the settled grasp, wxyz ``(4,)``."""
    return np.asarray(scene.settled.qpos[scene.object_qpos][3:])


def tilt(quaternion: Floats, upright: Floats, axis: Floats) -> Floats:
    """Angle ``(...)`` [rad] between ``axis`` and the body axis that lies along it when upright.

    Args:
        quaternion: of the object now, wxyz ``(..., 4)``.
        upright: of the object in its settled grasp, ``(..., 4)``.
        axis: unit vector ``(3,)`` or ``(..., 3)``.
    """
    relative = multiply(quaternion, inverse(upright))
    axis = np.broadcast_to(axis, (*relative.shape[:-1], 3))
    now = rotate(relative, axis)
    return np.arccos(np.clip((now * axis).sum(axis=-1), -1.0, 1.0))
