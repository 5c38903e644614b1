"""The least squares that distribute forces: a wrench, linear limits, and the least effort.

Least squares inside linear inequalities are a least distance once what is sought is written in
the directions that the objective is round in, and a least distance is nonnegative least squares
in the multipliers (Lawson and Hanson, "Solving Least Squares Problems", 1974, chapter 23). That
holds for any limits, and ends after a finite number of steps where methods that approach the answer
of a quadratic program give up on squeezed grasps. What comes out is proved: it is where the rows
that hold it say, all of them push, and no limit is broken.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import nnls

from dexctl.state import Bools, Floats

UNBOUNDED = 1e9
"""A limit, over the norm of the wrench, that no force comes to."""
_EFFORT_SHARE = 1e-7  # weight of the effort beside the wrench left over
_MAX_ROUNDS = 20
_SETTLED = 1e-8  # change of the forces, over the largest
_ACCURACY = 1e-10  # of a limit, over the length of y
_INDEPENDENT = 1e-12  # share of the largest singular value below which rows depend on each other
_SCALES = (1.0, 0.1, 10.0, 1e-3, 1e3)  # that are tried until the answer is proved
_STEPS = 30  # for each variable and limit


def least_effort(
    maps: Floats, target: Floats, weight: Floats, rows: Floats, upper: Floats
) -> Floats:
    """The forces whose wrench is nearest to a target, and of those the least.

    Minimises ||G f - t||, then ||w f||, over the forces f with ``rows @ f <= upper``. The two
    are added with a small weight for the effort, whose effect the method of multipliers takes away:
    what is left over is asked for again on top.

    Args:
        maps: G, ``(6, n)``.
        target: t, ``(6,)``, of norm 1 or so.
        weight: w, ``(n,)``, above 0.
        rows: ``(r, n)``.
        upper: ``(r,)``, 0 or more, so that no forces at all are allowed.

    Returns:
        f, ``(n,)``.
    """
    # u = w f makes the effort round; the wrench does not care for most of its directions.
    wrench = maps / weight
    left, stretch, directions = np.linalg.svd(wrench, full_matrices=False)
    effort = _EFFORT_SHARE * max(float(stretch[0]) ** 2, 1e-12)
    pull = stretch / (stretch * stretch + effort)
    # u = u0 + y + V'(shrink * V y), u0 the best without limits: the objective grows by |y|^2.
    shrink = 1.0 / np.sqrt(1.0 + stretch * stretch / effort) - 1.0
    limits = rows / weight
    size = np.sqrt(np.einsum("ij,ij->i", limits, limits))
    some = size > 0
    limits, most = limits[some] / size[some, None], upper[some] / size[some]
    turned = limits + ((limits @ directions.T) * shrink) @ directions
    length = np.maximum(np.sqrt(np.einsum("ij,ij->i", turned, turned)), 1e-12)
    turned /= length[:, None]

    asked, force = target, np.zeros(len(weight))
    tight = np.zeros(len(turned), bool)
    for _ in range(_MAX_ROUNDS):
        free = (pull * (asked @ left)) @ directions
        step, tight = _least_distance(turned, (most - limits @ free) / length, tight)
        found = free + step + (shrink * (directions @ step)) @ directions
        change = np.abs(found - force).max(initial=0.0)
        force = found
        if change <= _SETTLED * max(1.0, np.abs(found).max(initial=0.0)):
            break
        asked = asked + (target - wrench @ force)
    if not (limits @ force <= most + _SETTLED * np.maximum(1.0, np.abs(most))).all():
        force[:] = 0.0  # numbers without sense: no forces rather than forces that are not allowed
    return force / weight


def _least_distance(rows: Floats, upper: Floats, guess: Bools) -> tuple[Floats, Bools]:
    """The shortest y with ``rows @ y <= upper``, and which rows hold it there.

    Args:
        rows: ``(r, n)``, of unit length.
        upper: ``(r,)``; some y is allowed.
        guess: ``(r,)``, rows that may hold it.
    """
    step, proved = _held_by(rows, upper, guess)
    if proved:
        return step, guess
    # The last residual of the nonnegative least squares is 1 / (1 + |y|^2), so y is scaled to about
    # one. It has lost digits, so which rows are tight is all that is taken from there, and proved.
    short = np.minimum(upper, 0.0)
    scale = float(np.sqrt(short @ short))
    wanted = np.append(np.zeros(rows.shape[1]), 1.0)
    tight = guess
    for more in _SCALES:
        matrix = np.vstack([-rows.T, upper / (-scale * more)])
        try:
            multipliers, _ = nnls(matrix, wanted, maxiter=_STEPS * sum(matrix.shape))
        except RuntimeError:  # too many steps
            continue
        tight = multipliers > 0
        step, proved = _held_by(rows, upper, tight)
        if proved:
            break
        scale = max(scale, float(np.sqrt(step @ step)))
    return step, tight


def _held_by(rows: Floats, upper: Floats, tight: Bools) -> tuple[Floats, bool]:
    """The shortest y at the limits of these rows, and whether that proves to be the shortest.

    It is where it is allowed and pushed there by every row that holds it.
    """
    held, at = rows[tight], upper[tight]
    step = np.asarray(np.linalg.lstsq(held, at, rcond=_INDEPENDENT)[0], float)
    longest = max(1.0, float(np.sqrt(step @ step)))
    if not (rows @ step <= upper + _ACCURACY * np.maximum(longest, np.abs(upper))).all():
        return step, False
    pushes = np.linalg.lstsq(held.T, -step, rcond=_INDEPENDENT)[0]
    if (pushes >= -_ACCURACY * longest).all():
        return step, True
    # Rows that depend on each other push in many ways; that no push pulls need hold for one.
    try:
        pushes, _ = nnls(held.T, -step, maxiter=_STEPS * sum(held.shape))
    except RuntimeError:
        return step, False
    return step, bool(np.abs(pushes @ held + step).max() <= _ACCURACY * longest)
