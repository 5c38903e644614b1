"""The solvers behind :func:`dexctl.grasp.stability_forces`, without checks of their arguments.

The problem, for k contacts with unit wrenches W (6 x k):

    minimise ||W c||^2 + rho ||1 - c||^2   subject to   lower <= c <= upper,   some c_j = 1.

It is k convex problems, one for each j, of which the best is kept. Without its bounds, problem
j has a closed form in M = (W'W + rho I)^-1, and what it reaches bounds from below what problem
j can reach with them. So problems are taken best bound first; the first whose closed form is
within its bounds ends the search, and a problem whose bound is above the best found is never
solved. Objectives in here are divided by rho, and counted from the unconstrained minimum.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from math import inf

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from dexctl.grasp.box_qp import TOLERANCE, BoxBatch, solve_box
from dexctl.state import Bools, Floats

Indices = NDArray[np.intp]

TIE = 1e-9  # objectives (over rho) this close count as equal; then the lowest j wins
_PENALTY = 1e-7  # regulariser of each step of the method of multipliers
_MAX_MULTIPLIER_STEPS = 100
_RESIDUAL_TIE, _SPREAD_TIE = 1e-8, 1e-7
_RANK = 1e-7  # singular values below this share of the largest count as zero


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
        regulariser: rho > 0; below 1e-6 round-off shows.

    Returns:
        The k forces, and j; -1 where no upper bound is 1 (then only the bounds hold).
    """
    k = len(lower)
    inverse: list[list[float]] = lapack.dposv(hessian, _identity(k))[1].tolist()  # type: ignore[attr-defined]
    table = [[regulariser * a for a in row] for row in inverse]
    free = [sum(row) for row in table]
    candidates = sorted(
        [((1.0 - free[j]) ** 2 / table[j][j], j) for j in range(k) if upper[j] == 1.0]
    )
    if not candidates:
        return solve_box(table, free, list(lower), list(upper))[0], -1
    trials = []
    roof = inf
    for bound, j in candidates:
        if bound > roof + TIE:
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
                over *= over / (table[i][i] - a * a * scale)
                if over > toll:
                    toll = over
        trials.append((bound + toll, j, bound, trial))
        if not toll:  # within the bounds: no later candidate does better
            roof = min(roof, bound)
    best, forces, held = inf, free, -1
    for lowest, j, bound, trial in sorted(trials):
        if lowest >= best - TIE and (j > held or lowest > best + TIE):
            continue
        value = bound
        if lowest > bound:
            trial, rise = _with_one_held(table, trial, j, lower, upper, best + TIE - bound)
            value += rise
        if value < best - TIE or (j < held and value <= best + TIE):
            best, forces, held = min(value, best), trial, j
    return [min(max(c, a), b) for c, a, b in zip(forces, lower, upper, strict=True)], held


def _with_one_held(
    table: list[list[float]],
    start: list[float],
    j: int,
    lower: Sequence[float],
    upper: Sequence[float],
    roof: float,
) -> tuple[list[float], float]:
    """The box QP with c_j = 1, from its solution without bounds."""
    others = [i for i in range(len(start)) if i != j]
    row = table[j]
    scale = 1.0 / row[j]
    reduced = []
    for i in others:
        whole, f = table[i], row[i] * scale
        reduced.append([whole[m] - f * row[m] for m in others])
    solution, rise = solve_box(
        reduced,
        [start[i] for i in others],
        [lower[i] for i in others],
        [upper[i] for i in others],
        roof,
    )
    solution.insert(j, 1.0)
    return solution, rise


