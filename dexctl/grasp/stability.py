"""The grasp-stability QP: which normal forces leave the least wrench on the object.

Source: thesis chapter 4, the QP of the stability controller, completed so that it has one
answer: "some c_j = 1" is k convex problems, of which the best is kept; c <= 1 is added, which
loses nothing; among equal residuals the forces nearest to one are taken, then the lowest j.
"""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dexctl.exceptions import InvalidInput
from dexctl.grasp.contacts import (
    MAX_DISTANCE,
    NORMAL_TOLERANCE,
    Contacts,
    check_contacts,
    check_count,
    cross,
)
from dexctl.grasp.stability_exact import solve_exact_batch
from dexctl.grasp.stability_solver import solve_stability, solve_stability_batch
from dexctl.state import Bools, Floats
from dexctl.validation import number, numbers, shown

MIN_LENGTH = 1e-3
"""Floor of the default length [m]: one contact with the centroid as origin has distance 0."""
MIN_REGULARISER = 1e-6
"""Smallest regulariser beside 0; below it round-off shows in the forces."""
MAX_REGULARISER = 1e6
"""Greatest regulariser; long before it all forces are one."""
SHORTEST = 1e-9
"""Least length of all [m]."""
LEAST_LENGTH = 1e-6
"""Least length, as a share of the distance of the contact farthest from the origin."""
FEW = 12
"""Contacts up to which W'W, as large as their number, is worked with; for more of them W is, which
always has six rows: a hundred take 0.1 s, and the time grows with the cube of their number."""
MAX_CONDITION = 1e9
"""Squared length of a unit wrench, over the regulariser, above which W'W does not do."""


class StabilitySolution(NamedTuple):
    """The forces that leave the least wrench on the object.

    Attributes:
        forces: ``(..., m)`` normal forces, in [0, 1], as shares of the grip force; zero for
            fingers out of contact. The largest is 1 (unless ``held`` is -1).
        residual: ``(...)``, norm of the wrench that they leave, torques divided by ``length``.
        held: ``(...)`` int, the contact held at one; -1 where there is none.
        length: ``(...)`` [m], what torques were divided by.
    """

    forces: Floats
    residual: Floats
    held: NDArray[np.intp]
    length: Floats


