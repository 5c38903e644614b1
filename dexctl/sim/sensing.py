"""Sensing: how badly and how late a hand's sensors tell what is."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np

from dexctl.exceptions import InvalidInput
from dexctl.joint_touch import JointTouch
from dexctl.limits import LONGEST_LATENCY
from dexctl.rotations import from_rotation_vector, multiply
from dexctl.settings import NESTED
from dexctl.state import Bools, Floats, GraspState
from dexctl.streams import Streams, StreamsState
from dexctl.touch import TouchConfig
from dexctl.validation import check_kind, check_name, check_numbers

if TYPE_CHECKING:
    from dexctl.sim.reckoning import Reckoning

Touch = Literal["full", "binary", "joint-torque"]
TOUCHES: tuple[Touch, ...] = ("full", "binary", "joint-torque")
Pose = Literal["tracked", "touch", "odometry", "unknown"]
POSES: tuple[Pose, ...] = ("tracked", "touch", "odometry", "unknown")

_SENSED = (
    "q", "in_contact", "contact_position", "contact_normal", "contact_force",
    "object_position", "object_quaternion", "time", "age",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Sensing:
    """What a hand's sensors tell of touch, their noise and latency. Set-points are known exactly.

    Raises:
        InvalidInput: a number that is not finite, or below zero.
    """

    touch: Touch = "full"
    """What is known of touch: "full" is contact points, normals and forces; "binary" which
    fingertips touch, the rest told from the joints; "joint-torque" the joints alone."""
    joint_touch: Annotated[TouchConfig, NESTED] = field(default_factory=TouchConfig)
    object_pose: Pose = "tracked"
    """How the object's pose is known: "tracked", as it is; as it was at the start of the episode
    and from then on by what the fingers feel, "touch" with its shape known (`TouchTracking`),
    "odometry" without (`ContactOdometry`); "unknown", not at all."""
    joint_offset: float = 0.0
    """Standard deviation of what encoders read at zero, drawn for each joint and episode [rad].
    Servos go by their encoders, so what they hold is off by as much."""
    joint_noise: float = 0.0
    """Standard deviation of joint positions [rad]."""
    position_noise: float = 0.0
    """Standard deviation of each coordinate of contact points [m]."""
    normal_noise: float = 0.0
    """Standard deviation of the tilt of contact normals about each of two axes [rad]."""
    force_noise: float = 0.0
    """Standard deviation of normal forces [N]; what then reads too little is no touch."""
    force_noise_share: float = 0.0
    """Standard deviation of normal forces, as a share of the force."""
    touch_threshold: float = 0.05
    """Weakest normal force that counts as touch [N]."""
    sensor_latency: float = 0.0
    """How old what is sensed is, rounded to control steps [s], at most 10. Two readings are not
    mixed: a finger touches or not, and contact points of two moments have no middle. Gravity, which
    an inertial sensor tells, is neither late nor noisy."""
    tracker_position_noise: float = 0.0
    """Standard deviation of each coordinate of the position of a tracked object [m]."""
    tracker_rotation_noise: float = 0.0
    """Standard deviation of the turn about each axis of a tracked object's orientation [rad]."""
    tracker_latency: float = 0.0
    """How much older than what else is sensed the pose of a tracked object is, rounded to control
    steps [s], at most 10."""

    def __post_init__(self) -> None:
        check_name("touch", self.touch, TOUCHES)
        check_name("object_pose", self.object_pose, POSES)
        check_kind(self, joint_touch=TouchConfig)
        kinds = ("touch", "joint_touch", "object_pose")
        names = tuple(one.name for one in fields(self) if one.name not in kinds)
        check_numbers(self, not_negative=names)
        for name in ("sensor_latency", "tracker_latency"):
            if getattr(self, name) > LONGEST_LATENCY:
                raise InvalidInput(
                    f"{name} is {getattr(self, name)}; expected 0 to {LONGEST_LATENCY:g} s"
                )

    @property
    def noisy(self) -> bool:
        """Whether what is sensed differs from the truth."""
        return any(getattr(self, name) > 0 for name in NOISES)

    def aged(self, age: float) -> Sensing:
        """With a tracker whose poses are at least this old [s], as `Controller.pose_age` is."""
        if self.object_pose != "tracked":
            return self
        return replace(self, tracker_latency=max(self.tracker_latency, age - self.sensor_latency))