def solve_stability_batch(
    gram: Floats, lower: Floats, upper: Floats, regulariser: float, active: Bools
) -> tuple[Floats, Indices]:
    """Many stability QPs with a regulariser; the batch is the last axis; nothing is checked.

    Args:
        gram: W'W, ``(m, m, n)``; rows and columns of fingers out of contact are zero.
        lower: ``(m, n)``, 0 <= lower <= upper; zero for fingers out of contact.
        upper: ``(m, n)``, at most 1; zero for fingers out of contact.
        regulariser: rho > 0.
        active: ``(m, n)``, which fingers are in contact.

    Returns:
        Forces ``(m, n)`` and the contact held at one ``(n,)``, -1 where no upper bound is 1.
    """
    n = lower.shape[1]
    everyone = np.arange(n)
    table = _scaled_inverse(gram, regulariser, active)
    free = table.sum(axis=1)
    bound, step = _bounds(table, free, (upper == 1.0) & active)
    lowest = bound.min(axis=0)
    held = (bound <= lowest + TIE).argmax(axis=0)
    forces = table[:, held, everyone]
    forces *= step[held, everyone]
    forces += free
    clipped = np.minimum(np.maximum(forces, lower), upper)
    forces -= clipped
    alone = np.flatnonzero(np.isinf(lowest))
    if alone.size:  # no contact may be held at one: the bounds alone
        box = BoxBatch(table[:, :, alone], free[:, alone], lower[:, alone], upper[:, alone])
        box.solve()
        clipped[:, alone] = box.solution()
        held[alone] = -1
    hard = np.flatnonzero((np.abs(forces) > TOLERANCE).any(axis=0) & np.isfinite(lowest))
    if not hard.size:
        return clipped, held
    lowest, roof = _bracket(
        gram[:, :, hard] / regulariser,
        table[:, :, hard],
        free[:, hard],
        bound[:, hard],
        step[:, hard],
        lower[:, hard],
        upper[:, hard],
    )
    which, column = np.nonzero(lowest <= roof + TIE)
    where = hard[column]
    box = _hold_at_one(table, free, bound, step, lower, upper, which, where)
    box.solve(roof[column] + TIE)
    solutions = box.solution()
    value = np.full((len(lower), n), np.inf)
    value[which, where] = box.rise
    value = value[:, hard]
    best = (value <= value.min(axis=0) + TIE).argmax(axis=0)
    place = np.full(value.shape, -1)
    place[which, column] = np.arange(len(which))
    held[hard] = best
    clipped[:, hard] = solutions[:, place[best, np.arange(hard.size)]]
    return clipped, held