def stability_forces(
    contact_position: ArrayLike,
    contact_normal: ArrayLike,
    in_contact: ArrayLike,
    origin: ArrayLike,
    *,
    length: ArrayLike | None = None,
    regulariser: float = 0.0,
    min_force: float = 0.0,
    max_force: ArrayLike | None = None,
) -> StabilitySolution:
    """Normal forces c that minimise the wrench left on the object (thesis chapter 4).

    Minimises ||W c||^2 + regulariser * sum (1 - c_i)^2 over min_force <= c_i <= 1 with some
    c_j = 1; W holds the unit wrenches of the normals, torques about ``origin`` divided by
    ``length``. With regulariser 0: the least residual (to 1e-8 of the longest unit wrench), among
    those the least sum (1 - c_i)^2. Objectives that differ by less than 1e-11 of the largest
    squared unit wrench (without a regulariser: residuals by 4e-9, sums by 1e-7) are equal, and of
    equal ones the lowest j is taken: so fingers at one contact change nothing. The answer is a pure
    function of its arguments, and the same for one hand and for each hand of a batch: ``held`` too,
    the numbers to 1e-8.

    Args:
        contact_position: ``(..., m, 3)`` [m], world frame.
        contact_normal: ``(..., m, 3)``, unit, from the fingertip into the object.
        in_contact: ``(..., m)`` bool; rows of the others are not read.
        origin: ``(..., 3)`` [m], or one ``(3,)`` for all.
        length: ``(...)`` or one for all [m], at least a millionth of the distance of the farthest
            contact; None: the mean distance of the contacts from the origin, at least 1 mm.
        regulariser: rho, 0 or 1e-6 to 1e6. About 1e-3 keeps the answer from jumping under
            sensor noise.
        min_force: least force of every finger in contact, in [0, 1].
        max_force: ``(..., m)`` or ``(m,)``, in [0, 1]: greatest force of each finger, for
            unloading it. A finger below 1 is no candidate for the contact held at one, and its
            least force is min(min_force, max_force). Where no finger may reach 1, ``held`` is
            -1 and the bounds alone remain. None: 1.

    Returns:
        Forces, residual, the contact held at one, the length used. No contacts: zeros, -1.

    Raises:
        InvalidInput: naming the argument, its value and what was expected.
    """
    wanted = f"0, or {MIN_REGULARISER:g} to {MAX_REGULARISER:g}"
    regulariser = number("regulariser", regulariser, 0.0, MAX_REGULARISER, wanted)
    if 0.0 < regulariser < MIN_REGULARISER:
        raise InvalidInput(f"regulariser is {regulariser}; expected {wanted}")
    min_force = number("min_force", min_force, 0.0, 1.0, "a share in [0, 1]")
    if regulariser and not (isinstance(contact_position, np.ndarray) and contact_position.ndim > 2):
        try:
            solution = _solve_one(
                numbers("contact_position", contact_position, ""),
                numbers("contact_normal", contact_normal, ""),
                np.asarray(in_contact),
                numbers("origin", origin, ""),
                None if length is None else number("length", length, SHORTEST, MAX_DISTANCE, ""),
                regulariser,
                min_force,
                None if max_force is None else numbers("max_force", max_force, ""),
            )
        except (TypeError, ValueError, OverflowError):  # said in so many words below
            solution = None
        if solution is not None:
            return solution
    contacts = check_contacts(contact_position, contact_normal, in_contact, origin)
    check_count(contacts.active)
    shape = contacts.active.shape
    scale = characteristic_length(contacts, length)
    upper = _upper(max_force, contacts.active)
    m, count = shape[-1], int(np.prod(shape[:-1]))
    active = contacts.active.reshape(count, m).T
    wrenches = unit_wrenches(contacts, scale).reshape(count, 6, m)
    wrenches = np.ascontiguousarray(np.moveaxis(wrenches, 0, -1))
    upper = upper.reshape(count, m).T
    lower = np.minimum(upper, np.where(active, min_force, 0.0))
    if m == 0 or count == 0:
        forces, held = np.zeros((m, count)), np.full(count, -1)
    elif (
        regulariser
        and m <= FEW
        and (wrenches * wrenches).sum(axis=0).max() < MAX_CONDITION * regulariser
    ):
        gram = (wrenches[:, :, None] * wrenches[:, None]).sum(axis=0)
        forces, held = solve_stability_batch(gram, lower, upper, regulariser, active)
    else:
        forces, held = solve_exact_batch(wrenches, lower, upper, regulariser, active)
    left = (wrenches * forces).sum(axis=1)
    return StabilitySolution(
        np.ascontiguousarray(forces.T).reshape(shape),
        np.sqrt((left * left).sum(axis=0)).reshape(shape[:-1]),
        held.reshape(shape[:-1]),
        scale,
    )


def unit_wrenches(contacts: Contacts, length: ArrayLike) -> Floats:
    """W ``(..., 6, m)``: wrenches of unit normal forces, torques divided by ``length``."""
    torque = cross(contacts.position, contacts.normal) / np.asarray(length)[..., None, None]
    return np.swapaxes(np.concatenate([contacts.normal, torque], axis=-1), -1, -2)


