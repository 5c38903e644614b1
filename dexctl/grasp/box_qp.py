"""Principal pivoting for small strictly convex box QPs: one in plain Python, many in numpy.

    minimise c'Hc - 2 b'c   subject to   lower <= c <= upper,

with H symmetric positive definite, a few variables wide. The method exchanges a variable with
its multiplier, one at a time, in a tableau that starts as H^-1 (all variables free), until every
free variable is within its bounds and every multiplier has the right sign. That is the linear
complementarity view of the box QP; taking the least violated index first makes it finite for
every positive definite H (Murty 1974; with upper bounds: Judice and Pires, "A block principal
pivoting algorithm for large-scale strictly monotone linear complementarity problems", 1994).
Quicker orders are tried first.

A tableau T maps changes of the independent values to changes of the dependent ones, y. While i
is free, its variable c_i is dependent and its multiplier g_i = (Hc - b)_i is held at 0; while it
is at a bound, g_i is dependent and c_i is held. A variable whose row and column of T are zero
never moves.
"""

from __future__ import annotations

from math import inf

import numpy as np
from numpy.typing import NDArray

from dexctl.state import Bools, Floats

TOLERANCE = 1e-9  # on bounds and multipliers; callers scale H to an identity plus a PSD part
_FREE, _LOWER, _UPPER = 0, -1, 1
_MAX_PIVOTS = 5000  # round-off could cycle between two sets that differ by less than it


def solve_box(
    table: list[list[float]],
    y: list[float],
    lower: list[float],
    upper: list[float],
    roof: float = inf,
) -> tuple[list[float], float]:
    """One box QP in plain Python floats, from its unconstrained solution.

    Args:
        table: H^-1, k rows of k; overwritten.
        y: H^-1 b; overwritten.
        lower: k lower bounds.
        upper: k upper bounds.
        roof: a problem whose objective is sure to rise above this is left unsolved.

    Returns:
        The solution, and how far its objective is above the one unconstrained.
    """
    k = len(y)
    at = [_FREE] * k
    rise = 0.0
    greedy = 3 * k + 4  # largest violation first for this many pivots, then the least index
    for count in range(_MAX_PIVOTS):
        pick, worst, dual = -1, TOLERANCE, True
        for i in range(k):
            value, side = y[i], at[i]
            if side == _FREE:
                violation = value - upper[i]
                if violation <= TOLERANCE:
                    violation = lower[i] - value
            else:
                violation = side * value
                if violation > TOLERANCE:
                    if upper[i] == lower[i]:
                        continue
                    dual = False
            if violation > worst:
                pick = i
                if count >= greedy:
                    break
                worst = violation
        # With every multiplier right, what is left out can only raise the objective.
        if pick < 0 or (dual and rise > roof):
            break
        row = table[pick]
        inverse = 1.0 / row[pick]
        if at[pick] == _FREE:
            side = _UPPER if y[pick] > upper[pick] else _LOWER
            held = upper[pick] if side == _UPPER else lower[pick]
            step = (held - y[pick]) * inverse
            rise += (held - y[pick]) * step
            entering = step
        else:
            side = _FREE
            held = 0.0
            step = -y[pick] * inverse
            rise += y[pick] * step
            entering = step + (upper[pick] if at[pick] == _UPPER else lower[pick])
        at[pick] = side
        # The pivot: every other row sheds its share of the pivot row.
        scaled = [-b * inverse for b in row]
        for i in range(k):
            if i != pick:
                other = table[i]
                f = other[pick]
                y[i] += f * step
                other = [a + f * b for a, b in zip(other, scaled, strict=True)]
                other[pick] = f * inverse
                table[i] = other
        scaled[pick] = inverse
        table[pick] = scaled
        y[pick] = entering
    solution = []
    for i in range(k):
        side = at[i]
        value = y[i] if side == _FREE else (lower[i] if side == _LOWER else upper[i])
        solution.append(min(max(value, lower[i]), upper[i]))
    return solution, rise


