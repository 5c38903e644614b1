"""The stability QP from W itself, by singular values: any regulariser, and none.

For few contacts slower than the solvers that work on W'W, and for many quicker, since W has six
rows however many there are. It loses no digits: what the others cannot tell from zero, a singular
value of 1e-8, this one can.
"""

from __future__ import annotations

import numpy as np

from dexctl.grasp.box_qp import TOLERANCE, FreeSolver, Indices, solve_box_batch
from dexctl.grasp.stability_solver import DUAL, TIE, held_at_one, problems
from dexctl.state import Bools, Floats

LIMIT = 1e-18
"""The regulariser, over the largest squared wrench, that stands for none."""
_ROUGH = 1e-9  # regulariser of a first guess, over the largest squared wrench
_RANK = 1e-13  # singular values below are zero
_PARALLEL = 1e-9  # sine below which a wrench is at right angles to what is left
_NOTHING = 1e-12  # a residual that is none
_RESIDUAL_TIE, _SPREAD_TIE = 4e-9, 1e-7


def solve_exact_batch(
    wrenches: Floats, lower: Floats, upper: Floats, regulariser: float, active: Bools
) -> tuple[Floats, Indices]:
    """Many stability QPs; the batch is the last axis; nothing is checked.

    No regulariser is the limit of small ones: the least residual, then the least ||1 - c||, then
    the lowest j.

    Args:
        wrenches: W, ``(6, m, n)``, zero columns for fingers out of contact.
        lower: see `solve_stability_batch`.
        upper: see `solve_stability_batch`.
        regulariser: rho, 0 or more.
        active: ``(m, n)``, which fingers are in contact.

    Returns:
        Forces ``(m, n)`` and the contact held at one ``(n,)``, -1 where no upper bound is 1.
    """
    m, n = lower.shape
    size = np.sqrt(np.maximum((wrenches * wrenches).sum(axis=0).max(axis=0), 1.0))
    unit = np.moveaxis(wrenches / size, -1, 0)  # (n, 6, m), columns no longer than 1
    rho = np.maximum(regulariser / size**2, LIMIT)
    which, column = problems((upper == 1.0) & active)
    low, high = held_at_one(lower, upper, which, column)
    # Where the answer is nearly.
    rough = np.maximum(rho, _ROUGH)
    _, sides = solve_box_batch(
        _by_wrenches(unit, rough, column),
        np.where(low == high, np.int8(1), np.int8(0)),
        low,
        high,
        rough[column],
        rough[column] * TOLERANCE + DUAL,
    )

    def solve(rows: Indices, free: Bools, at_bounds: Floats) -> Floats:
        w, filters = unit[column[rows]], rho[column[rows], None]
        base = np.where(free, 1.0, at_bounds)
        wrench = (w @ base[..., None])[..., 0]
        u, s, v = np.linalg.svd(np.where(free[:, None], w, 0.0), full_matrices=False)
        u *= (s > _RANK)[:, None]
        along = (wrench[:, None] @ u)[:, 0]
        shrunk = along / (s * s + filters)
        forces = base - ((shrunk * s)[:, None] @ v)[:, 0]
        # what no free force could take away, at right angles to them to the last digit
        left = wrench - (u @ along[..., None])[..., 0]
        left -= (u @ (left[:, None] @ u).swapaxes(-1, -2))[..., 0]
        pull = (left[:, None] @ w)[:, 0]
        amount = np.sqrt((left * left).sum(axis=-1, keepdims=True))
        pull = np.where(np.abs(pull) > _PARALLEL * amount, pull, 0.0)
        pull = np.where(amount > _NOTHING, pull, 0.0)
        balance = (u @ shrunk[..., None])[..., 0]
        multiplier = pull / filters + (balance[:, None] @ w)[:, 0] + base - 1.0
        return np.where(free, forces, multiplier)

    ones = np.ones(len(low))
    solutions, _ = solve_box_batch(solve, sides, low, high, ones, TOLERANCE * ones)
    left = (unit[column] @ solutions[..., None])[..., 0]
    residual = np.full((m + 1, n), np.inf)  # row -1, the last, is "no candidate"
    spread = residual.copy()
    residual[which, column] = np.sqrt((left * left).sum(axis=-1))
    apart = np.where(active.T[column], 1.0 - solutions, 0.0)
    spread[which, column] = (apart * apart).sum(axis=-1)
    if regulariser:
        value = residual * residual + rho * spread
        best = (value <= value.min(axis=0) + TIE).argmax(axis=0)
    else:
        spread[residual > residual.min(axis=0) + _RESIDUAL_TIE] = np.inf
        best = (spread <= spread.min(axis=0) + _SPREAD_TIE).argmax(axis=0)
    place = np.zeros(residual.shape, np.intp)
    place[which, column] = np.arange(which.size)
    forces = solutions[place[best, np.arange(n)]].T
    return np.ascontiguousarray(forces), np.where(best == m, -1, best)


def _by_wrenches(unit: Floats, regularisers: Floats, column: Indices) -> FreeSolver:
    """Solves for free variables from W ``(n, 6, m)``: six unknowns, however many contacts.

    The free forces are 1 - W'y, where rho y is the wrench that is left.
    """
    identity = np.eye(unit.shape[-2])

    def solve(rows: Indices, free: Bools, at_bounds: Floats) -> Floats:
        w, rho = unit[column[rows]], regularisers[column[rows], None]
        base = np.where(free, 1.0, at_bounds)
        movable = np.where(free[:, None], w, 0.0)
        matrix = movable @ movable.swapaxes(-1, -2) + rho[..., None] * identity
        balance = np.linalg.solve(matrix, w @ base[..., None])
        relief = (balance.swapaxes(-1, -2) @ w)[:, 0]
        return np.where(free, base - relief, rho * (relief + base - 1.0))

    return solve
