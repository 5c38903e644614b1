"""Episodes: what each environment's episode has come to so far."""

from __future__ import annotations

import numpy as np

from dexctl.rotations import inverse, multiply
from dexctl.state import Bools, Floats
from learning.envs.reward import shortest, twist_angle


class Episodes:
    """Lengths, returns and rotations of N episodes.

    Args:
        count: N.
        axis: unit vector that rotation is counted about, ``(3,)``.

    Attributes:
        length: control steps so far, ``(N,)``.
        returns: sum of rewards so far, ``(N,)`` [rad/s].
        rotation: unwrapped turn about the axis since the start, ``(N,)`` [rad].
    """

    def __init__(self, count: int, axis: Floats) -> None:
        self._axis = axis
        self.length = np.zeros(count, np.int64)
        self.returns = np.zeros(count)
        self.rotation = np.zeros(count)
        self._angle = np.zeros(count)  # of the twist since the start, not unwrapped
        self._start = np.tile((1.0, 0.0, 0.0, 0.0), (count, 1))

    def begin(self, chosen: Bools, quaternion: Floats) -> None:
        """Begin anew in the environments chosen, with the object at ``quaternion`` ``(N, 4)``."""
        self._start[chosen] = quaternion[chosen]
        for numbers in (self.length, self.returns, self.rotation, self._angle):
            numbers[chosen] = 0

    def add(self, reward: Floats, quaternion: Floats) -> None:
        """Count a step that was worth ``reward`` and left the object at ``quaternion``."""
        angle = twist_angle(multiply(quaternion, inverse(self._start)), self._axis)
        self.rotation += shortest(angle - self._angle)
        self._angle = angle
        self.length += 1
        self.returns += reward

    def save(self) -> dict[str, np.ndarray]:
        """Copies of everything, to be given to `restore`."""
        return {
            "length": self.length.copy(),
            "returns": self.returns.copy(),
            "rotation": self.rotation.copy(),
            "angle": self._angle.copy(),
            "start": self._start.copy(),
        }

    def restore(self, saved: dict[str, np.ndarray]) -> None:
        """Continue from what `save` returned."""
        self.length, self.returns = saved["length"].copy(), saved["returns"].copy()
        self.rotation, self._angle = saved["rotation"].copy(), saved["angle"].copy()
        self._start = saved["start"].copy()
