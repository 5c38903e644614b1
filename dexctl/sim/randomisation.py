"""Randomisation: what is drawn anew for each episode of each environment, and from which ranges."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from dexctl.exceptions import InvalidInput
from dexctl.limits import LONGEST_LATENCY, HandLimits
from dexctl.rotations import cross
from dexctl.settings import Range
from dexctl.sim.pushes import Push
from dexctl.sim.sensing import Sensing
from dexctl.state import Bools, Floats
from dexctl.streams import Streams, StreamsState
from dexctl.validation import check_numbers, check_pair

if TYPE_CHECKING:
    from dexctl.sim.scene import Scene

_MAY_BE_ZERO = (
    "gear_friction_range", "armature_range", "action_latency_range", "sensor_latency_range",
    "noise_range", "touch_threshold_range", "touch_dropout_range", "push_range",
    "gravity_turning_range",
)  # fmt: skip
_ANY = ("joint_offset_range",)  # may be below zero
_CAPS = ("centre_of_mass", "gravity_tilt")  # drawn up to so much, each way


@dataclass(frozen=True, kw_only=True)
class Randomisation:
    """Ranges, from each of which every episode draws one number uniformly; none: nothing drawn.

    What is not drawn is as the scene has it. A level below one narrows all ranges towards that
    (see `Randomiser`).

    Raises:
        InvalidInput: a range that is none; the message names it.
    """

    friction_range: Range | None = None
    """Sliding friction coefficient between object and fingertips."""
    tip_friction_range: Range | None = None
    """Friction of each fingertip, as a share of what it and the object have otherwise."""
    link_friction_range: Range | None = None
    """Friction of palm and links, as a share of what they and the object have otherwise."""
    mass_range: Range | None = None
    """Mass of the object [kg]."""
    size_range: Range | None = None
    """Width of the object, as a share of the scene's; one of five widths, each with its grasp."""
    centre_of_mass: float = 0.0
    """The object's centre of mass is off its shape's by up to this, each way [m]."""
    stiffness_range: Range | None = None
    """Stiffness of each servo, as a share of its own."""
    damping_range: Range | None = None
    """Damping of each servo and joint, as a share of its own."""
    gear_friction_range: Range | None = None
    """Dry friction of each joint [N m]."""
    armature_range: Range | None = None
    """Inertia of each joint's motor as the joint feels it [kg m^2]."""
    speed_range: Range | None = None
    """Fastest set-point [rad/s]."""
    torque_range: Range | None = None
    """Largest joint torque [N m]."""
    action_latency_range: Range | None = None
    """Time from a set-point to its effect [s]."""
    noise_range: Range | None = None
    """All noises of the sensors, the encoders' offsets among them, as a share of their standard
    deviations. Only a range follows the level, from no noise on: 1,1 draws nothing, and lets the
    noise grow in a curriculum."""
    sensor_latency_range: Range | None = None
    """How old what is sensed is [s]. Rounded to control steps, as one reading is taken in each: of
    0,0.05 at 0.05 s half of the episodes have no latency and half 0.05 s."""
    touch_threshold_range: Range | None = None
    """Weakest normal force that counts as touch [N], of each finger."""
    touch_dropout_range: Range | None = None
    """Probability that a touch is not felt in a control step."""
    joint_offset_range: Range | None = None
    """What each encoder reads at zero for an episode, of each joint [rad], as -0.05,0.05. It has
    bounds, which the normal `joint_offset` has not; where both are set they add up. A range of
    noises does not change it."""
    push_range: Range | None = None
    """Size of the force that pulls at the object [N]."""
    gravity_tilt: float = 0.0
    """Gravity is turned from the scene's by up to this, uniformly on the sphere; pi: any way
    up [rad]."""
    gravity_straight_share: float = 0.0
    """Share of the episodes in which gravity points exactly along the scene's own line, which a
    uniform direction never does: its way or, where the tilt reaches that, as often the other."""
    gravity_turning_range: Range | None = None
    """Speed at which gravity turns about an axis drawn, as where the hand is moved [rad/s]."""

    def __post_init__(self) -> None:
        for one in fields(self):
            value = getattr(self, one.name)
            if one.name.endswith("_range") and value is not None:
                _check_range(one.name, value)
        check_numbers(
            self,
            not_negative=_CAPS,
        )
        if self.gravity_tilt > np.pi:
            raise InvalidInput(f"gravity_tilt is {self.gravity_tilt}; expected 0 to pi")
        if not 0.0 <= self.gravity_straight_share <= 1.0:
            raise InvalidInput(
                f"gravity_straight_share is {self.gravity_straight_share}; expected 0 to 1"
            )
        for name in ("action_latency_range", "sensor_latency_range"):
            given = getattr(self, name)
            if given is not None and given[1] > LONGEST_LATENCY:
                raise InvalidInput(
                    f"{name} is {given}; expected latencies up to {LONGEST_LATENCY:g} s"
                )
        if self.touch_dropout_range is not None and self.touch_dropout_range[1] > 1:
            raise InvalidInput(
                f"touch_dropout_range is {self.touch_dropout_range}; expected shares, 0 to 1"
            )

    def __bool__(self) -> bool:
        """Whether anything is drawn."""
        return self != Randomisation()

    @property
    def drawn(self) -> tuple[str, ...]:
        """The settings, of those that a level narrows, by which something is drawn."""
        return tuple(name for name in WIDENED if getattr(self, name))

    @property
    def draws_gravity(self) -> bool:
        """Whether gravity's direction is drawn."""
        return self.gravity_tilt > 0 or self.gravity_turning_range is not None

    @property
    def draws_surfaces(self) -> bool:
        """Whether the friction of fingertips or links is drawn apart from the object's."""
        return self.tip_friction_range is not None or self.link_friction_range is not None

    @property
    def limits_hand(self) -> bool:
        """Whether limits of the hand are drawn."""
        drawn = (self.speed_range, self.torque_range, self.action_latency_range)
        return any(one is not None for one in drawn)

    @property
    def sizes(self) -> Floats:
        """The widths that are drawn from, ``(5,)``, as shares of the scene's; ``(1,)`` for one."""
        return np.array([1.0]) if self.size_range is None else np.linspace(*self.size_range, 5)