def solve_lexicographic_batch(
    wrenches: Floats, lower: Floats, upper: Floats, active: Bools
) -> tuple[Floats, Indices]:
    """The stability QPs as rho goes to zero: least residual, then least ||1 - c||, lowest j.

    The method of multipliers on "minimise ||1 - c||^2 subject to W c = 0": where no c reaches
    zero, its iterates still converge, to the answer for the closest W c that can be reached
    (Chiche and Gilbert, "How the augmented Lagrangian algorithm can deal with an infeasible
    convex quadratic optimization problem", 2016), which is the definition wanted. The set of
    forces at their bounds then gives the answer to full accuracy.

    Args:
        wrenches: W, ``(6, m, n)``, zero columns for fingers out of contact.
        lower: see :func:`solve_stability_batch`.
        upper: see :func:`solve_stability_batch`.
        active: ``(m, n)``, which fingers are in contact.
    """
    m, n = lower.shape
    gram = np.einsum("aim,ajm->ijm", wrenches, wrenches)
    table = _scaled_inverse(gram, _PENALTY, active)
    free = table.sum(axis=1)
    bound, step = _bounds(table, free, (upper == 1.0) & active)
    which, where = np.nonzero(np.isfinite(bound))
    alone = np.flatnonzero(np.isinf(bound).all(axis=0))
    # One problem for each candidate j, then those of hands that have no candidate.
    box = _hold_at_one(table, free, bound, step, lower, upper, which, where)
    which = np.concatenate([which, np.full(alone.size, -1)])
    where = np.concatenate([where, alone])
    box = BoxBatch(
        np.concatenate([box.table, table[:, :, alone]], axis=-1),
        np.concatenate([box.y, free[:, alone]], axis=-1),
        np.concatenate([box.lower, lower[:, alone]], axis=-1),
        np.concatenate([box.upper, upper[:, alone]], axis=-1),
    )
    grams = gram[:, :, where]
    forces = np.full((m, where.size), np.inf)
    for _ in range(_MAX_MULTIPLIER_STEPS):
        box.solve(keep_table=True)
        previous, forces = forces, box.solution()
        if not np.abs(forces - previous).max(initial=0.0) > 1e-12:
            break
        box.shift(np.einsum("ijn,jn->in", grams, forces) / -_PENALTY)
    residual = np.sqrt((np.einsum("ajn,jn->an", wrenches[:, :, where], forces) ** 2).sum(axis=0))
    spread = (np.where(active[:, where], 1.0 - forces, 0.0) ** 2).sum(axis=0)

    place = np.full((m + 1, n), -1)
    place[which, where] = np.arange(where.size)  # row -1, the last, is "no candidate"
    found = place >= 0
    residuals = np.where(found, residual[place], np.inf)
    tied = residuals <= residuals.min(axis=0) + _RESIDUAL_TIE
    spreads = np.where(tied, spread[place], np.inf)
    best = (spreads <= spreads.min(axis=0) + _SPREAD_TIE).argmax(axis=0)
    chosen = place[best, np.arange(n)]
    movable = (box.at == 0) & (box.upper > box.lower)
    return (
        _polish(wrenches, forces[:, chosen], movable[:, chosen], lower, upper),
        np.where(best == m, -1, best),
    )


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
    free: Floats,
    bound: Floats,
    step: Floats,
    lower: Floats,
    upper: Floats,
) -> tuple[Floats, Floats]:
    """Lower bounds of every problem "c_j = 1", ``(m, n)``, and an upper bound of the best.

    Below: the bound without other bounds, and what keeping the costliest of the broken ones
    alone adds. Above: the least that clipping into the bounds costs, for any j.
    """
    diagonal = np.einsum("iin->in", table)
    trial = table * step
    trial += free[:, None]
    excess = trial - np.minimum(np.maximum(trial, lower[:, None]), upper[:, None])
    each = np.arange(len(free))
    excess[each, each] = 0.0
    remaining = diagonal[:, None] - table**2 / np.where(diagonal > 0, diagonal, 1.0)
    # Zero for c_j itself and for fingers out of contact, neither of which can be in excess.
    toll = np.divide(excess**2, remaining, out=np.zeros_like(excess), where=excess != 0)
    cost = np.einsum("ikn,kjn->ijn", gram, excess)
    cost += excess
    cost *= excess
    return bound + toll.max(axis=0), (bound + cost.sum(axis=0)).min(axis=0)


def _hold_at_one(
    table: Floats,
    free: Floats,
    bound: Floats,
    step: Floats,
    lower: Floats,
    upper: Floats,
    which: Indices,
    where: Indices,
) -> BoxBatch:
    """Problems "c_j = 1" for the pairs (j, hand) in ``which`` and ``where``, ``(p,)``."""
    pairs = np.arange(which.size)
    column = table[:, which, where]
    y = free[:, where]
    y += column * step[which, where]
    scaled = column / column[which, pairs]
    tables = table[:, :, where]
    tables -= scaled[:, None] * column
    tables[which, :, pairs] = 0.0
    tables[:, which, pairs] = 0.0
    y[which, pairs] = 1.0
    lower, upper = lower[:, where], upper[:, where]
    lower[which, pairs] = 1.0
    box = BoxBatch(tables, y, lower, upper)
    box.rise += bound[which, where]
    return box


def _polish(
    wrenches: Floats, forces: Floats, movable: Bools, lower: Floats, upper: Floats
) -> Floats:
    """The least-squares answer for the forces between their bounds, where it is one."""
    w = np.moveaxis(wrenches, -1, 0)
    c, moves = forces.T, movable.T
    base = np.where(moves, 1.0, c)
    inverse = np.linalg.pinv(np.where(moves[:, None, :], w, 0.0), rcond=_RANK)
    polished = base - (inverse @ (w @ base[..., None]))[..., 0]
    before = np.linalg.norm((w @ c[..., None])[..., 0], axis=-1)
    after = np.linalg.norm((w @ polished[..., None])[..., 0], axis=-1)
    fits = ((polished >= lower.T - 1e-7) & (polished <= upper.T + 1e-7)).all(axis=-1)
    better = fits & (after <= before + 1e-9)
    return np.clip(np.where(better[:, None], polished, c), lower.T, upper.T).T
