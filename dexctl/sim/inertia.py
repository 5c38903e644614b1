"""Moments of inertia that no body can have, and those of links that have none."""

from __future__ import annotations

import numpy as np

from dexctl.state import Floats

MENDED_SHARE = 0.5
"""Up to which share of C principal moments A + B < C are mended; 1 is A = B = 0."""
LEAST_MASS = 1e-3
"""Of a link that moves and has none, nor a shape [kg]."""
LEAST_INERTIA = 1e-8
"""[kg m^2]"""


def mended_moments(moments: Floats) -> tuple[Floats | None, float]:
    """Principal moments with the smaller two raised where A + B < C, and by how much.

    Args:
        moments: ascending ``(3,)`` [kg m^2].

    Returns:
        ``(3,)``, or None where more than `MENDED_SHARE` is missing or one is negative; and the
        share of C that A + B lack, 0 where nothing does.
    """
    a, b, c = np.maximum(moments, LEAST_INERTIA * 1e-3)
    short = float((c - a - b) / c)
    if short > MENDED_SHARE or moments[0] < -1e-6 * c:
        return None, short
    if short <= 0:
        return np.array([a, b, c]), 0.0
    share = (c - a - b) / 2 * (1 + 1e-9)
    return np.array([a + share, b + share, c]), short