WIDENED = tuple(
    one.name for one in fields(Randomisation) if one.name.endswith("_range") or one.name in _CAPS
)
"""The settings of `Randomisation` that a level narrows."""


def _check_range(name: str, value: object) -> None:
    which = "" if name in _ANY else " from 0 on" if name in _MAY_BE_ZERO else " above 0 on"
    expected = f"two finite numbers{which}, the lower one first"
    low, high = check_pair(name, value, expected)
    right = name in _ANY or low > 0 or (low == 0 and name in _MAY_BE_ZERO)
    if not (right and low <= high):
        raise InvalidInput(f"{name} is {value}; expected {expected}")


class Drawn(NamedTuple):
    """What holds in an episode of each of N environments; rows as wide as it says.

    Attributes:
        friction, object_mass, object_size, centre_of_mass, kp, kv, damping, gear_friction, gravity:
            parameters of the simulator, as `BatchSimulator.set_parameters` has them.
        gravity_turning: axis times speed at which gravity turns, ``(N, 3)`` [rad/s].
        speed_limit, torque_limit, action_latency: of the hand, ``(N,)``; infinite: no limit.
        noise: share of the sensors' standard deviations, ``(N,)``.
        sensor_latency: ``(N,)`` [s].
        touch_threshold: ``(N, m)`` [N].
        touch_dropout: ``(N,)``.
        push_force: ``(N,)`` [N].
        armature: a parameter of the simulator, as the first ones.
        joint_offset: what the encoders read at zero by its range, ``(N, d)`` [rad].
        tip_friction, link_friction: parameters of the simulator, as the first ones.
    """

    friction: Floats
    object_mass: Floats
    object_size: Floats
    centre_of_mass: Floats
    kp: Floats
    kv: Floats
    damping: Floats
    gear_friction: Floats
    gravity: Floats
    gravity_turning: Floats
    speed_limit: Floats
    torque_limit: Floats
    action_latency: Floats
    noise: Floats
    sensor_latency: Floats
    touch_threshold: Floats
    touch_dropout: Floats
    push_force: Floats
    armature: Floats
    joint_offset: Floats
    tip_friction: Floats
    link_friction: Floats


# which setting draws what, for all that is one number from one range
_RANGES = {
    "friction": "friction_range",
    "object_mass": "mass_range",
    "object_size": "size_range",
    "kp": "stiffness_range",
    "kv": "damping_range",
    "damping": "damping_range",
    "gear_friction": "gear_friction_range",
    "armature": "armature_range",
    "speed_limit": "speed_range",
    "torque_limit": "torque_range",
    "action_latency": "action_latency_range",
    "noise": "noise_range",
    "sensor_latency": "sensor_latency_range",
    "touch_threshold": "touch_threshold_range",
    "touch_dropout": "touch_dropout_range",
    "push_force": "push_range",
    "joint_offset": "joint_offset_range",
    "tip_friction": "tip_friction_range",
    "link_friction": "link_friction_range",
}
_SHARES = ("kp", "kv", "damping")  # of what they are in the scene
PHYSICAL = (
    "friction", "object_mass", "object_size", "centre_of_mass", "kp", "kv", "damping",
    "gear_friction", "armature", "gravity", "tip_friction", "link_friction",
)  # fmt: skip
"""What of `Drawn` the simulator's parameters are."""


