"""What callers say of where objects are, for those who follow them from there on."""

from __future__ import annotations

import numpy as np

from dexctl.exceptions import InvalidInput
from dexctl.state import Bools, Floats
from dexctl.validation import check_mask, numbers, shown, unit_quaternions


def placed(
    rows: Bools, count: int, position: Floats, quaternion: Floats
) -> tuple[Bools, Floats, Floats]:
    """Which of ``count`` objects are placed, where, and how they are turned.

    Args:
        rows: ``(N,)`` bool, K of them true.
        count: N.
        position: ``(K, 3)`` [m], or one ``(3,)`` for all.
        quaternion: wxyz, ``(K, 4)``, or one ``(4,)`` for all.

    Raises:
        InvalidInput: wrong shapes, numbers not finite, or no unit quaternions.
    """
    chosen, turn = check_mask(rows, (count,)), unit_quaternions("quaternion", quaternion)
    place, found = numbers("position", position, "positions [m]"), int(chosen.sum())
    for name, array, size in (("position", place, 3), ("quaternion", turn, 4)):
        if array.shape not in ((size,), (found, size)) or not np.isfinite(array).all():
            raise InvalidInput(
                f"{name} is {shown(array)}; expected {size} finite numbers, or {found} times {size}"
            )
    return chosen, place, turn
