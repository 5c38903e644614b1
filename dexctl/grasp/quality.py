"""How good a grasp is: Ferrari-Canny epsilon, least singular value and isotropy of the map.

Sources: Ferrari and Canny, "Planning optimal grasps" (ICRA 1992); Roa and Suarez, "Grasp
quality measures: review and performance" (Autonomous Robots 2015).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import qr

from dexctl.grasp.closure import is_force_closure
from dexctl.grasp.cones import (
    DEFAULT_EDGES,
    DEFAULT_TORSION,
    check_cones,
    primitive_wrenches,
)
from dexctl.grasp.contacts import check_count
from dexctl.state import Floats

MAX_HULL_CONTACTS = 32
"""Most contacts at once, a second of work where they lie on a ball; there every facet counts."""
_FLAT = 1e-10  # of the longest wrench; what lies so little beyond a facet is on it
_FACETS = 32  # that are tried at once


def epsilon_quality(
    contact_position: ArrayLike,
    contact_normal: ArrayLike,
    in_contact: ArrayLike,
    origin: ArrayLike,
    friction: ArrayLike,
    *,
    length: ArrayLike | None = None,
    model: str = "hard",
    edges: int = DEFAULT_EDGES,
    torsion: float = DEFAULT_TORSION,
) -> Floats:
    """Ferrari-Canny epsilon, ``(...)``: the largest wrench that can be resisted in any direction.

    The radius of the largest ball about the origin inside the hull of the primitive wrenches,
    for normal forces that sum to 1 N (the L1 measure; the forces themselves are longer, up to
    sqrt(1 + mu^2)). Pyramids are inscribed, so it is a lower bound. 0 without force closure. It
    builds hulls in six dimensions for each grasp, 5 to 15 ms for five fingers, up to a second for
    32 contacts: a figure for plans and reports, not for a control loop.

    Args:
        contact_position: ``(..., m, 3)`` [m], world frame.
        contact_normal: ``(..., m, 3)``, unit, from the fingertip into the object.
        in_contact: ``(..., m)`` bool, at most 32 at once; rows of the others are not read.
        origin: ``(..., 3)`` or ``(3,)`` [m].
        friction: coefficient, one number, ``(m,)`` or ``(..., m)``.
        length: what torques are divided by [m], ``(...)`` or one for all; None: the mean
            distance of the contacts from the origin, at least 1 mm.
        model: "hard" or "soft" (with a torque about the normal).
        edges: edges of the inscribed pyramid.
        torsion: torque about the normal over normal force of a soft finger [m].

    Raises:
        InvalidInput: naming the argument, its value and what was expected.
        UnknownName: no such contact model.
    """
    cones = check_cones(
        contact_position,
        contact_normal,
        in_contact,
        origin,
        friction,
        model,
        edges,
        torsion,
        length,
    )
    check_count(cones.contacts.active, MAX_HULL_CONTACTS)
    closed = np.atleast_1d(
        is_force_closure(
            contact_position,
            contact_normal,
            in_contact,
            origin,
            friction,
            model=model,
            edges=edges,
            torsion=torsion,
        )
    ).ravel()
    wrenches = primitive_wrenches(cones)
    wrenches = wrenches.reshape(closed.size, *wrenches.shape[-2:])
    quality = np.zeros(len(wrenches))
    for i in np.flatnonzero(closed):
        quality[i] = _ball_radius(wrenches[i])
    return quality.reshape(cones.length.shape)


def smallest_singular_value(
    contact_position: ArrayLike,
    contact_normal: ArrayLike,
    in_contact: ArrayLike,
    origin: ArrayLike,
    *,
    length: ArrayLike | None = None,
    model: str = "hard",
    torsion: float = DEFAULT_TORSION,
) -> Floats:
    """Least singular value of the grasp map, ``(...)``; 0 where it is not of rank 6.

    Torques are divided by ``length``; a soft finger's torque is measured in units of
    ``torsion`` [m] per newton. Arguments and errors: :func:`epsilon_quality`.
    """
    values = _singular_values(
        contact_position, contact_normal, in_contact, origin, length, model, torsion
    )
    return values[..., -1]


def isotropy(
    contact_position: ArrayLike,
    contact_normal: ArrayLike,
    in_contact: ArrayLike,
    origin: ArrayLike,
    *,
    length: ArrayLike | None = None,
    model: str = "hard",
    torsion: float = DEFAULT_TORSION,
) -> Floats:
    """Least over largest singular value of the grasp map, ``(...)``, in [0, 1].

    1: forces of one size make wrenches of one size in every direction. Arguments and errors:
    :func:`epsilon_quality`; units: :func:`smallest_singular_value`.
    """
    values = _singular_values(
        contact_position, contact_normal, in_contact, origin, length, model, torsion
    )
    return values[..., -1] / np.maximum(values[..., 0], 1e-300)


def _singular_values(
    contact_position: ArrayLike,
    contact_normal: ArrayLike,
    in_contact: ArrayLike,
    origin: ArrayLike,
    length: ArrayLike | None,
    model: str,
    torsion: float,
) -> Floats:
    """The six singular values of the scaled grasp map, largest first, ``(..., 6)``."""
    cones = check_cones(
        contact_position, contact_normal, in_contact, origin, 0.0, model, 3, torsion, length
    )
    maps = cones.maps
    if cones.torsion:
        maps = maps * np.array([1.0, 1.0, 1.0, cones.torsion])
    grasp = np.swapaxes(maps, -3, -2)
    grasp = grasp.reshape(*grasp.shape[:-2], grasp.shape[-2] * grasp.shape[-1])
    missing = max(0, 6 - grasp.shape[-1])
    grasp = np.concatenate([grasp, np.zeros((*grasp.shape[:-1], missing))], axis=-1)
    return np.asarray(np.linalg.svd(grasp, compute_uv=False), float)


def _ball_radius(wrenches: Floats) -> float:
    """Distance from the origin to the nearest facet of the hull of ``(6, p)`` wrenches.

    A hull of a few of them grows until its nearest facet is one of the whole: no wrench lies
    beyond its plane. So of all facets, whose number goes with the cube of p, most are never made
    (the expanding polytope of Zheng, "An efficient algorithm for a grasp quality measure", IEEE
    Transactions on Robotics 2013).
    """
    from scipy.spatial import ConvexHull, QhullError  # slow to import

    points = np.ascontiguousarray(wrenches[:, np.any(wrenches != 0, axis=0)].T)
    beyond = _FLAT * np.sqrt(np.einsum("ij,ij->i", points, points).max())
    spread = points - points.mean(axis=0)
    chosen = np.zeros(len(points), bool)
    chosen[points.argmax(axis=0)] = chosen[points.argmin(axis=0)] = True
    *_, order = qr(spread.T, mode="r", pivoting=True)
    chosen[order[: len(wrenches) + 1]] = True
    try:
        while True:
            planes = ConvexHull(points[chosen]).equations
            nearest = planes[np.argsort(-planes[:, -1])[:_FACETS]]
            depth = -nearest[:, -1]
            farthest = points @ nearest[:, :-1].T
            outer = farthest.argmax(axis=0)
            grows = (farthest.max(axis=0) > depth + beyond) & ~chosen[outer]
            if not grows[0]:
                return max(0.0, float(depth[0]))
            chosen[outer[grows]] = True
    except QhullError:  # closure with so little depth that the hull is flat to Qhull
        return 0.0
