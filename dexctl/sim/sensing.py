"""Sensing: how badly and how late a hand's sensors tell what is."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dexctl.state import Bools, Floats, GraspState
from dexctl.streams import Streams, StreamsState
from dexctl.validation import check_numbers

_SENSED = (
    "q", "in_contact", "contact_position", "contact_normal", "contact_force",
    "object_position", "object_quaternion", "time", "age",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Sensing:
    """White noise and latency of a hand's sensors. Set-points are known exactly.

    Raises:
        InvalidInput: a number that is not finite, or below zero.
    """

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
    """How old what is sensed is, rounded to control steps [s]."""

    def __post_init__(self) -> None:
        check_numbers(self, not_negative=tuple(self.__dataclass_fields__))

    @property
    def noisy(self) -> bool:
        """Whether what is sensed differs from the truth."""
        return any(getattr(self, name) > 0 for name in NOISES)


NOISES = ("joint_noise", "position_noise", "normal_noise", "force_noise", "force_noise_share")
"""The settings of `Sensing` that are noise."""


class Sensor:
    """The sensors of N hands.

    At the start of an episode they tell what they told first, until there is something older than
    the latency.

    Args:
        sensing: how they sense.
        streams: of the noise, ``(N,)``; each environment draws its own.
        control_period: [s].

    Attributes:
        streams: as given.
    """

    def __init__(self, sensing: Sensing, streams: Streams, control_period: float) -> None:
        self._sensing, self.streams = sensing, streams
        self._steps = round(sensing.sensor_latency / control_period)
        self._past: list[dict[str, np.ndarray]] = []  # steps + 1 readings, the oldest first

    def __call__(self, state: GraspState, begin: Bools | None = None) -> GraspState:
        """What is sensed of ``state`` ``(N,)``.

        Args:
            state: how things are.
            begin: None where a control step has passed in every environment; else those ``(N,)``
                whose episode begins with ``state``. The rows of the others are to be thrown away.
        """
        seen = blurred(state, self._sensing, self.streams, begin)
        if not self._steps:
            return seen
        now = {name: getattr(seen, name) for name in _SENSED if getattr(seen, name) is not None}
        now = {
            name: np.broadcast_to(v, (len(state.q), *np.shape(v)[1:])) for name, v in now.items()
        }
        if not self._past:
            self._past = [now] * (self._steps + 1)
        elif begin is None:
            self._past = [*self._past[1:], now]
        else:
            self._past = [_merged(begin, now, one) for one in self._past]
        then = self._past[0]
        age = then["age"] + now["time"] - then["time"]
        return replace(seen, **{**then, "time": now["time"], "age": age})

    def save(self) -> dict[str, object]:
        """All that decides what is to come, to be given to `restore`."""
        return {"streams": self.streams.save()._asdict(), "past": [dict(one) for one in self._past]}

    def restore(self, saved: dict) -> None:
        """Go on from what `save` returned."""
        self.streams.restore(StreamsState(**saved["streams"]))
        self._past = [dict(one) for one in saved["past"]]


def blurred(
    state: GraspState, sensing: Sensing, streams: Streams, mask: Bools | None = None
) -> GraspState:
    """``state`` ``(N,)`` with noise on it; only the streams in ``mask`` move on."""
    if not sensing.noisy:
        return state
    count, d = state.q.shape
    m = state.in_contact.shape[1]
    drawn = streams.normal((d + 7 * m,), mask)
    joints, fingers = drawn[:, :d], drawn[:, d:].reshape(count, m, 7)
    factor = np.maximum(1.0 + sensing.force_noise_share * fingers[..., 6], 0.0)
    force = np.maximum(state.contact_force * factor + sensing.force_noise * fingers[..., 5], 0.0)
    touch = state.in_contact
    if sensing.force_noise:
        touch = touch & (force >= sensing.touch_threshold)
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
