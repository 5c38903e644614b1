"""Tactile sensing: MuJoCo contact sensors between bodies, read for all environments at once."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np

from dexctl.rotations import cross
from dexctl.state import Bools, Floats

_FIELD = mujoco.mjtConDataField
_MAXFORCE, _NETFORCE = 2, 3  # the sensor's `reduce` codes: strongest contacts first; their sum
# Contacts kept per fingertip, strongest first. A tip seldom has more: one on a sphere or a mesh,
# two where a capsule lies along a face or two parts of an object meet.
_SLOTS = 3
_TIP_FIELDS = ("FOUND", "FORCE", "POS", "NORMAL", "TANGENT")
# found 1, force 3 (contact frame: normal, tangent, and what is across both), position 3, normal 3,
# tangent 3
_WIDTH = 13


class TouchReading(NamedTuple):
    """What the fingertips feel; rows of fingers that do not touch are zero.

    Attributes:
        in_contact: ``(N, m)`` bool.
        position: ``(N, m, 3)`` [m], world frame.
        normal: unit, from the fingertip into the object, ``(N, m, 3)``.
        force: normal force, ``(N, m)`` [N].
        other_contact: force between the object and everything but the fingertips, ``(N,)`` [N].
        net_force: with which each fingertip acts on the object, friction included, ``(N, m, 3)``
            [N], world frame; also where it is too weak to count as touch.
    """

    in_contact: Bools
    position: Floats
    normal: Floats
    force: Floats
    other_contact: Floats
    net_force: Floats

    def placed(self, mask: Bools, new: TouchReading) -> TouchReading:
        """This reading with the environments in ``mask`` ``(N,)`` from the rows of ``new``."""
        found = []
        for before, value in zip(self, new, strict=True):
            after = before.copy()
            after[mask] = value
            found.append(after)
        return TouchReading(*found)


def add_sensors(
    spec: mujoco.MjSpec, fingertips: tuple[str, ...], others: tuple[str, ...], held: str
) -> None:
    """Add a contact sensor from each body named to the body `held`.

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
            refname=held,
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
        self._others = len(others)
        self._end = self._middle + 3 * self._others

    @property
    def columns(self) -> slice:
        """The part of ``sensordata`` that `read` wants."""
        return slice(self._start, self._end)

    def read(self, data: Floats, threshold: float) -> TouchReading:
        """Readings of ``data`` ``(N, columns)``.

        The force of a finger is the sum over its contacts, position and normal are their
        averages weighted by force; its net force is the sum of all that its contacts transmit.
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
        other = data[:, count:].reshape(len(data), self._others, 3)
        other_force = np.sqrt(np.einsum("nbk,nbk->nb", other, other)).sum(-1)
        # the contact's frame: rows normal, tangent, and what is across both
        first, second = slots[..., 7:10], slots[..., 10:13]
        net = slots[..., 1:2] * first + slots[..., 2:3] * second
        net += slots[..., 3:4] * cross(first, second)
        return TouchReading(
            touch, weighted[..., :3], normal, force * touch, other_force, net.sum(axis=2)
        )