def nominal(
    groups: Sequence[tuple[Scene, int]], sensing: Sensing, limits: HandLimits, push: Push
) -> Drawn:
    """What holds in N environments where nothing is drawn.

    Args:
        groups: the scenes, each with its number of environments.
        sensing, limits, push: of all of them.
    """
    count, hand = sum(n for _, n in groups), groups[0][0].hand

    def each(of: Callable[[Scene], object]) -> Floats:
        return np.concatenate([np.tile(np.asarray(of(s), float), (n, 1)) for s, n in groups])

    def one(value: float | None) -> Floats:
        return np.full(count, np.inf if value is None else value)

    return Drawn(
        friction=each(lambda scene: scene.friction())[:, 0],
        object_mass=each(lambda scene: scene.model.body(scene.object_body).mass)[:, 0],
        object_size=one(1.0),
        centre_of_mass=np.zeros((count, 3)),
        kp=each(lambda scene: scene.stiffness),
        kv=each(_servo_damping),
        damping=each(lambda scene: scene.model.dof_damping[scene.qvel_columns]),
        gear_friction=each(lambda scene: scene.model.dof_frictionloss[scene.qvel_columns]),
        gravity=each(lambda scene: scene.gravity),
        gravity_turning=np.zeros((count, 3)),
        speed_limit=one(limits.speed_limit),
        torque_limit=one(limits.torque_limit),
        action_latency=one(limits.action_latency),
        noise=one(1.0),
        sensor_latency=one(sensing.sensor_latency),
        touch_threshold=np.full((count, hand.n_fingers), sensing.touch_threshold),
        touch_dropout=np.zeros(count),
        push_force=one(push.push_force),
        armature=each(lambda scene: scene.model.dof_armature[scene.qvel_columns]),
        joint_offset=np.zeros((count, hand.nq)),
        tip_friction=np.ones((count, hand.n_fingers)),
        link_friction=one(1.0),
    )


def _servo_damping(scene: Scene) -> Floats:
    return -scene.model.actuator_biasprm[scene.actuators, 2] * scene.ctrl_per_radian**2


