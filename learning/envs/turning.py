"""Turning: the object is to be turned about an axis by gaiting fingers (thesis, chapter 3)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from dexctl.rotations import inverse, multiply, rotate, rotation_vector
from dexctl.settings import Vector
from dexctl.state import Bools, Floats, GraspState
from dexctl.validation import check_numbers, check_whole, unit_axis
from learning.envs.observation import Part
from learning.envs.task import Judgement, Step, Task

if TYPE_CHECKING:
    from dexctl.sim import Scene, Simulation, Trace


@dataclass(frozen=True, kw_only=True)
class TurningConfig:
    """What turning an object is worth, and when it is lost.

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
    """Turning is rewarded where at least so many fingertips touch."""
    drop_distance: float = 0.05
    """The object is lost when its centre is this far from where it started [m]."""
    wanted_speed: float | None = None
    """A speed to keep: beyond it the reward falls as it rose before [rad/s]. None: the faster the
    better, up to max_reward."""
    drop_cost: float = 0.0
    """Taken off the reward of the step in which the object is lost [rad/s]."""
    drift_cost: float = 0.0
    """Taken off for how far the object's centre is from where it started [rad/s per m]."""
    links_cost: float = 0.0
    """Taken off in every step in which the object touches anything but fingertips [rad/s]."""
    end_on_links: bool = False
    """Whether the object counts as lost in training where it touches anything but fingertips."""

    def __post_init__(self) -> None:
        check_numbers(
            self,
            positive=("max_reward", "max_tilt", "drop_distance"),
            not_negative=("drop_cost", "drift_cost", "links_cost"),
            optional=("wanted_speed",),
        )
        check_whole(self, min_fingertips=0)
        unit_axis(self.axis)

    @property
    def direction(self) -> tuple[float, float, float]:
        """``axis`` as a unit vector."""
        return unit_axis(self.axis)

    @property
    def parts(self) -> Mapping[str, Part]:
        """Parts of the observation that the task adds: none."""
        return Turning.parts

    def build(self, simulation: Simulation) -> Turning:
        """The task in these environments."""
        return Turning(self, simulation)


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


def reward(motion: Motion, config: TurningConfig) -> Floats:
    """The reward of one control step ``(...)`` [rad/s] (thesis, chapter 3, eq. reward).

    r = min(r_max, w . k) where at least ``min_fingertips`` and nothing but fingertips touch and
    the tilt is at most phi_max; min(0, w . k) elsewhere. The equation leaves "nothing but
    fingertips" to its text. With a speed v to keep (chapter 5, which gives no equation), w . k
    counts as min(w . k, 2 v - w . k). All costs are taken off.
    """
    speed = motion.speed
    if config.wanted_speed is not None:
        speed = np.minimum(speed, 2.0 * config.wanted_speed - speed)
    good = (
        (motion.fingertips >= config.min_fingertips)
        & motion.fingertips_only
        & (motion.tilt <= config.max_tilt)
    )
    found = np.where(good, np.minimum(speed, config.max_reward), np.minimum(speed, 0.0))
    for cost, amount in (
        (config.drop_cost, motion.dropped),
        (config.drift_cost, motion.away),
        (config.links_cost, ~motion.fingertips_only),
    ):
        if cost:
            found = found - cost * amount
    return found


def returns_of(trace: Trace, scene: Scene, config: TurningConfig) -> Floats:
    """The return ``(N,)`` [rad/s] of the episodes in ``trace``, up to the drop."""
    quaternion, axis = trace.object_quaternion, np.array(config.direction)
    turn = rotation_vector(multiply(quaternion[1:], inverse(quaternion[:-1])))
    upright = np.broadcast_to(upright_of(scene), quaternion[1:].shape)
    motion = Motion(
        speed=turn @ axis / float(trace.time[1] - trace.time[0]),
        tilt=tilt(quaternion[1:], upright, axis),
        fingertips=trace.in_contact[1:].sum(axis=-1),
        fingertips_only=trace.other_contact[1:] == 0.0,
        away=np.linalg.norm(trace.object_position[1:] - trace.object_position[0], axis=-1),
        dropped=trace.held[:-1] & ~trace.held[1:],
    )
    # the step that drops the object counts still; one that breaks down does not
    counts = trace.held[:-1] & ~trace.diverged[1:]
    return np.where(counts, reward(motion, config), 0.0).sum(axis=0)


