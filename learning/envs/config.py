"""EnvConfig: everything that decides what an environment is."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from dexctl import hands
from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.validation import check_numbers
from learning.envs.noise import SensorNoise
from learning.envs.observation import DEFAULT_PARTS, check_parts
from learning.envs.pushes import Push

AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


def unit_axis(axis: str | tuple[float, ...]) -> tuple[float, float, float]:
    """A hand axis by name, or a vector, as a unit vector.

    Raises:
        UnknownName: no such name.
        InvalidInput: no vector of three numbers, or one without length.
    """
    if isinstance(axis, str):
        if axis not in AXES:
            raise UnknownName("axis", axis, [*AXES, "a vector (x, y, z)"])
        return AXES[axis]
    vector = np.asarray(axis, float)
    length = np.linalg.norm(vector) if vector.shape == (3,) else 0.0
    if not (np.isfinite(length) and length > 0):
        raise InvalidInput(f"axis is {axis}; expected x, y, z or a vector of length > 0")
    x, y, z = vector / length
    return float(x), float(y), float(z)


@dataclass(frozen=True, kw_only=True)
class EnvConfig:
    """Settings of the finger-gaiting environments.

    Attributes:
        hand: name of the hand.
        object: name of the object, or several: the environments of a batch are then shared out
            evenly, in this order (the first take one more where they do not come out even).
        gravity: how the hand is held: "up" (the palm looks up), "down", or gravity as a vector
            [m/s^2].
        object_size: width of the object [m]; None is what suits the hand.
        object_mass: [kg].
        control_period: time of one step [s].
        substeps: physics steps in it.
        episode_steps: control steps until an episode is truncated.
        axis: what the object is to be turned about, in the hand's frame: "x", "y", "z" or a
            vector, whose length does not count; -axis turns the other way.
        max_reward: r_max, the angular velocity beyond which the reward grows no more [rad/s].
        max_tilt: phi_max, the tilt of the object up to which turning is rewarded [rad].
        min_fingertips: that must touch for turning to be rewarded.
        drop_distance: an episode ends when the object's centre is this far from where it
            started [m].
        max_speed: what an action of 1 means, of set-points [rad/s].
        max_lead: set-points are kept this close to the measured joints [rad].
        disturbance: standard deviation of the set-points at the start [rad].
        parts: of the observation, in this order; see `learning.envs.observation`.
        scaled: whether observations are brought to about unit size; the thesis's are in SI units.
        joint_noise: standard deviation of observed joint positions [rad].
        position_noise: of each observed contact coordinate [m].
        normal_noise: of each coordinate of observed unit normals, before they are made unit again.
        force_noise: of observed forces, as a share of the force.
        push_force: size of the force that pulls at the object [N]; see `learning.envs.pushes`.
        push_seconds: how long it pulls into one direction [s].
        latency: how old what is observed of joints, touch and object is, rounded to control
            steps [s]; see `learning.envs.latency`.
        initial_states: file of states that episodes start from (`InitialStates`); None is the
            settled grasp.
        threads: of the physics; None is every core.

    Raises:
        UnknownName, InvalidInput: a setting is wrong; the message names it.
    """

    hand: str = "dex5"
    object: str | tuple[str, ...] = "cube"
    gravity: str | tuple[float, float, float] = "up"
    object_size: float | None = None
    object_mass: float = 0.1
    control_period: float = 0.05
    substeps: int = 10
    episode_steps: int = 1000
    axis: str | tuple[float, float, float] = "z"
    max_reward: float = 0.5
    max_tilt: float = 0.5
    min_fingertips: int = 3
    drop_distance: float = 0.05
    max_speed: float = 2.0
    max_lead: float = 0.25
    disturbance: float = 0.02
    parts: tuple[str, ...] = DEFAULT_PARTS
    scaled: bool = False
    joint_noise: float = 0.0
    position_noise: float = 0.0
    normal_noise: float = 0.0
    force_noise: float = 0.0
    push_force: float = 0.0
    push_seconds: float = 1.0
    latency: float = 0.0
    initial_states: str | Path | None = None
    threads: int | None = None

    def __post_init__(self) -> None:
        for name in ("object", "gravity", "axis", "parts"):  # as JSON has them
            if isinstance(getattr(self, name), list):
                object.__setattr__(self, name, tuple(getattr(self, name)))
        hands.entry(self.hand)
        if not self.objects:
            raise InvalidInput("object is (); expected a name, or several")
        check_numbers(
            self,
            positive=(
                "object_mass",
                "control_period",
                "max_reward",
                "max_tilt",
                "drop_distance",
                "max_speed",
                "max_lead",
                "push_seconds",
            ),
            not_negative=(
                "disturbance",
                "joint_noise",
                "position_noise",
                "normal_noise",
                "force_noise",
                "push_force",
                "latency",
            ),
        )
        for name, least in (("episode_steps", 1), ("substeps", 1), ("min_fingertips", 0)):
            value = getattr(self, name)
            if not isinstance(value, int) or isinstance(value, bool) or value < least:
                raise InvalidInput(f"{name} is {value!r}; expected a whole number from {least} on")
        check_parts(self.parts)
        self.direction  # noqa: B018 (raises where the axis is wrong)

    @property
    def objects(self) -> tuple[str, ...]:
        """The names of the objects."""
        return (self.object,) if isinstance(self.object, str) else self.object

    @property
    def direction(self) -> tuple[float, float, float]:
        """``axis`` as a unit vector."""
        return unit_axis(self.axis)

    @property
    def noise(self) -> SensorNoise:
        """Of the observation."""
        return SensorNoise(
            joint=self.joint_noise,
            position=self.position_noise,
            normal=self.normal_noise,
            force=self.force_noise,
        )

    @property
    def push(self) -> Push:
        """Of the object."""
        return Push(force=self.push_force, seconds=self.push_seconds)

    @property
    def latency_steps(self) -> int:
        """``latency`` in control steps."""
        return round(self.latency / self.control_period)

    @property
    def max_change(self) -> float:
        """What an action of 1 means in one control step [rad]."""
        return self.max_speed * self.control_period

    def to_dict(self) -> dict[str, Any]:
        """As JSON can hold it; ``EnvConfig(**it)`` is the same configuration."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        states = values["initial_states"]
        return values | {"initial_states": None if states is None else str(states)}
