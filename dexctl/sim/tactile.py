"""Tactile sensing: MuJoCo contact sensors between bodies, read for all environments at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np

from dexctl.exceptions import InvalidInput
from dexctl.state import Bools, Floats
from dexctl.streams import Streams

_FIELD = mujoco.mjtConDataField
_MAXFORCE, _NETFORCE = 2, 3  # the sensor's `reduce` codes: strongest contacts first; their sum
# Contacts kept per fingertip, strongest first. A tip seldom has more: one on a sphere or a mesh,
# two where a capsule lies along a face or two parts of an object meet.
_SLOTS = 3
_TIP_FIELDS = ("FOUND", "FORCE", "POS", "NORMAL")
_WIDTH = 10  # found 1, force 3 (contact frame: normal first), position 3, normal 3


@dataclass(frozen=True, kw_only=True)
class Tactile:
    """How well the fingertips feel.

    Attributes:
        threshold: weakest normal force that counts as touch [N].
        position_noise: standard deviation of each contact coordinate [m].
        normal_noise: standard deviation of the normal's tilt about two axes [rad].
        force_noise: standard deviation of the normal force [N].
        latency: age of the tactile reading beyond the physics step that it always has [s];
            rounded to physics steps.
    """

    threshold: float = 0.05
    position_noise: float = 0.0
    normal_noise: float = 0.0
    force_noise: float = 0.0
    latency: float = 0.0

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise InvalidInput(f"Tactile.{name} is {value}; expected a finite number >= 0")

    @property
    def noisy(self) -> bool:
        """Whether readings differ from the truth."""
        return max(self.position_noise, self.normal_noise, self.force_noise) > 0


class TouchReading(NamedTuple):
    """What the fingertips feel; rows of fingers that do not touch are zero.

    Attributes:
        in_contact: ``(N, m)`` bool.
        position: ``(N, m, 3)`` [m], world frame.
        normal: unit, from the fingertip into the object, ``(N, m, 3)``.
        force: normal force, ``(N, m)`` [N].
        other_contact: force between the object and everything but the fingertips, ``(N,)`` [N].
    """

    in_contact: Bools
    position: Floats
    normal: Floats
    force: Floats
    other_contact: Floats

    def copy(self) -> TouchReading:
        """The same numbers in arrays of their own."""
        return TouchReading(
            self.in_contact.copy(),
            self.position.copy(),
            self.normal.copy(),
            self.force.copy(),
            self.other_contact.copy(),
        )

    def replaced(self, mask: Bools, new: TouchReading) -> TouchReading:
        """This reading with the environments in ``mask`` ``(N,)`` taken from ``new``."""
        fingers, vectors = mask[:, None], mask[:, None, None]
        return TouchReading(
            np.where(fingers, new.in_contact, self.in_contact),
            np.where(vectors, new.position, self.position),
            np.where(vectors, new.normal, self.normal),
            np.where(fingers, new.force, self.force),
            np.where(mask, new.other_contact, self.other_contact),
        )


def add_sensors(spec: mujoco.MjSpec, fingertips: tuple[str, ...], others: tuple[str, ...]) -> None:
    """Add a contact sensor from each body named to the body "object".

    The data of `fingertips` keep each contact apart; of `others`, one net force per body, so that
    two bodies squeezing the object do not cancel out.
    """

    def add(name: str, body: str, fields: tuple[str, ...], reduce: int, slots: int) -> None:
        bits = sum(1 << int(getattr(_FIELD, f"mjCONDATA_{field}")) for field in fields)
        spec.add_sensor(
            name=name,
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=mujoco.mjtObj.mjOBJ_BODY,
            objname=body,
            reftype=mujoco.mjtObj.mjOBJ_BODY,
            refname="object",
            intprm=[bits, reduce, slots],
        )

    for i, body in enumerate(fingertips):
        add(f"touch_{i}", body, _TIP_FIELDS, _MAXFORCE, _SLOTS)
    for body in others:
        add(f"other_{body}", body, ("FORCE",), _NETFORCE, 1)


class TouchSensors:
    """Where the readings of one scene lie in its ``sensordata``, and how to read them."""

    def __init__(self, model: mujoco.MjModel, n_fingers: int) -> None:
        names = [model.sensor(i).name for i in range(model.nsensor)]
        tips = [i for i, name in enumerate(names) if name.startswith("touch_")]
        others = [i for i, name in enumerate(names) if name.startswith("other_")]
        first = int(model.sensor_adr[tips[0]])
        self._n_fingers = n_fingers
        self._start = first
        self._middle = first + n_fingers * _SLOTS * _WIDTH
        self._end = self._middle + 3 * len(others)

    @property
    def columns(self) -> slice:
        """The part of ``sensordata`` that `read` wants."""
        return slice(self._start, self._end)

    def read(self, data: Floats, threshold: float) -> TouchReading:
        """Readings of ``data`` ``(N, columns)``.

        The force of a finger is the sum over its contacts, position and normal are their
        averages weighted by force.
        """
        count = self._middle - self._start
        slots = data[:, :count].reshape(-1, self._n_fingers, _SLOTS, _WIDTH)
        # the normal component of an absent contact reads zero
        strength = np.maximum(slots[..., 1], 0.0)
        force = strength.sum(-1)
        touch = force >= max(threshold, 1e-12)
        weighted = np.einsum("nfs,nfsk->nfk", strength, slots[..., 4:10])
        weighted /= np.where(touch, force, 1.0)[..., None]
        weighted *= touch[..., None]
        normal = weighted[..., 3:]
        length = np.sqrt(np.einsum("nfk,nfk->nf", normal, normal))
        normal = normal / np.where(length > 1e-9, length, 1.0)[..., None]
        other = data[:, count:].reshape(len(data), -1, 3)
        other_force = np.sqrt(np.einsum("nbk,nbk->nb", other, other)).sum(-1)
        return TouchReading(touch, weighted[..., :3], normal, force * touch, other_force)


def blur(
    reading: TouchReading, tactile: Tactile, streams: Streams, mask: Bools | None = None
) -> TouchReading:
    """The reading with the noise of ``tactile``, from one random stream per environment."""
    fingers = reading.force.shape[1]
    noise = streams.normal((fingers, 6), mask).reshape(-1, fingers, 6)
    touch = reading.in_contact
    force = np.maximum(reading.force + tactile.force_noise * noise[..., 0], 0.0)
    touch = touch & (force >= tactile.threshold)
    position = reading.position + tactile.position_noise * noise[..., 1:4]
    tilt = tactile.normal_noise * _perpendicular(reading.normal, noise[..., 4:6])
    normal = reading.normal + tilt
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    normal = normal / np.where(length > 0, length, 1.0)
    rows = touch[..., None]
    return TouchReading(touch, position * rows, normal * rows, force * touch, reading.other_contact)


def _perpendicular(normal: Floats, amounts: Floats) -> Floats:
    """``amounts`` ``(..., 2)`` along two unit vectors perpendicular to ``normal``."""
    least = np.argmin(np.abs(normal), axis=-1)
    first = np.cross(normal, np.eye(3)[least])
    length = np.linalg.norm(first, axis=-1, keepdims=True)
    first = first / np.where(length > 0, length, 1.0)
    second = np.cross(normal, first)
    return amounts[..., :1] * first + amounts[..., 1:] * second
