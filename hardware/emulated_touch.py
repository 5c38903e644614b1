"""What the emulated hand senses: fingertips as a tactile source, and a tracker of the object."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from dexctl.state import Floats
from hardware.emulator import Emulator
from hardware.tactile import MOST_AGE, TRUSTED_FORCE, TactileReading, judge
from hardware.tracking import MOST_AGE as MOST_POSE_AGE
from hardware.tracking import TrackedPose


class EmulatedTactile:
    """What the emulator's MuJoCo hand feels, asked over its side channel.

    Args:
        emulator: with MuJoCo dynamics.
        trusted_force: weakest force that counts as touch [N].
        most_age: older readings are stale [s].

    Attributes:
        truth: what no real hand knows, of the last reading: ``object_position`` [m],
            ``object_quaternion`` wxyz; {} without an object.
    """

    def __init__(
        self,
        emulator: Emulator,
        *,
        trusted_force: float = TRUSTED_FORCE,
        most_age: float = MOST_AGE,
    ) -> None:
        self._emulator = emulator
        self._trusted_force, self._most_age = trusted_force, most_age
        self.truth: dict[str, Any] = {}

    def read(self) -> TactileReading:
        """What the fingertips feel now."""
        said = self._emulator.touch()
        now = time.monotonic()
        if said is None:
            raise ValueError("the emulator has no fingertips: start it with MuJoCo dynamics")
        self.truth = {
            key: said[key]
            for key in ("object_position", "object_quaternion")
            if said.get(key) is not None
        }
        force: Floats = np.asarray(said["force"], float)
        return judge(
            np.asarray(said["position"], float),
            np.asarray(said["normal"], float),
            force,
            np.full(len(force), now - float(said["age"])),
            now,
            self._trusted_force,
            self._most_age,
        )

    def object_pose(self) -> tuple[Floats, Floats] | None:
        """Where the object is now, ``(3,)`` [m] and wxyz ``(4,)``; None: there is none."""
        self.read()
        if not self.truth:
            return None
        position, quaternion = self.truth["object_position"], self.truth["object_quaternion"]
        return np.asarray(position, float), np.asarray(quaternion, float)

    def close(self) -> None:
        """Nothing to let go of: the emulator is its starter's."""


class EmulatedTracker:
    """Where the emulator's object is, as badly and as late as its scene's tracker tells.

    Args:
        emulator: with MuJoCo dynamics that hold an object.
        latency: how late what it tells is [s].
    """

    def __init__(self, emulator: Emulator, latency: float = 0.0) -> None:
        self._emulator, self._latency = emulator, latency

    def read(self) -> TrackedPose | None:
        """Where it is told to be now; None: there is no object."""
        said = self._emulator.touch()
        if said is None or said.get("tracked_position") is None:
            return None
        return TrackedPose(
            np.asarray(said["tracked_position"], float),
            np.asarray(said["tracked_quaternion"], float),
            time.monotonic() - self._latency,
            self._latency > MOST_POSE_AGE,
        )

    def close(self) -> None:
        """Nothing to let go of: the emulator is its starter's."""
