"""Reference: where held objects were at first, which regulation pulls them back to."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dexctl.exceptions import InvalidInput
from dexctl.rotations import cross, inverse, rotate
from dexctl.saved import batch_shape, check_names, copies, fill
from dexctl.state import Bools, Floats
from dexctl.validation import check_mask


class Reference:
    """Poses of N objects at their first step after a reset.

    Attributes:
        position: ``(N, 3)`` [m].
        carried_axis: the axis of the wanted rotation in the object's frame, ``(N, 3)``.
        known: which environments have taken their reference, ``(N,)``.
    """

    def __init__(self, axis: Floats) -> None:
        self._axis = axis
        self._allocate(0)

    def _allocate(self, count: int) -> None:
        self.position = np.zeros((count, 3))
        self.carried_axis = np.zeros((count, 3))
        self.known: Bools = np.zeros(count, bool)
        self.complete = count == 0

    def reset(self, mask: ArrayLike | None = None) -> None:
        """Take the next step of the environments in ``mask`` (None: all) as the reference."""
        if mask is None:
            self._allocate(0)
            return
        if not len(self.known):
            return
        self.known = self.known & ~check_mask(mask, self.known.shape)
        self.complete = bool(self.known.all())

    def meet(self, count: int) -> None:
        """Make room for N environments, the first time they come.

        Raises:
            InvalidInput: another number came before, with no reset in between.
        """
        if len(self.known) == count:
            return
        if len(self.known):
            raise InvalidInput(
                f"the controller was reset for {len(self.known)} hands and got {count}; call "
                "reset() before the batch shape changes"
            )
        self._allocate(count)

    def _arrays(self) -> dict[str, np.ndarray]:
        return {"position": self.position, "carried_axis": self.carried_axis, "known": self.known}

    def state_dict(self) -> dict[str, Any]:
        """The references, to be given to `load_state_dict`."""
        return copies(self._arrays())

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Continue with saved references.

        Raises:
            InvalidInput: they are none, or of another number of environments than there are now.
        """
        check_names("a reference", saved, self._arrays())
        (count,) = batch_shape("a reference", saved, "known") or (0,)
        if count:
            self.meet(count)
        self._allocate(count)
        fill("a reference", self._arrays(), saved)
        self.complete = bool(self.known.all())

    def give(self, origin: Floats, quaternion: Floats) -> None:
        """Set the reference of all N environments, ``(N, 3)`` and ``(N, 4)``."""
        self.meet(len(origin))
        self.known[:] = False
        self.learn(origin, quaternion)

    def carry(self, step: Floats, quaternion: Floats) -> None:
        """Move the references with the objects by what was wanted of them in one control period.

        Args:
            step: (linear [m], angular [rad]), ``(N, 6)``; a turn about the axis moves nothing.
            quaternion: of the objects, ``(N, 4)``, or with no rows.
        """
        self.position = self.position + np.where(self.known[:, None], step[:, :3], 0.0)
        if len(quaternion):
            tilted = self.carried_axis - rotate(
                inverse(quaternion), cross(step[:, 3:], np.broadcast_to(self._axis, (len(step), 3)))
            )
            length = np.sqrt((tilted * tilted).sum(axis=-1, keepdims=True))
            tilted = tilted / np.maximum(length, 1e-12)
            self.carried_axis = np.where(self.known[:, None], tilted, self.carried_axis)

    def learn(self, origin: Floats, quaternion: Floats) -> None:
        """Take the reference of the environments that have none; quaternions may be missing."""
        new = ~self.known
        self.position[new] = origin[new]
        if len(quaternion):
            self.carried_axis[new] = rotate(inverse(quaternion[new]), self._axis)
        self.known = np.ones_like(self.known)
        self.complete = True
