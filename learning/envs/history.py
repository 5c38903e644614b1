"""History: what was observed in earlier control steps, beside what is observed now."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dexctl.exceptions import InvalidInput
from dexctl.state import Bools
from dexctl.validation import shown

_LONGEST = 100  # control steps


class History:
    """Keeps the last observations of N hands, and gives some of them as one vector.

    So a policy without a memory of its own can tell what changes: how far a joint follows its
    set-point, from which side a finger came. Where an episode begins, everything has always been
    as it is now.

    Args:
        size: k, of one observation.
        steps: how many control steps ago, in this order; none: there is only now.

    Attributes:
        steps: as given.
        size: of the vector, ``(1 + len(steps)) k``.

    Raises:
        InvalidInput: not whole numbers of steps, or one twice.
    """

    def __init__(self, size: int, steps: Sequence[int] = ()) -> None:
        self.steps = check_steps(steps)
        self.size = (1 + len(self.steps)) * size
        self._kept = np.zeros((0, 1 + max(self.steps, default=0), size), np.float32)
        self._chosen = [0, *self.steps]

    def __len__(self) -> int:
        """N; 0 before the first observation."""
        return len(self._kept)

    def clear(self) -> None:
        """Forget everything, and how many hands there were."""
        self._kept = self._kept[:0]

    def begin(self, seen: NDArray[np.float32], chosen: Bools) -> None:
        """Episodes begin in the hands ``chosen`` ``(N,)``, with observations ``(N, k)``."""
        if not len(self):
            self._kept = np.repeat(seen[:, None], self._kept.shape[1], axis=1)
        self._kept[chosen] = seen[chosen, None]

    def add(self, seen: NDArray[np.float32]) -> None:
        """A control step later, ``seen`` ``(N, k)`` is observed."""
        before = self._kept if len(self) else np.repeat(seen[:, None], self._kept.shape[1], axis=1)
        self._kept = np.concatenate([seen[:, None], before[:, :-1]], axis=1)

    def look(self) -> NDArray[np.float32]:
        """What is observed now, and what was ``steps`` ago, ``(N, size)``."""
        return self._kept[:, self._chosen].reshape(len(self._kept), -1)

    def save(self) -> NDArray[np.float32]:
        """All that is kept, to be given to `restore`."""
        return self._kept.copy()

    def restore(self, saved: Any) -> None:
        """Go on from what `save` gave.

        Raises:
            InvalidInput: it is of other observations.
        """
        if not isinstance(saved, np.ndarray) or saved.shape[1:] != self._kept.shape[1:]:
            shape = saved.shape[1:] if isinstance(saved, np.ndarray) else shown(saved)
            raise InvalidInput(
                f"the saved observations are {shape} for each hand; expected {self._kept.shape[1:]}"
            )
        self._kept = saved.astype(np.float32)


def check_steps(steps: Sequence[int]) -> tuple[int, ...]:
    """The steps as a tuple.

    Raises:
        InvalidInput: they are not whole numbers from 1 to 100, or one is there twice.
    """
    found = tuple(steps)
    whole = all(isinstance(one, (int, np.integer)) and 1 <= one <= _LONGEST for one in found)
    if not whole or any(isinstance(one, bool) for one in found) or len(set(found)) < len(found):
        raise InvalidInput(
            f"history is {shown(found)}; expected different whole numbers of control steps, 1 to "
            f"{_LONGEST}"
        )
    return tuple(int(one) for one in found)
