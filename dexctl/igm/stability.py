"""The stability half of in-grasp manipulation: from contacts to wanted normal forces.

The same problem as `dexctl.grasp.stability_forces`, handed to its solvers without the checks that
`InGraspManipulation` has made already.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dexctl.grasp import stability_forces
from dexctl.grasp.stability_solver import solve_stability, solve_stability_batch
from dexctl.rotations import cross
from dexctl.state import Bools, Floats

_SHORTEST = 1e-3  # floor of the characteristic length [m]


class StableForces(NamedTuple):
    """Solution of the QP: shares of the grip ``(..., m)``, residual ``(...)``, held ``(...)``."""

    forces: Floats
    residual: Floats
    held: NDArray[np.intp] | int


def stable_forces(
    lever: Floats,
    normal: Floats,
    touch: Bools,
    upper: Floats,
    *,
    min_force: float,
    regulariser: float,
    length: float | None,
) -> StableForces:
    """Shares of the grip that leave the least wrench (thesis eqs. stabstart ff.).

    ``lever`` is the contacts' position from the origin, ``(..., m, 3)``; ``upper`` ``(..., m)``
    bounds the shares, 0 for fingers out of touch.
    """
    if regulariser == 0:  # the optimum need not be unique: the exact, slower way decides
        solution = stability_forces(
            lever, normal, touch, np.zeros(3), length=length, min_force=min_force, max_force=upper
        )
        return StableForces(solution.forces, solution.residual, solution.held)
    if length is None:
        distance = np.sqrt((lever * lever).sum(axis=-1)) * touch
        mean = distance.sum(axis=-1) / np.maximum(touch.sum(axis=-1), 1)
        scale = 1.0 / np.maximum(mean, _SHORTEST)[..., None, None]
    else:
        scale = 1.0 / length
    wrench = np.concatenate([normal, cross(lever, normal) * scale], axis=-1)
    gram = wrench @ wrench.swapaxes(-1, -2)
    lower = np.minimum(min_force, upper)
    if touch.ndim == 1:
        forces, held = _single(gram, lower, upper, touch, regulariser)
    elif len(touch) == 1:
        found, one = _single(gram[0], lower[0], upper[0], touch[0], regulariser)
        forces, held = found[None], np.array([one])
    else:
        forces, held = solve_stability_batch(
            gram.transpose(1, 2, 0), lower.T, upper.T, regulariser, touch.T
        )
        forces = forces.T
    net = (forces[..., None] * wrench).sum(axis=-2)
    return StableForces(forces, np.sqrt((net * net).sum(axis=-1)), held)


def _single(
    gram: Floats, lower: Floats, upper: Floats, touch: Bools, regulariser: float
) -> tuple[Floats, int]:
    active = np.flatnonzero(touch)
    forces = np.zeros(len(touch))
    if not len(active):
        return forces, -1
    if len(active) < len(touch):
        gram = gram[np.ix_(active, active)]
        lower, upper = lower[active], upper[active]
    hessian = gram.copy()
    hessian.flat[:: len(active) + 1] += regulariser
    found, held = solve_stability(hessian, lower.tolist(), upper.tolist(), regulariser)
    forces[active] = found
    return forces, int(active[held]) if held >= 0 else -1


def push_directions(normal: Floats, lever: Floats, friction: float) -> Floats:
    """In which directions fingers push: within a friction cone of the normal, to the centre.

    Forces through the object's centre balance each other where those along the normals cannot:
    near the edges of flat faces, and on faces that all lean the same way. ``normal`` and
    ``lever`` (contact from centre) are ``(..., m, 3)``; zero normals stay zero.
    """
    if friction == 0:
        return normal
    along = -(lever * normal).sum(axis=-1, keepdims=True)
    aside = -lever - along * normal
    size = np.sqrt((aside * aside).sum(axis=-1, keepdims=True))
    # tangent of the angle from the normal; a centre behind the surface counts as far aside
    slope = np.minimum(size / np.maximum(along, 1e-9), friction)
    direction = normal + slope * aside / np.maximum(size, 1e-9)
    # rows out of contact stay zero; what is not a number must not become one
    held = (normal * normal).sum(axis=-1, keepdims=True) != 0
    return np.where(held, direction / np.sqrt(1.0 + slope * slope), 0.0)