def characteristic_length(contacts: Contacts, length: ArrayLike | None) -> Floats:
    """``length`` ``(...)`` checked, or the mean distance of the contacts from the origin [m]."""
    batch = contacts.active.shape[:-1]
    if length is None:
        distance = np.sqrt(np.einsum("...i,...i->...", contacts.position, contacts.position))
        count = np.maximum(contacts.active.sum(axis=-1), 1)
        return np.maximum(distance.sum(axis=-1) / count, MIN_LENGTH)
    value = numbers("length", length, f"{batch} or one number")
    if value.shape not in ((), batch):
        raise InvalidInput(f"length has shape {value.shape}; expected {batch} or one number")
    if not ((value >= SHORTEST) & (value <= MAX_DISTANCE)).all():
        raise InvalidInput(
            f"length is {shown(length)}; expected metres from {SHORTEST:g} to {MAX_DISTANCE:.0e}"
        )
    farthest = np.abs(contacts.position).max(axis=(-1, -2), initial=0.0)
    if not (farthest * LEAST_LENGTH <= value).all():
        raise InvalidInput(
            f"length is {shown(length)}, with contacts up to {farthest.max():.3g} m from the "
            f"origin; expected at least {LEAST_LENGTH:.0e} of that"
        )
    return np.broadcast_to(value, batch)


def _upper(max_force: ArrayLike | None, active: Bools) -> Floats:
    """The greatest force of each finger, ``(..., m)``; 0 out of contact."""
    if max_force is None:
        return active.astype(float)
    limit = numbers("max_force", max_force, f"{active.shape}")
    if limit.shape not in (active.shape, active.shape[-1:]):
        raise InvalidInput(f"max_force has shape {limit.shape}; expected {active.shape}")
    limit = np.where(active, limit, 0.0)
    if not ((limit >= 0) & (limit <= 1)).all():
        raise InvalidInput(f"max_force is {shown(max_force)}; expected shares in [0, 1]")
    return limit


def _solve_one(
    position: Floats,
    normal: Floats,
    in_contact: NDArray,
    origin: Floats,
    length: float | None,
    regulariser: float,
    min_force: float,
    max_force: Floats | None,
) -> StabilitySolution | None:
    """One hand, in plain Python numbers: for few contacts a fifth of the time of the arrays.

    None where there are more contacts than a few, or an argument is not what it should be, for the
    general path to solve it or to say so.
    """
    if position.ndim != 2:
        return None
    m = len(position)
    fingers, three = (m,), (m, 3)
    if position.shape != three or normal.shape != three or in_contact.shape != fingers:
        return None
    if origin.shape != (3,) or in_contact.dtype != bool:
        return None
    limits = [1.0] * m
    if max_force is not None:
        if max_force.shape != fingers:
            return None
        limits = max_force.tolist()
    touching = [i for i, touch in enumerate(in_contact.tolist()) if touch]
    if not 0 < len(touching) <= FEW:
        return None
    points, normals = position.tolist(), normal.tolist()
    ox, oy, oz = origin.tolist()
    rows: list[list[float]] = []
    total = 0.0
    for i in touching:
        x, y, z = points[i]
        a, b, c = normals[i]
        x, y, z = x - ox, y - oy, z - oz
        # Comparisons with NaN are false, so this also refuses what is not finite.
        if not (abs(a * a + b * b + c * c - 1.0) <= NORMAL_TOLERANCE and 0 <= limits[i] <= 1):
            return None
        rows.append([a, b, c, y * c - z * b, z * a - x * c, x * b - y * a])
        total += sqrt(x * x + y * y + z * z)
    scale = max(total / len(touching), MIN_LENGTH) if length is None else length
    least = max(SHORTEST, LEAST_LENGTH * total)
    if not (least <= scale <= MAX_DISTANCE and total <= MAX_DISTANCE):
        return None
    wrenches = np.array(rows)
    wrenches[:, 3:] *= 1.0 / scale
    hessian = wrenches @ wrenches.T
    hessian.ravel()[:: len(touching) + 1] += regulariser
    if not hessian.max() < MAX_CONDITION * regulariser:
        return None
    upper = [limits[i] for i in touching]
    lower = [min(min_force, u) for u in upper]
    values, held = solve_stability(hessian, lower, upper, regulariser)
    left = np.array(values) @ wrenches
    forces = [0.0] * m
    for i, value in zip(touching, values, strict=True):
        forces[i] = value
    return StabilitySolution(
        np.array(forces),
        np.array(sqrt(left @ left)),
        np.array(touching[held] if held >= 0 else -1),
        np.array(scale),
    )
