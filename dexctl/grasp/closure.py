"""Force closure: whether the contacts can resist every wrench.

A grasp has force closure when its contact wrenches positively span the wrench space: the grasp
map has rank 6, and some forces strictly inside their friction cones balance to nothing (Murray,
Li and Sastry, "A Mathematical Introduction to Robotic Manipulation", chapter 5). With cones
replaced by inscribed pyramids that is a linear program. Most grasps are decided without it, by
a few alternating projections for all grasps at once, and most of the others by nonnegative least
squares: both look for such balanced forces, or for a wrench that no contact can push against.
Either one, once found, proves the answer.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linprog, nnls

from dexctl.grasp.cones import (
    DEFAULT_EDGES,
    DEFAULT_TORSION,
    FrictionalContacts,
    check_cones,
    primitive_wrenches,
)
from dexctl.state import Bools, Floats

RANK_MARGIN = 1e-4
"""Least singular value, over the largest, of a grasp map that counts as of rank 6."""
_INTERIOR = 1e-6  # least normal force, and least distance from the cone's edge, of the proof
_SEPARATION = 1e-9  # least share by which a separating wrench must separate
_PROJECTIONS = 12
_KEPT = 0.9  # share of the friction that the projections aim at


def is_force_closure(
    contact_position: ArrayLike,
    contact_normal: ArrayLike,
    in_contact: ArrayLike,
    origin: ArrayLike,
    friction: ArrayLike,
    *,
    model: str = "hard",
    edges: int = DEFAULT_EDGES,
    torsion: float = DEFAULT_TORSION,
) -> Bools:
    """Whether the contacts can resist every wrench, ``(...)`` bool.

    True is certain: it holds for pyramids inscribed in the cones, strictly, and with a grasp
    map well of rank 6. False may be wrong within 2 % of the friction (16 edges).

    Args:
        contact_position: ``(..., m, 3)`` [m], world frame.
        contact_normal: ``(..., m, 3)``, unit, from the fingertip into the object.
        in_contact: ``(..., m)`` bool; rows of the others are not read.
        origin: ``(..., 3)`` or ``(3,)`` [m].
        friction: coefficient, one number, ``(m,)`` or ``(..., m)``; 0: frictionless.
        model: "hard" or "soft" (with a torque about the normal).
        edges: edges of the inscribed pyramid.
        torsion: torque about the normal over normal force of a soft finger [m].

    Raises:
        InvalidInput: naming the argument, its value and what was expected.
        UnknownName: no such contact model.
    """
    cones = check_cones(
        contact_position, contact_normal, in_contact, origin, friction, model, edges, torsion
    )
    shape = cones.length.shape
    answer, decided = _by_projections(cones)
    if not decided.all():
        wrenches = primitive_wrenches(cones)
        wrenches = wrenches.reshape(answer.size, *wrenches.shape[-2:])
        for i in np.flatnonzero(~decided):
            answer[i] = _by_primitives(wrenches[i])
    return answer.reshape(shape) if shape else answer[0]


def _by_projections(cones: FrictionalContacts) -> tuple[Bools, Bools]:
    """Answers and which of them are proved, ``(n,)`` each.

    Projects by turns on the forces that balance, f in null(G), and on the forces inside
    slightly narrower cones with normal forces of at least 1. Forces of the first kind inside
    the cones prove closure. Otherwise the gap between the two sets becomes the image G^T d of
    a wrench d; if every force of the true cones has a component of one sign along it, no
    contact can push against d, and there is no closure.
    """
    maps = cones.maps
    n, m = int(np.prod(maps.shape[:-3])), maps.shape[-3]
    columns = maps.shape[-1]
    active = cones.contacts.active.reshape(n, m)
    friction = cones.friction.reshape(n, m)
    if cones.torsion:
        maps = maps * np.array([1.0, 1.0, 1.0, cones.torsion])  # torques in units of torsion
    grasp = np.swapaxes(maps.reshape(n, m, 6, columns), 1, 2).reshape(n, 6, m * columns)
    if n == 0 or m == 0:
        return np.zeros(n, bool), np.ones(n, bool)
    pulls = friction > 0  # without friction the tangential columns carry nothing
    useful = np.repeat(pulls[..., None], columns, axis=-1)
    useful[..., 2] = True
    if cones.torsion:
        useful[..., 3] = True
    grasp = grasp * useful.reshape(n, 1, m * columns)
    # P = I - G'(GG')^-1 G projects on the balanced forces.
    values, vectors = np.linalg.eigh(grasp @ np.swapaxes(grasp, -1, -2))
    full = values[:, 0] > RANK_MARGIN**2 * np.maximum(values[:, -1], 1e-300)
    inverse = (vectors / np.where(full[:, None], values, 1.0)[:, None, :]) @ np.swapaxes(
        vectors, -1, -2
    )
    answer, decided = np.zeros(n, bool), ~full
    live = np.flatnonzero(full)
    grasp, inverse = grasp[live], inverse[live]
    transposed = np.swapaxes(grasp, -1, -2)
    # What a pyramid holds in every direction: its inscribed circle, its double cone.
    reach = friction * np.cos(np.pi / cones.edges)
    force = np.zeros((live.size, m, columns))
    force[..., 2] = active[live]
    for _ in range(_PROJECTIONS):
        if not live.size:
            break
        flat = force.reshape(live.size, -1, 1)
        wrench = inverse @ (grasp @ flat)
        gap = (transposed @ wrench).reshape(force.shape)
        balanced = force - gap
        yes = _strictly_inside(balanced, reach[live], active[live])
        no = _separates(gap, friction[live], active[live])
        answer[live[yes]] = True
        decided[live[yes | no]] = True
        on = ~(yes | no)
        live, grasp, inverse, transposed = live[on], grasp[on], inverse[on], transposed[on]
        force = _into_cones(balanced[on], _KEPT * reach[live], active[live])
    return answer, decided


def _strictly_inside(force: Floats, reach: Floats, active: Bools) -> Bools:
    """Whether all forces are inside the pyramids, or double pyramids, with room to spare."""
    normal = force[..., 2]
    radius = np.sqrt(force[..., 0] ** 2 + force[..., 1] ** 2)
    # Without friction the tangential forces are zero already: their columns were left out.
    room = normal - radius / np.where(reach > 0, reach, 1.0)
    if force.shape[-1] == 4:
        room = room - np.abs(force[..., 3])
    scale = np.maximum(normal.max(axis=-1, keepdims=True), 1.0)
    inside = room > _INTERIOR * scale
    return (inside | ~active).all(axis=-1)


def _separates(gap: Floats, friction: Floats, active: Bools) -> Bools:
    """Whether no force of the true cones has a negative component along ``gap``."""
    tangential = friction * np.sqrt(gap[..., 0] ** 2 + gap[..., 1] ** 2)
    if gap.shape[-1] == 4:
        tangential = np.sqrt(tangential**2 + gap[..., 3] ** 2)
    least = np.where(active, gap[..., 2] - tangential, np.inf).min(axis=-1)
    most = np.abs(gap).max(axis=(-1, -2))
    return (least > _SEPARATION * most) & (most > _SEPARATION)


def _into_cones(force: Floats, reach: Floats, active: Bools) -> Floats:
    """Forces inside the cones of friction ``reach``, normal forces of 1 or more, close by."""
    tangent = np.delete(force, 2, axis=-1)
    scaled = tangent.copy()
    if scaled.shape[-1] == 3:
        # In torsion units the double cone is |f_t| / reach + |tau| <= f_n; its inner ellipsoid
        # with both semi-axes over sqrt(2) is round, and projected on with one radius.
        scaled[..., 2] *= reach
        reach = reach / np.sqrt(2)
    radius = np.sqrt((scaled**2).sum(axis=-1))
    normal = np.maximum((force[..., 2] + reach * radius) / (1 + reach**2), 1.0)
    normal = np.where(radius <= reach * force[..., 2], np.maximum(force[..., 2], 1.0), normal)
    shrink = np.minimum(1.0, reach * normal / np.maximum(radius, 1e-300))
    out = np.empty_like(force)
    out[..., :2] = tangent[..., :2] * shrink[..., None]
    out[..., 2] = normal
    if force.shape[-1] == 4:
        out[..., 3] = tangent[..., 2] * shrink
    return np.where(active[..., None], out, 0.0)


def _by_primitives(wrenches: Floats) -> bool:
    """Closure of one grasp from its primitive wrenches W, ``(6, p)``, zero columns unused.

    With rank 6, closure is the same as W x = -W 1 for some x >= 0: then shares of x + 1
    balance. Least squares in x either reaches that, or leaves a wrench that no primitive one has
    a negative component along (its optimality conditions). The linear program takes what round-off
    leaves open.
    """
    used = wrenches[:, np.any(wrenches != 0, axis=0)]
    if not _has_rank(used):
        return False
    total = used.sum(axis=1)
    try:
        shares, left = nnls(used, -total)
    except RuntimeError:  # too many iterations
        return _by_linear_program(used)
    shares += 1.0
    size = np.linalg.norm(total)
    if left <= 1e-9 * size and _balances(used, shares):
        return True
    d = used @ shares
    if left > 1e-6 * size and (d @ used >= -1e-9 * left * np.linalg.norm(used, axis=0)).all():
        return False
    return _by_linear_program(used)


def _by_linear_program(wrenches: Floats) -> bool:
    """Closure of one grasp from primitive wrenches ``(6, p)`` by :func:`balanced_shares`."""
    shares = balanced_shares(wrenches)
    return shares is not None and _balances(wrenches, shares)


def _balances(wrenches: Floats, shares: NDArray[np.float64]) -> bool:
    """Whether the shares, once they balance to the last digit, are all still positive."""
    shares = shares - np.linalg.pinv(wrenches) @ (wrenches @ shares)
    return bool(shares.min() > _INTERIOR * shares.mean())


def _has_rank(wrenches: Floats) -> bool:
    if wrenches.shape[1] < 7:
        return False
    values = np.linalg.svd(wrenches, compute_uv=False)
    return bool(values[-1] > RANK_MARGIN * values[0])


def balanced_shares(wrenches: Floats) -> NDArray[np.float64] | None:
    """Positive shares, averaging 1, with which the wrenches ``(6, p)`` balance.

    The least share is the greatest possible. None: the wrenches are not of rank 6, or cannot
    balance with all shares positive. A linear program, by HiGHS, to about 1e-7.
    """
    if not _has_rank(wrenches):
        return None
    count = wrenches.shape[1]
    # share_i = least + rest_i; variables are rest >= 0 and least >= 0.
    balance = np.column_stack([wrenches, wrenches.sum(axis=1)])
    total = np.append(np.ones(count), count)
    result = linprog(
        np.append(np.zeros(count), -1.0),
        A_eq=np.vstack([balance, total]),
        b_eq=np.append(np.zeros(6), count),
        bounds=(0, None),
        method="highs",
    )
    if result.x is None or result.x[-1] <= _INTERIOR:
        return None
    return result.x[:-1] + result.x[-1]
