"""The solvers behind :func:`dexctl.grasp.stability_forces`, without checks of their arguments.

The problem, for k contacts with unit wrenches W (6 x k):

    minimise ||W c||^2 + rho ||1 - c||^2   subject to   lower <= c <= upper,   some c_j = 1.

It is k convex problems, one for each j, of which the best is kept; of equal ones the lowest j.
Without its bounds, problem j has a closed form in M = (W'W + rho I)^-1, and what it reaches bounds
from below what problem j can reach with them. A problem whose bound is above what another one
reaches is not solved.

Closed forms choose what to solve, and no more than that: they lose digits where contacts are
nearly the same, so they are compared with room for it. Which problem is best is decided by the
objective of the forces themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from math import inf

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from dexctl.grasp.box_qp import TOLERANCE, FreeSolver, solve_box, solve_box_batch
from dexctl.state import Bools, Floats

Indices = NDArray[np.intp]

TIE = 1e-11  # objectives this close, over the largest squared wrench, are equal: the lowest j wins
LOST = 4e-15  # relative error of closed forms, times k^2 and the condition of W'W + rho I
DUAL = 1e-15  # multipliers' round-off, over the largest squared wrench


@cache
def _identity(k: int) -> Floats:
    return np.eye(k)


def solve_stability(
    hessian: Floats, lower: Sequence[float], upper: Sequence[float], regulariser: float
) -> tuple[list[float], int]:
    """One stability QP with a regulariser, for a controller's loop: nothing is checked.

    Args:
        hessian: W'W + regulariser I, ``(k, k)``, k >= 1, positive definite.
        lower: k floats, 0 <= lower <= upper.
        upper: k floats, at most 1; j is a candidate for the contact held at one where upper[j]
            is 1.
        regulariser: rho > 0, at least 1e-11 of the largest entry of the Hessian.

    Returns:
        The k forces, and j; -1 where no upper bound is 1 (then only the bounds hold).
    """
    k = len(lower)
    inverse: list[list[float]] = lapack.dposv(hessian, _identity(k))[1].tolist()  # type: ignore[attr-defined]
    table = [[regulariser * a for a in row] for row in inverse]
    free = [sum(row) for row in table]
    base = k - sum(free)  # the objective without any bounds; objectives in here are over rho
    candidates = sorted(
        [(base + (1.0 - free[j]) ** 2 / table[j][j], j) for j in range(k) if upper[j] == 1.0]
    )
    rows: list[list[float]] = hessian.tolist()
    size = max([row[i] for i, row in enumerate(rows)])
    dual = TOLERANCE * regulariser + DUAL * size
    if not candidates:
        return solve_box(rows, regulariser, lower, upper, free, dual)[0], -1
    # room for what round-off does to closed forms, and for what counts as equal
    lost = LOST * k * k * size / regulariser
    tie = TIE * size / regulariser
    roof = inf
    trials = []
    for bound, j in candidates:
        if bound > roof + tie + lost * (1.0 + roof):
            break
        row = table[j]
        scale = 1.0 / row[j]
        step = (1.0 - free[j]) * scale
        trial = [c + step * a for c, a in zip(free, row, strict=True)]
        trial[j] = 1.0
        # What keeping the costliest of the broken bounds alone would add.
        toll = 0.0
        for i in range(k):
            c = trial[i]
            over = c - upper[i] if c > upper[i] else lower[i] - c
            if over > TOLERANCE:
                a = row[i]
                over *= over / (table[i][i] - a * a * scale + lost)
                if over > toll:
                    toll = over
        trials.append((bound + toll, j, trial, toll > 0.0))
        if not toll:  # within the bounds: no later candidate does better
            roof = min(roof, bound)
    if len(trials) == 1 and not trials[0][3]:
        _, held, forces, _ = trials[0]
        return [min(max(c, a), b) for c, a, b in zip(forces, lower, upper, strict=True)], held
    best, found = inf, []
    for lowest, j, trial, broken in sorted(trials):
        if lowest > best + tie + lost * (1.0 + lowest):
            break
        if broken:
            least, most = list(lower), list(upper)
            least[j] = most[j] = 1.0
            roof = best + tie + lost * (1.0 + best) - k
            trial, value = solve_box(
                rows, regulariser, least, most, trial, dual, regulariser * roof
            )
            if value > regulariser * roof:
                continue
        forces = [min(max(c, a), b) for c, a, b in zip(trial, lower, upper, strict=True)]
        value = _objective(rows, forces, regulariser)
        best = min(best, value)
        found.append((j, value, forces))
    return next((forces, j) for j, value, forces in sorted(found) if value <= best + tie)


def _objective(hessian: list[list[float]], forces: list[float], regulariser: float) -> float:
    """The objective over rho."""
    total = 0.0
    for row, c in zip(hessian, forces, strict=True):
        if c:
            total += c * sum([a * b for a, b in zip(row, forces, strict=True)])
    return total / regulariser - 2.0 * sum(forces) + len(forces)


def solve_stability_batch(
    gram: Floats, lower: Floats, upper: Floats, regulariser: float, active: Bools
) -> tuple[Floats, Indices]:
    """Many stability QPs with a regulariser; the batch is the last axis; nothing is checked.

    Args:
        gram: W'W, ``(m, m, n)``; rows and columns of fingers out of contact are zero.
        lower: ``(m, n)``, 0 <= lower <= upper; zero for fingers out of contact.
        upper: ``(m, n)``, at most 1; zero for fingers out of contact.
        regulariser: rho > 0, at least 1e-11 of the largest entry of the Hessian.
        active: ``(m, n)``, which fingers are in contact.

    Returns:
        Forces ``(m, n)`` and the contact held at one ``(n,)``, -1 where no upper bound is 1.
    """
    m, n = lower.shape
    table = _scaled_inverse(gram, regulariser, active)
    free = table.sum(axis=1)
    candidate = (upper == 1.0) & active
    bound, step = _bounds(table, free, candidate)
    bound += active.sum(axis=0) - free.sum(axis=0)  # the objective without any bounds, over rho
    lowest = bound.min(axis=0)
    held = bound.argmin(axis=0)
    # in units of rho: room for what round-off does to closed forms, and for what counts as equal
    size = (np.einsum("iin->in", gram).max(axis=0) + regulariser) / regulariser
    lost, tie = LOST * m * m * size, TIE * size
    room = tie + lost * (1.0 + np.where(np.isfinite(lowest), lowest, 0.0))
    alone = np.isinf(lowest)
    several = (bound <= lowest + room).sum(axis=0) > 1
    forces = table[:, held, np.arange(n)]
    forces *= step[held, np.arange(n)]
    forces += free
    clipped = np.minimum(np.maximum(forces, lower), upper)
    held[alone] = -1
    hard = np.flatnonzero((np.abs(forces - clipped) > TOLERANCE).any(axis=0) | several | alone)
    if not hard.size:
        return clipped, held
    table, free, bound, step = table[:, :, hard], free[:, hard], bound[:, hard], step[:, hard]
    lower, upper, gram, active = lower[:, hard], upper[:, hard], gram[:, :, hard], active[:, hard]
    trial = table * step
    trial += free[:, None]  # (i, j, n): force i where j is held at one
    least, most = _bracket(gram / regulariser, table, trial, bound, lower, upper, lost[hard])
    alone = np.flatnonzero(alone[hard])
    most = np.maximum(most, least.min(axis=0))  # the lowest of them is always solved
    most[alone] = -1.0
    which, column = np.nonzero(least <= most + tie[hard] + lost[hard] * (1.0 + most))
    start = np.concatenate([trial[:, which, column], free[:, alone]], axis=1).T
    which = np.concatenate([which, np.full(alone.size, -1)])
    column = np.concatenate([column, alone])
    low, high = held_at_one(lower, upper, which, column)
    grams = np.ascontiguousarray(np.moveaxis(gram, -1, 0))
    rho = np.full(hard.size, regulariser)
    roof = most + tie[hard] + lost[hard] * (1.0 + most) - active.sum(axis=0)
    roof[alone] = np.inf
    solutions, _ = solve_box_batch(
        by_elimination(grams + regulariser * np.eye(m), rho, column),
        np.where((low == high) & (start == high), np.int8(1), np.int8(0)),
        low,
        high,
        rho[column],
        regulariser * (TOLERANCE + DUAL * size[hard])[column],
        start,
        regulariser * roof[column],
    )
    spread = np.where(active.T[column], 1.0 - solutions, 0.0)
    effort = (solutions[:, None] @ grams[column] @ solutions[..., None])[:, 0, 0]
    value = np.full((m + 1, hard.size), np.inf)  # row -1, the last, is "no candidate"
    value[which, column] = effort / regulariser + (spread * spread).sum(axis=1)
    best = (value <= value.min(axis=0) + tie[hard]).argmax(axis=0)
    place = np.zeros(value.shape, np.intp)
    place[which, column] = np.arange(which.size)
    clipped[:, hard] = solutions[place[best, np.arange(hard.size)]].T
    held[hard] = np.where(best == m, -1, best)
    return clipped, held


def problems(candidate: Bools) -> tuple[Indices, Indices]:
    """Every problem "c_j = 1": j and its hand ``(p,)``; -1 for hands without a candidate."""
    which, column = np.nonzero(candidate)
    alone = np.flatnonzero(~candidate.any(axis=0))
    return np.append(which, np.full(alone.size, -1)), np.append(column, alone)


def by_elimination(hessians: Floats, regularisers: Floats, column: Indices) -> FreeSolver:
    """Solves for free variables from the Hessians W'W + rho I ``(n, m, m)`` of hands."""
    identity = np.eye(hessians.shape[-1])

    def solve(rows: Indices, free: Bools, at_bounds: Floats) -> Floats:
        hands = column[rows]
        hessian = hessians[hands]
        gradient = (hessian @ at_bounds[..., None])[..., 0] - regularisers[hands, None]
        reduced = np.where(free[:, :, None] & free[:, None, :], hessian, identity)
        change = np.linalg.solve(reduced, np.where(free, -gradient, 0.0)[..., None])
        gradient += (hessian @ change)[..., 0]
        return np.where(free, change[..., 0], gradient)

    return solve