class BoxBatch:
    """Many box QPs at once, the batch in the last axis.

    Attributes:
        table: ``(k, k, n)``, H^-1 at the start. A variable held in advance has zero row and
            column, and its value between its bounds.
        y: ``(k, n)``, the unconstrained solution at the start.
        lower: ``(k, n)``.
        upper: ``(k, n)``.
        at: ``(k, n)`` int8, 0 free, -1 at the lower bound, 1 at the upper.
        rise: ``(n,)``, objective above the unconstrained one.
    """

    def __init__(self, table: Floats, y: Floats, lower: Floats, upper: Floats) -> None:
        self.table, self.y, self.lower, self.upper = table, y, lower, upper
        self.at = np.zeros(y.shape, np.int8)
        self.rise = np.zeros(y.shape[-1])

    def solve(self, roof: Floats | None = None, *, keep_table: bool = False) -> None:
        """Pivot until every problem is solved; see :func:`solve_box`.

        Args:
            roof: ``(n,)``; problems whose ``rise`` is sure to end above it are left unsolved,
                with a ``rise`` above it. None: all are solved.
            keep_table: keep ``table`` up to date, for :meth:`shift`. Otherwise it is spoilt.
        """
        k, count = self.y.shape
        live = everyone = np.arange(count)
        table, rise = self.table, self.rise
        # Side by side, so that one indexing takes the problems that are still open.
        movable = np.where(self.upper > self.lower, 1.0, 0.0)
        parts = np.stack([self.y, self.at.astype(float), self.lower, self.upper, movable])
        for step in range(_MAX_PIVOTS):
            y, at, lower, upper, movable = parts
            wrong = at * y
            free = at == _FREE
            out = np.maximum(y - upper, lower - y)
            violation = np.where(free, out, wrong * movable)
            if step < 3 * k + 4:
                pick = violation.argmax(axis=0)
            else:
                pick = (violation > TOLERANCE).argmax(axis=0)
            going = violation[pick, everyone] > TOLERANCE
            if roof is not None:
                # With every multiplier right, what is left out can only raise the objective.
                going &= (rise <= roof) | (wrong > TOLERANCE).any(axis=0)
            left = int(np.count_nonzero(going))
            if left < live.size:
                done = np.flatnonzero(~going)
                where = live[done]
                self.y[:, where] = y.take(done, axis=-1)
                self.at[:, where] = at.take(done, axis=-1)
                self.rise[where] = rise[done]
                if keep_table:
                    self.table[:, :, where] = table[:, :, done]
                if not left:
                    return
                on = np.flatnonzero(going)
                live, pick, everyone = live[on], pick[on], everyone[:left]
                table, parts = table.take(on, axis=-1), parts.take(on, axis=-1)
                free, rise = free.take(on, axis=-1), rise[on]
                roof = None if roof is None else roof[on]
            _pivot(table, parts, rise, free, pick, everyone)
        self.y[:, live], self.at[:, live], self.rise[live] = parts[0], parts[1], rise
        self.table[:, :, live] = table

    def shift(self, change: Floats) -> None:
        """Let b change by ``change`` ``(k, n)``, the bases staying as they are."""
        free = self.at == _FREE
        moved = np.where(free, change, 0.0)
        self.y += np.einsum("ijn,jn->in", self.table, moved)
        self.y -= np.where(free, 0.0, change)

    def solution(self) -> Floats:
        """The variables, ``(k, n)``."""
        held = np.where(self.at == _LOWER, self.lower, self.upper)
        values = np.where(self.at == _FREE, self.y, held)
        return np.minimum(np.maximum(values, self.lower), self.upper)


def _pivot(
    table: Floats,
    parts: Floats,
    rise: Floats,
    free: Bools,
    pick: NDArray[np.intp],
    everyone: NDArray[np.intp],
) -> None:
    """Exchange variable ``pick`` with its multiplier, in place, one for each problem."""
    y, at = parts[0], parts[1]
    column = table[:, pick, everyone]
    row = table[pick, :, everyone].T
    inverse = 1.0 / column[pick, everyone]
    value, side, low, high, _ = parts[:, pick, everyone]
    leaving = free[pick, everyone]  # from the free ones to a bound
    above = value > high
    difference = np.where(leaving, np.where(above, high, low), 0.0) - value
    step = difference * inverse
    rise += np.where(leaving, step, -step) * difference
    kept = np.where(leaving, 0.0, np.where(side == _UPPER, high, low))
    factor = column * inverse
    y += column * step
    y[pick, everyone] = step + kept
    table -= factor[:, None] * row
    table[:, pick, everyone] = factor
    table[pick, :, everyone] = (row * -inverse).T
    table[pick, pick, everyone] = inverse
    at[pick, everyone] = np.where(leaving, np.where(above, _UPPER, _LOWER), _FREE)
