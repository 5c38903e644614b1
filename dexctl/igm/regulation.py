"""Regulation: pulls the held object back to where the grasp found it, beside the wanted motion."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from dexctl.exceptions import InvalidInput
from dexctl.rotations import cross, inverse, multiply, rotate
from dexctl.state import Floats, GraspState


class Regulation:
    """A corrective object twist from the deviation since the first call after a reset.

    Height is the position along the axis of the wanted rotation (z where the wanted twist has
    none), centring is across it, tilt is the angle between that axis, carried by the object, and
    where it pointed at first. Tilt needs `object_quaternion`.
    """

    def __init__(
        self, twist: Floats, *, height_gain: float, centring_gain: float, tilt_gain: float
    ) -> None:
        turn = twist[3:]
        size = np.linalg.norm(turn)
        self.axis = turn / size if size > 0 else np.array([0.0, 0.0, 1.0])
        along = np.outer(self.axis, self.axis)
        self._gain = height_gain * along + centring_gain * (np.eye(3) - along)
        self._tilt_gain = tilt_gain
        self.active = bool(height_gain or centring_gain or tilt_gain)
        self._position: Floats | None = None
        self._quaternion: Floats | None = None
        self._fresh: np.ndarray | None = None

    def reset(self, mask: ArrayLike | None = None) -> None:
        """Take the next state of the environments in ``mask`` (None: all) as the new reference."""
        if mask is None or self._fresh is None:
            self._position = self._quaternion = self._fresh = None
        else:
            self._fresh = self._fresh | np.asarray(mask, bool)

    def twist(self, state: GraspState, origin: Floats) -> Floats | float:
        """The correction ``(..., 6)``; 0.0 where nothing is regulated."""
        if not self.active:
            return 0.0
        reference = self._remember(state, origin)
        out = np.zeros((*state.batch_shape, 6))
        out[..., :3] = (reference - origin) @ self._gain
        if self._tilt_gain and state.object_quaternion is not None and self._quaternion is not None:
            turned = multiply(state.object_quaternion, inverse(self._quaternion))
            out[..., 3:] = self._tilt_gain * cross(rotate(turned, self.axis), self.axis)
        return out

    def _remember(self, state: GraspState, origin: Floats) -> Floats:
        """Keep the poses of environments just reset; where the objects were then."""
        quaternion = state.object_quaternion
        if self._position is None:
            self._position, self._quaternion = origin.copy(), quaternion
            self._fresh = np.zeros(state.batch_shape, bool)
            return self._position
        if self._position.shape != origin.shape:
            raise InvalidInput(
                f"the controller was reset for batch shape {self._position.shape[:-1]} and got "
                f"{state.batch_shape}; call reset() before the batch shape changes"
            )
        if self._fresh is not None and self._fresh.any():
            fresh = self._fresh[..., None]
            self._position = np.where(fresh, origin, self._position)
            if quaternion is not None and self._quaternion is not None:
                self._quaternion = np.where(fresh, quaternion, self._quaternion)
            self._fresh = np.zeros(state.batch_shape, bool)
        return self._position