class Randomiser:
    """Draws what holds in the episodes of N environments.

    Every episode takes as many numbers from its stream whatever is drawn, so one range more does
    not change the others.

    Args:
        config: the ranges.
        usual: what holds where nothing is drawn.
        streams: of the draws, ``(N,)``.

    Attributes:
        level: how much of the ranges is used, from 0 (everything nominal) to 1, in the episodes
            to come. A limit that is infinite in the scene counts as the range's high end there, and
            a range of noises begins with none.
        schedule: from which level on each range widens and at which all of it is used, by its
            setting (of `WIDENED`); those without one are used as far as the level itself.
        drawn: what holds now.
        usual, streams: as given.
    """

    def __init__(self, config: Randomisation, usual: Drawn, streams: Streams) -> None:
        self.config, self.streams = config, streams
        self.level = 1.0
        self.schedule: Mapping[str, tuple[float, float]] = {}
        self.drawn = self.usual = usual

    def width(self, setting: str) -> float:
        """How much of one setting's range is used at the level, from 0 to 1."""
        first, whole = self.schedule.get(setting, (0.0, 1.0))
        if self.level >= whole:
            return 1.0
        return max(self.level - first, 0.0) / (whole - first) if whole > first else 0.0

    @property
    def physical(self) -> tuple[str, ...]:
        """Names of the simulator's parameters that are drawn."""
        return tuple(name for name in PHYSICAL if self._draws(name))

    def _draws(self, name: str) -> bool:
        if name in _RANGES:
            return getattr(self.config, _RANGES[name]) is not None
        if name == "centre_of_mass":
            return self.config.centre_of_mass > 0
        return self.config.draws_gravity

    def draw(self, chosen: Bools) -> None:
        """Draw for the episodes that begin in the environments chosen, ``(N,)``."""
        found: dict[str, Floats] = {}
        # the axis of turning has its two before the fields that came later, each at the end: what
        # an episode's other numbers are stays as it was
        later = Drawn._fields.index("joint_offset")
        widths = [value[0].size for value in self.usual]
        widths.insert(later, 2)
        numbers = self.streams.uniform((sum(widths),), chosen)
        parts = np.split(numbers, np.cumsum(widths)[:-1], axis=1)
        more = parts.pop(later)
        for name, part, nominal in zip(Drawn._fields, parts, self.usual, strict=True):
            uniform = part.reshape(nominal.shape)
            if name in _RANGES:
                value = self._from_range(name, uniform, nominal)
                if name == "object_size":
                    sizes = self.config.sizes
                    value = sizes[np.abs(value[:, None] - sizes).argmin(axis=1)]
            elif name == "centre_of_mass":
                most = self.width(name) * self.config.centre_of_mass
                value = nominal + most * (2.0 * uniform - 1.0)
            else:
                continue
            found[name] = value
        turned = parts[Drawn._fields.index("gravity")]
        found["gravity"] = self._tilted(self.usual.gravity, *turned.T)
        found["gravity_turning"] = self._turning(
            parts[Drawn._fields.index("gravity_turning")][:, 0], more
        )
        self.drawn = Drawn(
            *(
                np.where(chosen.reshape(-1, *(1,) * (now.ndim - 1)), found[name], now)
                for name, now in self.drawn._asdict().items()
            )
        )

    def _from_range(self, name: str, uniform: Floats, nominal: Floats) -> Floats:
        given = getattr(self.config, _RANGES[name])
        if given is None:
            return nominal
        (low, high), width = given, self.width(_RANGES[name])
        if name in _SHARES:
            return nominal * (1.0 + width * (low + (high - low) * uniform - 1.0))
        usual = np.where(np.isfinite(nominal), nominal, high)
        if name == "noise":  # a level below one is to be easier, and noise as it is set is not
            usual = np.zeros_like(usual)
        return usual + width * (low + (high - low) * uniform - usual)

    def _tilted(self, gravity: Floats, height: Floats, azimuth: Floats, straight: Floats) -> Floats:
        """Gravity turned from where it points, uniformly on the cap of the sphere, or straight."""
        most = self.width("gravity_tilt") * self.config.gravity_tilt
        if not most:
            return gravity
        size = np.linalg.norm(gravity, axis=1)
        along = gravity / np.maximum(size, 1e-12)[:, None]
        share = self.config.gravity_straight_share
        other_way = (straight < 0.5 * share) & (most >= np.pi)
        straight_height = np.where(other_way, 1.0, 0.0)
        height = np.where(straight < share, straight_height, height)
        cosine = 1.0 - height * (1.0 - np.cos(most))
        sine = np.sqrt(np.maximum(1.0 - cosine**2, 0.0))
        aside = sine[:, None] * _around(along, 2.0 * np.pi * azimuth)
        return size[:, None] * (cosine[:, None] * along + aside)

    def _turning(self, speed: Floats, direction: Floats) -> Floats:
        given = self.config.gravity_turning_range
        if given is None:
            return self.usual.gravity_turning
        height = 2.0 * direction[:, 0] - 1.0
        across = np.sqrt(np.maximum(1.0 - height**2, 0.0))
        angle = 2.0 * np.pi * direction[:, 1]
        axis = np.stack([across * np.cos(angle), across * np.sin(angle), height], axis=1)
        width = self.width("gravity_turning_range")
        return (width * (given[0] + (given[1] - given[0]) * speed))[:, None] * axis

    def turn(self, seconds: float) -> bool:
        """Let gravity turn for so long; whether it does in any environment."""
        turning = self.drawn.gravity_turning
        speed = np.sqrt((turning * turning).sum(axis=1, keepdims=True))
        if not speed.any():
            return False
        axis = turning / np.maximum(speed, 1e-12)
        angle, gravity = speed * seconds, self.drawn.gravity
        along = (gravity * axis).sum(axis=1, keepdims=True) * axis
        across = gravity - along
        turned = along + np.cos(angle) * across + np.sin(angle) * cross(axis, across)
        self.drawn = self.drawn._replace(gravity=np.where(speed > 0, turned, gravity))
        return True

    def save(self) -> dict[str, Any]:
        """All that decides what is to come, to be given to `restore`."""
        return {
            "streams": self.streams.save()._asdict(),
            "level": float(self.level),
            "drawn": {name: value.copy() for name, value in self.drawn._asdict().items()},
        }

    def restore(self, saved: dict[str, Any]) -> None:
        """Go on from what `save` returned."""
        self.streams.restore(StreamsState(**saved["streams"]))
        self.level = float(saved["level"])
        # what was saved before a field was there did not draw it
        self.drawn = self.usual._replace(
            **{name: value.copy() for name, value in saved["drawn"].items()}
        )


def _around(axis: Floats, angle: Floats) -> Floats:
    """Unit vectors across unit ``axis`` ``(N, 3)``, at an angle ``(N,)`` about it."""
    least = np.eye(3)[np.argmin(np.abs(axis), axis=1)]
    first = cross(axis, least)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = cross(axis, first)
    return np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second
