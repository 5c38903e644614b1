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

import numpy as np

from dexctl.state import Bools, Floats

TOLERANCE = 1e-9  # on bounds and multipliers; callers scale H to an identity plus a PSD part
_FREE, _LOWER, _UPPER = 0, -1, 1
_BATCH_PASSES = 12  # cyclic passes before what remains goes to the finite method
_MAX_PIVOTS = 5000  # round-off could cycle between two sets that differ by less than it


def solve_box(
    table: list[list[float]], y: list[float], lower: list[float], upper: list[float]
) -> tuple[list[float], float]:
    """One box QP in plain Python floats, from its unconstrained solution.

    Args:
        table: H^-1, k rows of k; y: H^-1 b. Both are overwritten.
        lower, upper: k bounds each.

    Returns:
        The solution, and how far its objective is above the one unconstrained.
    """
    k = len(y)
    at = [_FREE] * k
    rise = 0.0
    greedy = 3 * k + 4  # largest violation first for this many pivots, then the least index
    for count in range(_MAX_PIVOTS):
        pick, worst = -1, TOLERANCE
        for i in range(k):
            value, side = y[i], at[i]
            if side == _FREE:
                violation = value - upper[i]
                if violation <= TOLERANCE:
                    violation = lower[i] - value
            elif upper[i] > lower[i]:
                violation = side * value
            else:
                continue
            if violation > worst:
                pick = i
                if count >= greedy:
                    break
                worst = violation
        if pick < 0:
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
        table: ``(k, k, n)``, H^-1 at the start. A variable held in advance has zero row, column
            and value bounds [value, value].
        y: ``(k, n)``, the unconstrained solution at the start.
        lower, upper: ``(k, n)``.
        at: ``(k, n)`` int8, 0 free, -1 at the lower bound, 1 at the upper.
        rise: ``(n,)``, objective above the unconstrained one.
    """

    def __init__(self, table: Floats, y: Floats, lower: Floats, upper: Floats) -> None:
        self.table, self.y, self.lower, self.upper = table, y, lower, upper
        self.at = np.zeros(y.shape, np.int8)
        self.rise = np.zeros(y.shape[-1])
        self._movable = upper > lower

    def violated(self) -> Bools:
        """Which entries break a bound or hold a multiplier of the wrong sign, ``(k, n)``."""
        y = self.y
        free = self.at == _FREE
        out = (y < self.lower - TOLERANCE) | (y > self.upper + TOLERANCE)
        wrong = (self.at * y > TOLERANCE) & self._movable
        return np.where(free, out, wrong)

    def solve(self) -> Bools:
        """Pivot until done; returns which problems are not, ``(n,)``: see :func:`solve_box`."""
        for _ in range(_BATCH_PASSES):
            violated = self.violated()
            rows = violated.any(axis=1)
            if not rows.any():
                return np.zeros(self.y.shape[-1], bool)
            for i in np.flatnonzero(rows):
                self._pivot(i)
        return self.violated().any(axis=0)

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
        return np.clip(values, self.lower, self.upper)

    def _pivot(self, i: int) -> None:
        """Exchange variable i with its multiplier in the problems where i is violated."""
        table, y, at = self.table, self.y, self.at[i]
        yi, lower, upper = y[i], self.lower[i], self.upper[i]
        free = at == _FREE
        above = yi > upper + TOLERANCE
        picked = np.where(
            free, above | (yi < lower - TOLERANCE), (at * yi > TOLERANCE) & self._movable[i]
        )
        # A picked entry of a table never has a zero diagonal: that belongs to variables held.
        inverse = np.divide(picked, table[i, i], out=np.zeros_like(yi), where=picked)
        target = np.where(free, np.where(above, upper, lower), 0.0)
        difference = np.where(picked, target - yi, 0.0)
        step = difference * inverse
        self.rise += np.where(free, difference, -difference) * step
        kept = np.where(free, 0.0, np.where(at == _UPPER, upper, lower))
        entering = step + kept

        column = table[:, i]
        y += column * step
        np.copyto(yi, entering, where=picked)
        factor = column * inverse
        row = table[i].copy()
        table -= factor[:, None] * row
        row *= inverse
        np.negative(row, out=row)
        np.copyto(table[:, i], factor, where=picked)
        np.copyto(table[i], row, where=picked)
        np.copyto(table[i, i], inverse, where=picked)
        side = np.where(free, np.where(above, _UPPER, _LOWER), _FREE).astype(np.int8)
        np.copyto(at, side, where=picked)