NOISES = ("joint_noise", "position_noise", "normal_noise", "force_noise", "force_noise_share")
"""The settings of `Sensing` that are noise of joints and touch."""
TRACKER = ("tracker_position_noise", "tracker_rotation_noise", "tracker_latency")
"""The settings of `Sensing` that are of who tracks the object; nothing where nobody does."""
_POSE = ("object_position", "object_quaternion")


class Sensor:
    """The sensors of N hands.

    At the start of an episode they tell what they told first, until there is something older than
    the latency.

    Args:
        sensing: how they sense.
        streams: of the noise, ``(N,)``; each environment draws its own.
        control_period: [s].
        joint_touch: what makes touch of joints, where ``sensing`` has less than full touch.
        reckoning: what follows the object, where nothing tracks it.

    Attributes:
        streams: as given.
        offset: what each encoder reads at zero, ``(N, d)`` or 0 [rad].
    """

    def __init__(
        self,
        sensing: Sensing,
        streams: Streams,
        control_period: float,
        joint_touch: JointTouch | None = None,
        reckoning: Reckoning | None = None,
    ) -> None:
        self._sensing, self.streams = sensing, streams
        self._reckoning = reckoning
        self._joint_touch = joint_touch
        self.offset: Floats | float = 0.0
        self._own: Floats | float = 0.0  # by `joint_offset`; the others are given
        self._given: Floats | float = 0.0
        self._period = control_period
        self._past: list[dict[str, np.ndarray]] = []  # steps + 1 readings, the oldest first
        batch = streams.batch_shape
        self._share = np.ones(batch)
        self._late = np.full(batch, round(sensing.sensor_latency / control_period))
        tracked = sensing.object_pose == "tracked"
        self._pose_late = round(sensing.tracker_latency / control_period) if tracked else 0
        self._pose_noise = (
            (sensing.tracker_position_noise, sensing.tracker_rotation_noise) if tracked else (0, 0)
        )
        self._threshold: Floats | None = None  # that of ``sensing``, which the physics keep to
        self._dropout = np.zeros(batch)

    def set_errors(
        self,
        noise: Floats,
        latency: Floats,
        threshold: Floats | None,
        dropout: Floats,
        offset: Floats | float = 0.0,
    ) -> None:
        """Give the sensors of each environment their own errors; those of an episode.

        Args:
            noise: all noises, as a share of their standard deviations, ``(N,)``.
            latency: ``(N,)`` [s].
            threshold: weakest force that counts as touch, ``(N, m)`` [N]; None: as all have it.
            dropout: probability that a touch is not felt in a control step, ``(N,)``.
            offset: what each encoder reads at zero beside what `joint_offset` makes of it,
                ``(N, d)`` [rad].
        """
        self._given = offset
        self.offset = self._own + offset
        self._share, self._threshold, self._dropout = noise, threshold, dropout
        self._late = np.rint(np.asarray(latency) / self._period).astype(int)
        if not self._steps:
            self._past = []
        elif self._past:
            missing = self._steps + 1 - len(self._past)
            self._past = [self._past[0]] * max(missing, 0) + self._past

    @property
    def _steps(self) -> int:
        """The longest latency, in control steps."""
        return int(self._late.max(initial=0)) + self._pose_late

    def __call__(self, state: GraspState, begin: Bools | None = None) -> GraspState:
        """What is sensed of ``state`` ``(N,)``.

        Args:
            state: how things are.
            begin: None where a control step has passed in every environment; else those ``(N,)``
                whose episode begins with ``state``. The rows of the others are to be thrown away.
        """
        sensing = self._sensing
        if begin is not None:
            self._begin(begin, state.q.shape)
        if np.any(self.offset):
            state = replace(state, q=state.q + self.offset, q_target=state.q_target + self.offset)
        seen = blurred(
            state, sensing, self.streams, begin, share=self._share, threshold=self._threshold
        )
        seen = self._tracked(seen, begin)
        seen = self._felt(seen, begin)
        if self._joint_touch is not None:
            switches = seen.in_contact if sensing.touch == "binary" else None
            seen = self._joint_touch(self._placed(seen, begin), switches, mask=begin)
        if self._reckoning is not None:
            truth = state.object_position, state.object_quaternion
            seen = replace(seen, object_position=truth[0], object_quaternion=truth[1])
            seen = self._reckoning(seen, begin)
        elif sensing.object_pose == "unknown":
            seen = replace(seen, object_position=None, object_quaternion=None)
        if not self._steps:
            return seen
        now = {name: getattr(seen, name) for name in _SENSED if getattr(seen, name) is not None}
        now = {
            name: np.broadcast_to(v, (len(state.q), *np.shape(v)[1:])) for name, v in now.items()
        }
        if not self._past:
            self._past = [now] * (self._steps + 1)
        elif begin is None:
            self._past = [*self._past[-self._steps :], now]
        else:
            self._past = [_merged(begin, now, one) for one in self._past]
        then = self._oldest()
        age = then["age"] + (now["time"] - then["time"])
        return replace(seen, **{**then, "time": now["time"], "age": age})

    def _oldest(self) -> dict[str, np.ndarray]:
        """What each environment's sensors tell now: the reading as old as its latency."""
        return {name: self._then(name) for name in self._past[0]}

    def _then(self, name: str) -> np.ndarray:
        """One thing of `_oldest`."""
        late = self._late + self._pose_late if name in _POSE else self._late
        first = int(late[0])
        if (late == first).all():
            return self._past[-1 - first][name]
        rows = np.arange(len(late))
        return np.stack([one[name] for one in self._past])[len(self._past) - 1 - late, rows]

    def _tracked(self, seen: GraspState, begin: Bools | None) -> GraspState:
        """``seen`` with a tracker's noise on the objects' poses."""
        place, turn = self._pose_noise
        if not (place or turn):
            return seen
        assert seen.object_position is not None
        assert seen.object_quaternion is not None
        drawn = self.streams.normal((6,), begin) * self._share[:, None]
        return replace(
            seen,
            object_position=seen.object_position + place * drawn[:, :3],
            object_quaternion=multiply(
                from_rotation_vector(turn * drawn[:, 3:]), seen.object_quaternion
            ),
        )

    def _placed(self, seen: GraspState, begin: Bools | None) -> GraspState:
        """``seen`` with the objects where they are known to be before touch is told from joints."""
        if self._sensing.object_pose == "unknown":
            return replace(seen, object_position=None)
        if self._reckoning is None:
            return seen
        position = self._reckoning.position
        if begin is not None:
            assert seen.object_position is not None
            position = np.where(begin[:, None], seen.object_position, position)
        return replace(seen, object_position=position)

    def _felt(self, seen: GraspState, begin: Bools | None) -> GraspState:
        """What is left of touch by thresholds and drop-outs."""
        touch = seen.in_contact
        if self._threshold is not None and self._threshold.any():
            touch = touch & (seen.contact_force >= self._threshold)
        if self._dropout.any():
            drawn = self.streams.uniform(seen.in_contact.shape[1:], begin)
            touch = touch & (drawn >= self._dropout[:, None])
        if touch is seen.in_contact:
            return seen
        rows = touch[..., None]
        return replace(
            seen,
            in_contact=touch,
            contact_position=np.where(rows, seen.contact_position, 0.0),
            contact_normal=np.where(rows, seen.contact_normal, 0.0),
            contact_force=np.where(touch, seen.contact_force, 0.0),
        )

    def _begin(self, begin: Bools, shape: tuple[int, ...]) -> None:
        """Episodes begin: other encoders, and nothing felt yet."""
        if self._joint_touch is not None:
            self._joint_touch.reset(begin)
        if self._sensing.joint_offset:
            width = self._sensing.joint_offset * self._share[:, None]
            drawn = width * self.streams.normal(shape[1:], begin)
            self._own = np.where(begin[:, None], drawn, self._own)
            self.offset = self._own + self._given

    def save(self) -> dict[str, object]:
        """All that decides what is to come, to be given to `restore`."""
        felt = None if self._joint_touch is None else self._joint_touch.state_dict()
        return {
            "streams": self.streams.save()._asdict(),
            "past": [dict(one) for one in self._past],
            "joint_touch": felt,
            "offset": np.array(self._own),
            "reckoning": None if self._reckoning is None else self._reckoning.save(),
            "errors": {
                "noise": self._share.copy(),
                "latency": self._late * self._period,
                "threshold": None if self._threshold is None else self._threshold.copy(),
                "dropout": self._dropout.copy(),
                "offset": np.array(self._given),
            },
        }

    def restore(self, saved: dict) -> None:
        """Go on from what `save` returned."""
        self.streams.restore(StreamsState(**saved["streams"]))
        self._own = np.array(saved["offset"])
        self.set_errors(**saved["errors"])
        self._past = [dict(one) for one in saved["past"]]
        if self._joint_touch is not None:
            self._joint_touch.load_state_dict(saved["joint_touch"])
        if self._reckoning is not None:
            self._reckoning.restore(saved["reckoning"])