def held_at_one(
    lower: Floats, upper: Floats, which: Indices, column: Indices
) -> tuple[Floats, Floats]:
    """Bounds ``(p, m)`` of problems "c_j = 1" of hands ``column``; j is -1 for none."""
    low, high = lower[:, column].T.copy(), upper[:, column].T.copy()
    held = np.flatnonzero(which >= 0)
    low[held, which[held]] = high[held, which[held]] = 1.0
    return low, high


def _scaled_inverse(gram: Floats, regulariser: float, active: Bools) -> Floats:
    """(W'W / rho + I)^-1, ``(m, m, n)``; zero rows and columns for fingers out of contact."""
    m = len(gram)
    table = gram / regulariser
    diagonal = np.arange(m)
    table[diagonal, diagonal] += 1.0
    for i in range(m):  # Gauss-Jordan in place; a positive definite matrix needs no row swaps
        inverse = 1.0 / table[i, i]
        row = table[i] * inverse
        column = table[:, i].copy()
        table -= column[:, None] * row
        table[i] = row
        column *= inverse
        np.negative(column, out=table[:, i])
        table[i, i] = inverse
    table[diagonal, diagonal] *= active
    return table


def _bounds(table: Floats, free: Floats, candidate: Bools) -> tuple[Floats, Floats]:
    """What holding c_j at one costs without other bounds, and the multiplier it takes."""
    gap = 1.0 - free
    step = np.zeros(free.shape)
    np.divide(gap, np.einsum("iin->in", table), out=step, where=candidate)
    bound = gap * step
    bound[~candidate] = np.inf
    return bound, step


def _bracket(
    gram: Floats,
    table: Floats,
    trial: Floats,
    bound: Floats,
    lower: Floats,
    upper: Floats,
    lost: Floats,
) -> tuple[Floats, Floats]:
    """Lower bounds of every problem "c_j = 1", ``(m, n)``, and an upper bound of the best.

    Below: the bound without other bounds, and what keeping the costliest of the broken ones
    alone adds. Above: the least that clipping into the bounds costs, for any j.
    """
    diagonal = np.einsum("iin->in", table)
    excess = trial - np.minimum(np.maximum(trial, lower[:, None]), upper[:, None])
    each = np.arange(len(bound))
    excess[each, each] = 0.0
    remaining = diagonal[:, None] - table**2 / np.where(diagonal > 0, diagonal, 1.0)
    # Zero for c_j itself and for fingers out of contact, neither of which can be in excess.
    toll = excess**2 / (np.maximum(remaining, 0.0) + lost)
    cost = np.einsum("ikn,kjn->ijn", gram, excess)
    cost += excess
    cost *= excess
    return bound + toll.max(axis=0), (bound + cost.sum(axis=0)).min(axis=0)
