"""StateRows: states of one scene as rows that can be kept, chosen from and put back anywhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from dexctl.exceptions import InvalidInput
from dexctl.state import Floats


@dataclass(frozen=True, kw_only=True, eq=False)
class StateRows:
    """S states of one scene, half a kilobyte each; of `BatchSimulator.rows`, for its `place`.

    Attributes:
        physics: full physics states (time, positions, velocities, activations), ``(S, size)``.
        q_target: set-points ``(S, d)`` [rad].

    Raises:
        InvalidInput: arrays of different lengths.
    """

    physics: Floats
    q_target: Floats

    def __post_init__(self) -> None:
        shapes = self.physics.shape, self.q_target.shape
        if len(shapes[0]) != 2 or len(shapes[1]) != 2 or shapes[0][0] != shapes[1][0]:
            raise InvalidInput(f"StateRows of the shapes {shapes}; expected (S, size) and (S, d)")

    def __len__(self) -> int:
        return len(self.physics)

    def take(self, index: ArrayLike) -> StateRows:
        """Some of them, copied: indices ``(K,)``, which may repeat, or a mask ``(S,)``."""
        chosen = np.asarray(index)
        return StateRows(physics=self.physics[chosen], q_target=self.q_target[chosen])

    @classmethod
    def concatenate(cls, parts: Sequence[StateRows]) -> StateRows:
        """All of ``parts``, one after the other.

        Raises:
            InvalidInput: none, or of different scenes.
        """
        widths = {(part.physics.shape[1], part.q_target.shape[1]) for part in parts}
        if len(widths) != 1:
            raise InvalidInput(f"StateRows of {len(widths)} kinds of scenes; expected one")
        return cls(
            physics=np.concatenate([part.physics for part in parts]),
            q_target=np.concatenate([part.q_target for part in parts]),
        )