def blurred(
    state: GraspState,
    sensing: Sensing,
    streams: Streams,
    mask: Bools | None = None,
    *,
    share: Floats | float = 1.0,
    threshold: Floats | None = None,
) -> GraspState:
    """``state`` ``(N,)`` with noise on it; only the streams in ``mask`` move on.

    ``share``, one number or ``(N,)``, is how much of the noise there is, and ``threshold``
    ``(N, m)`` the weakest force that counts as touch [N]; None: that of ``sensing``.
    """
    if not sensing.noisy:
        return state
    count, d = state.q.shape
    m = state.in_contact.shape[1]
    drawn = streams.normal((d + 7 * m,), mask) * np.reshape(share, (-1, 1))
    joints, fingers = drawn[:, :d], drawn[:, d:].reshape(count, m, 7)
    factor = np.maximum(1.0 + sensing.force_noise_share * fingers[..., 6], 0.0)
    force = np.maximum(state.contact_force * factor + sensing.force_noise * fingers[..., 5], 0.0)
    touch = state.in_contact
    if sensing.force_noise:
        touch = touch & (force >= (sensing.touch_threshold if threshold is None else threshold))
    position = state.contact_position + sensing.position_noise * fingers[..., :3]
    tilt = sensing.normal_noise * _perpendicular(state.contact_normal, fingers[..., 3:5])
    normal = state.contact_normal + tilt
    length = np.sqrt((normal * normal).sum(axis=-1, keepdims=True))
    rows = touch[..., None]
    return replace(
        state,
        q=state.q + sensing.joint_noise * joints,
        in_contact=touch,
        contact_position=np.where(rows, position, 0.0),
        contact_normal=np.where(rows, normal / np.maximum(length, 1e-12), 0.0),
        contact_force=np.where(touch, force, 0.0),
    )


def _perpendicular(normal: Floats, amounts: Floats) -> Floats:
    """``amounts`` ``(..., 2)`` along two unit vectors perpendicular to ``normal``."""
    least = np.argmin(np.abs(normal), axis=-1)
    first = np.cross(normal, np.eye(3)[least])
    length = np.linalg.norm(first, axis=-1, keepdims=True)
    first = first / np.where(length > 0, length, 1.0)
    second = np.cross(normal, first)
    return amounts[..., :1] * first + amounts[..., 1:] * second


def _merged(
    chosen: Bools, one: dict[str, np.ndarray], other: dict[str, np.ndarray]
) -> dict[str, np.ndarray]:
    return {
        name: np.where(chosen.reshape(-1, *(1,) * (value.ndim - 1)), value, other[name])
        for name, value in one.items()
    }
