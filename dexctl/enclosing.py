"""The smallest ball around a few points: its centre is in the middle of what fingertips hold."""

from __future__ import annotations

from functools import cache
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]  # as in dexctl.state, which stands above
Bools = NDArray[np.bool_]
_MOST = 8  # points up to which every set of them is tried; 154 sets
_RIDGE = 1e-9  # keeps points on a line, or in a plane, solvable; as a share of their distances


def enclosing_centre(points: Floats, chosen: Bools | None = None) -> Floats:
    """Centre ``(..., 3)`` of the smallest ball around points ``(..., m, 3)``.

    Unlike their mean it does not move towards where most of them are: three fingers against a
    thumb have it between them, and a finger that leaves moves it little. The smallest ball is the
    circumscribed one of two, three or four of the points (Welzl, 1991); for a few points it is
    quick to try all sets. Beyond eight, the middle of the box around them.

    Args:
        points: ``(..., m, 3)``.
        chosen: which of them count, ``(..., m)``; None: all. Without any: their mean.
    """
    count = points.shape[-2]
    if chosen is not None:
        # one that does not count stands where another is that does
        first = chosen.argmax(axis=-1)[..., None]
        place = np.where(chosen | ~chosen.any(axis=-1, keepdims=True), np.arange(count), first)
        points = np.take_along_axis(points, place[..., None], axis=-2)
    if count > _MOST:
        return (points.min(axis=-2) + points.max(axis=-2)) / 2
    sets = _circumcentre(points[..., _subsets(count), :])
    centres = np.concatenate([points[..., :1, :], sets], axis=-2)  # (..., sets, 3)
    away = ((centres[..., :, None, :] - points[..., None, :, :]) ** 2).sum(axis=-1).max(axis=-1)
    best = away.argmin(axis=-1)[..., None, None]
    centre: Floats = np.take_along_axis(centres, best, axis=-2)[..., 0, :]
    if chosen is not None:
        centre = np.where(chosen.any(axis=-1, keepdims=True), centre, points.mean(axis=-2))
    return centre


@cache
def _subsets(count: int) -> NDArray[np.intp]:
    """Sets of two, three and four of ``count`` points ``(sets, 4)``; the first fills small ones."""
    found = [one for size in (2, 3, 4) for one in combinations(range(count), size)]
    return np.array([(*one, *one[:1] * (4 - len(one))) for one in found], int).reshape(-1, 4)


def _circumcentre(points: Floats) -> Floats:
    """Of four points ``(..., 4, 3)`` in the flat through them, ``(..., 3)``; equal ones count once.

    The first point may come again, no other.
    """
    edge = points[..., 1:, :] - points[..., :1, :]
    gram = edge @ edge.swapaxes(-1, -2)
    square = np.einsum("...ii->...i", gram)
    ridge = _RIDGE * square.max(axis=-1) + np.finfo(float).tiny
    gram = gram + ridge[..., None, None] * np.eye(3)
    weight = np.linalg.solve(2.0 * gram, square[..., None])
    centre: Floats = points[..., 0, :] + (weight * edge).sum(axis=-2)
    return centre
