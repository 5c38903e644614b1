"""Principal pivoting for small strictly convex box QPs: one in plain Python, many in numpy.

    minimise c'Hc - 2 b'c   subject to   lower <= c <= upper,

with H symmetric positive definite, a few variables wide. Every variable is either free, and then
its multiplier g_i = (Hc - b)_i is zero, or it is held at one of its bounds. From all free, the
variable furthest out of its bounds is held there, or a held one whose multiplier has the wrong
sign is freed, until there are none. Taking the least index instead, after some rounds, makes that
finite for every positive definite H (Murty 1974; with upper bounds: Judice and Pires, "A block
principal pivoting algorithm for large-scale strictly monotone linear complementarity problems",
1994). As long as every multiplier is right, the objective can only rise.

Each round factorises H anew for the variables that are free in it. Updating one tableau from round
to round takes fewer multiplications, but a variable that others nearly determine (fingers at one
contact) leaves a pivot there that is mostly round-off, and what is computed with it afterwards is
too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import inf

import numpy as np
from numpy.typing import NDArray

from dexctl.state import Bools, Floats

TOLERANCE = 1e-9  # on variables
ROUNDS = 300  # round-off could cycle between two sets that differ by less than it
_FREE, _LOWER, _UPPER = 0, -1, 1

Indices = NDArray[np.intp]
Sides = NDArray[np.int8]
FreeSolver = Callable[[Indices, Bools, Floats], Floats]
"""Called with the problems ``(p,)``, which of their variables are free ``(p, k)``, and the bounds
that the others are held at, 0 for free ones; returns the free variables, and the multipliers of
the others, ``(p, k)``."""


def greedy_rounds(k: int) -> int:
    """After so many rounds the least index is taken in place of the largest violation."""
    return 3 * k + 4


def solve_box(
    hessian: Sequence[Sequence[float]],
    linear: float,
    lower: Sequence[float],
    upper: Sequence[float],
    start: Sequence[float],
    tolerance: float,
    roof: float = inf,
) -> tuple[list[float], float]:
    """One box QP in plain Python floats.

    Args:
        hessian: H, k rows of k.
        linear: every entry of b, above 0.
        lower: k lower bounds.
        upper: k upper bounds; a variable whose bounds are equal is held there.
        start: the solution without bounds, where variables that are held already have theirs.
        tolerance: of multipliers.
        roof: a problem whose objective is sure to be above is left unsolved.

    Returns:
        The solution, and its objective; the objective is above ``roof`` where it was left.
    """
    k = len(lower)
    c = list(start)
    at = [
        _UPPER if low == high == x else _FREE for low, high, x in zip(lower, upper, c, strict=True)
    ]
    greedy = greedy_rounds(k)
    value = 0.0
    for count in range(ROUNDS):
        held = [i for i in range(k) if at[i] != _FREE]
        if count:
            _solve_free(hessian, linear, c, [i for i in range(k) if at[i] == _FREE], held)
        pick, worst, dual, move = -1, 0.0, True, _FREE
        value = -linear * sum(c)
        for i in range(k):
            if at[i] == _FREE:
                excess, below = c[i] - upper[i], lower[i] - c[i]
                side = _UPPER
                if below > excess:
                    excess, side = below, _LOWER
                if excess <= TOLERANCE:
                    continue
            else:
                line = hessian[i]
                multiplier = -linear
                for m in range(k):
                    multiplier += line[m] * c[m]
                value += c[i] * multiplier
                excess, side = at[i] * multiplier, _FREE
                if upper[i] == lower[i] or excess <= tolerance:
                    continue
                dual = False
                excess /= linear
            if pick < 0 or (excess > worst and count < greedy):
                pick, worst, move = i, excess, side
        if pick < 0 or (dual and value > roof):
            break
        at[pick] = move
        if move != _FREE:
            c[pick] = upper[pick] if move == _UPPER else lower[pick]
    return [min(max(x, low), high) for x, low, high in zip(c, lower, upper, strict=True)], value


def _solve_free(
    hessian: Sequence[Sequence[float]],
    linear: float,
    c: list[float],
    free: list[int],
    held: list[int],
) -> None:
    """The free variables, in place; elimination without row swaps, which H does not need."""
    rows = []
    for i in free:
        line = hessian[i]
        right = linear
        for m in held:
            right -= line[m] * c[m]
        row = [line[m] for m in free]
        row.append(right)
        for a, done in enumerate(rows):
            factor = row[a] / done[a]
            row = [x - factor * y for x, y in zip(row, done, strict=True)]
        rows.append(row)
    while rows:
        row = rows.pop()
        a = len(rows)
        value = row[-1]
        for m in range(a + 1, len(free)):
            value -= row[m] * c[free[m]]
        c[free[a]] = value / row[a]


def solve_box_batch(
    solve: FreeSolver,
    at: Sides,
    lower: Floats,
    upper: Floats,
    linear: Floats,
    tolerance: Floats,
    start: Floats | None = None,
    roof: Floats | None = None,
) -> tuple[Floats, Sides]:
    """Many box QPs; see :func:`solve_box`.

    Args:
        solve: solves for the free variables of some of the problems.
        at: where variables are at first, ``(p, k)``: 0 free, -1 the lower bound, 1 the upper;
            those whose bounds are equal stay at 1.
        lower: ``(p, k)``.
        upper: ``(p, k)``.
        linear: every entry of b, ``(p,)``, in the units of the multipliers.
        tolerance: of multipliers, ``(p,)``.
        start: the solutions for ``at``, ``(p, k)``, if they are known; only without multipliers
            that could be wrong.
        roof: ``(p,)``; problems whose objective is sure to be above are left unsolved.

    Returns:
        The solutions ``(p, k)``, and the sides that they are at. Problems left unsolved have
        forces within their bounds.
    """
    count, k = lower.shape
    solution, sides = np.empty(lower.shape), at.astype(np.int8)
    live, side, low, high = np.arange(count), sides, lower, upper
    movable = upper > lower
    for step in range(max(ROUNDS, 2 * greedy_rounds(k))):
        if not live.size:
            break
        free = side == _FREE
        held = np.where(side == _UPPER, high, low)
        y = solve(live, free, np.where(free, 0.0, held)) if step or start is None else start
        out = np.maximum(y - high, low - y)
        wrong = side * y * movable
        bad = np.where(free, out > TOLERANCE, wrong > tolerance[:, None])
        if step < greedy_rounds(k):
            excess = np.where(free, out, wrong / linear[:, None])
            pick = np.where(bad, excess, 0.0).argmax(axis=1)
        else:
            pick = bad.argmax(axis=1)
        going = bad.any(axis=1)
        if roof is not None and step:
            value = np.where(free, -linear[:, None] * y, held * (y - linear[:, None])).sum(axis=1)
            going &= (value <= roof) | (bad & ~free).any(axis=1)
        rows = np.arange(live.size)
        above = y[rows, pick] > high[rows, pick]
        moved = np.where(free[rows, pick], np.where(above, _UPPER, _LOWER), _FREE)
        if not going.all():
            done = ~going
            solution[live[done]] = np.where(free, y, held)[done]
            sides[live[done]] = side[done]
            live, side, low, high = live[going], side[going], low[going], high[going]
            movable, linear, tolerance = movable[going], linear[going], tolerance[going]
            pick, moved, rows = pick[going], moved[going], rows[: live.size]
            roof = None if roof is None else roof[going]
        elif not step:
            side = side.copy()
        side[rows, pick] = moved
    solution[live] = np.where(side == _UPPER, high, low)
    sides[live] = side
    return np.minimum(np.maximum(solution, lower), upper), sides
