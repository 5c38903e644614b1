"""What a servo hand says about itself, as named tuples."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dexctl.state import Bools, Floats
from hardware.state_machine import Torque


class JointSample(NamedTuple):
    """What the servos said last; a joint that did not answer keeps what it said before.

    Attributes:
        q: ``(d,)`` [rad].
        velocity: ``(d,)`` [rad/s].
        torque: by the servo's current, ``(d,)`` [N m].
        fresh: joints that answered this time, ``(d,)`` bool.
        missed: how many times in a row each has not, ``(d,)`` int.
        alert: servos that report a hardware error, ``(d,)`` bool.
        taken: when each was read, on the clock of ``time.monotonic``, ``(d,)`` [s].
        time: now, on that clock [s].
    """

    q: Floats
    velocity: Floats
    torque: Floats
    fresh: Bools
    missed: NDArray[np.int64]
    alert: Bools
    taken: Floats
    time: float

    @property
    def age(self) -> float:
        """Of the oldest joint [s]."""
        return float(self.time - self.taken.min())


class Health(NamedTuple):
    """How the servos are, as far as asked; NaN (errors: -1) where a servo did not answer.

    Attributes:
        voltage: ``(d,)`` [V].
        temperature: ``(d,)`` [degC].
        error: hardware error bits, ``(d,)`` int.
        watchdog: whether the bus watchdog has tripped, ``(d,)`` bool.
        limp: whether the servo itself says that its torque is off, ``(d,)`` bool.
    """

    voltage: Floats
    temperature: Floats
    error: NDArray[np.int64]
    watchdog: Bools
    limp: Bools


class TorqueReport(NamedTuple):
    """What is known of the torque.

    Attributes:
        state: OFF only where every servo has confirmed it.
        message: for people, servo IDs named.
    """

    state: Torque
    message: str