class Turning(Task):
    """The object is turned about an axis; dropped, the episode ends.

    Args:
        config: what it is worth.
        simulation: the environments'.

    Attributes:
        rotation: unwrapped turn about the axis since the start, ``(N,)`` [rad].
    """

    def __init__(self, config: TurningConfig, simulation: Simulation) -> None:
        self.config = config
        self._axis = np.array(config.direction)
        sim, count = simulation.sim, simulation.num_envs
        self._upright = np.concatenate(
            [
                np.tile(upright_of(group.scene), (rows.stop - rows.start, 1))
                for group, rows in zip(sim.groups, sim.slices, strict=True)
            ]
        )
        self.rotation = np.zeros(count)
        self._angle = np.zeros(count)  # of the twist since the start, not unwrapped
        self._start = np.tile((1.0, 0.0, 0.0, 0.0), (count, 1))

    def begin(self, chosen: Bools, state: GraspState) -> None:
        assert state.object_quaternion is not None
        self._start[chosen] = state.object_quaternion[chosen]
        self.rotation[chosen] = self._angle[chosen] = 0.0

    def judge(self, step: Step) -> Judgement:
        position, quaternion = step.state.object_position, step.state.object_quaternion
        assert position is not None
        assert quaternion is not None
        away = np.linalg.norm(position - step.start_position, axis=-1)
        dropped = away > self.config.drop_distance
        if self.config.end_on_links:
            dropped |= ~step.fingertips_only
        dropped &= ~step.diverged
        motion = Motion(
            speed=np.where(step.diverged, 0.0, step.angular_velocity @ self._axis),
            tilt=tilt(quaternion, self._upright, self._axis),
            fingertips=step.state.in_contact.sum(axis=-1),
            fingertips_only=step.fingertips_only,
            away=away,
            dropped=dropped,
        )
        angle = twist_angle(multiply(quaternion, inverse(self._start)), self._axis)
        self.rotation = self.rotation + shortest(angle - self._angle)
        self._angle = angle
        return Judgement(
            reward=np.where(step.diverged, 0.0, reward(motion, self.config)),
            dropped=dropped,
            succeeded=np.zeros(len(away), bool),  # it can always be turned further
            info={**motion._asdict(), "rotation": self.rotation.copy()},
        )

    def save(self) -> dict[str, Any]:
        return {
            "rotation": self.rotation.copy(),
            "angle": self._angle.copy(),
            "start": self._start.copy(),
        }

    def restore(self, saved: dict[str, Any]) -> None:
        self.rotation, self._angle = saved["rotation"].copy(), saved["angle"].copy()
        self._start = saved["start"].copy()


def upright_of(scene: Scene) -> Floats:
    """The object's orientation in the settled grasp, wxyz ``(4,)``."""
    return np.asarray(scene.settled.qpos[scene.object_qpos][3:])


def tilt(quaternion: Floats, upright: Floats, axis: Floats) -> Floats:
    """Angle ``(...)`` [rad] between ``axis`` and the body axis that lies along it when upright.

    Args:
        quaternion: of the object now, wxyz ``(..., 4)``.
        upright: of the object in its settled grasp, ``(..., 4)``.
        axis: unit vector ``(3,)``.
    """
    relative = multiply(quaternion, inverse(upright))
    now = rotate(relative, np.broadcast_to(axis, (*relative.shape[:-1], 3)))
    return np.arccos(np.clip(now @ axis, -1.0, 1.0))


def twist_angle(quaternion: Floats, axis: Floats) -> Floats:
    """The turn about ``axis`` ``(...)`` [rad], in [-2 pi, 2 pi].

    It is the twist of the swing-twist decomposition, so that tilting alone does not count.
    """
    return 2.0 * np.arctan2(quaternion[..., 1:] @ axis, quaternion[..., 0])


def shortest(angle: Floats) -> Floats:
    """``angle`` ``(...)`` [rad] as the shortest turn that ends in the same place, [-pi, pi)."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi
