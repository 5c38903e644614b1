"""Contact models, contact frames, the grasp map G and the stacked hand Jacobian J.

Source: thesis chapter 4 (G_S and J_S of the in-grasp manipulation controller); contact models
after Prattichizzo and Trinkle, "Grasping" (Springer Handbook of Robotics, chapter 38).
With w = G f for wrenches, the contact velocities of an object twist t are G^T t.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.hand import HandModel
from dexctl.state import Bools, Floats
from dexctl.validation import numbers, shown, truths

CONTACT_MODELS = {"frictionless": 1, "hard": 3, "soft": 4}
"""Columns of the grasp map per contact: the normal force; the force in world axes; the force in
world axes and the torque about the normal."""

_NEXT, _LAST = [1, 2, 0], [2, 0, 1]
NORMAL_TOLERANCE = 0.02  # on the squared norm of a unit normal
MAX_DISTANCE = 1e6
"""Greatest distance of a contact from the origin, along an axis [m]; beyond lies no hand."""
MAX_CONTACTS = 128
"""Most contacts at once of what takes a time that grows with the cube of their number."""


class Contacts(NamedTuple):
    """Checked contact arrays; rows out of contact are zero, whatever they held.

    Attributes:
        position: ``(..., m, 3)`` [m], relative to the origin that wrenches are taken about.
        normal: ``(..., m, 3)``, unit, from the fingertip into the object.
        active: ``(..., m)`` bool.
    """

    position: Floats
    normal: Floats
    active: Bools


def check_contacts(
    contact_position: ArrayLike,
    contact_normal: ArrayLike,
    in_contact: ArrayLike,
    origin: ArrayLike,
) -> Contacts:
    """The contacts relative to ``origin``, rows out of contact zeroed.

    Args:
        contact_position: ``(..., m, 3)`` [m].
        contact_normal: ``(..., m, 3)``, unit.
        in_contact: ``(..., m)`` bool.
        origin: ``(..., 3)`` [m] or one ``(3,)`` for all.

    Raises:
        InvalidInput: shapes that do not belong together; numbers of a finger in contact that
            are not finite, or a normal that is not of unit length.
    """
    position = _rows(contact_position, "contact_position")
    normal = _rows(contact_normal, "contact_normal")
    active = check_mask(in_contact, position.shape[:-1])
    if normal.shape != position.shape:
        raise InvalidInput(
            f"contact_normal has shape {normal.shape}; expected that of contact_position, "
            f"{position.shape}"
        )
    away = check_origin(origin, position)
    with np.errstate(over="ignore", invalid="ignore"):
        offset = np.where(active[..., None], position - away, 0.0)
        normal = np.where(active[..., None], normal, 0.0)
        squared = np.einsum("...i,...i->...", normal, normal)
        # written so that NaN is wrong
        wrong = ~(np.abs(squared - active) <= NORMAL_TOLERANCE)
        far = np.logical_not((np.abs(offset) <= MAX_DISTANCE).all(axis=-1))
    if wrong.any() or far.any():
        raise InvalidInput(_what_is_wrong(offset, normal, wrong, np.asarray(far)))
    return Contacts(offset, normal, active)


def tangent_basis(normal: ArrayLike) -> Floats:
    """Orthonormal frames ``(..., 3, 3)`` whose columns are two tangents and the normal.

    ``normal`` is ``(..., 3)``, unit. The frame varies smoothly with the normal except where
    n_z changes sign (Duff et al., "Building an orthonormal basis, revisited", JCGT 2017).
    A zero normal gives finite numbers of no meaning.

    Raises:
        InvalidInput: another shape, or a component that no unit vector has.
    """
    n = numbers("normal", normal, "(..., 3)")
    if n.ndim == 0 or n.shape[-1] != 3:
        raise InvalidInput(f"normal has shape {n.shape}; expected (..., 3)")
    if not (np.abs(n) <= 2.0).all():
        raise InvalidInput(f"normal is {shown(normal)}; expected unit vectors")
    x, y, z = n[..., 0], n[..., 1], n[..., 2]
    sign = np.where(z < 0, -1.0, 1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = np.stack([1 + sign * x * x * a, sign * b, -sign * x], axis=-1)
    second = np.stack([b, sign + y * y * a, -y], axis=-1)
    return np.stack([first, second, n], axis=-1)


def grasp_map(
    contact_position: ArrayLike,
    origin: ArrayLike,
    in_contact: ArrayLike | None = None,
    normal: ArrayLike | None = None,
    model: str = "hard",
) -> Floats:
    """The grasp map G: object wrench (force, torque about ``origin``) w = G f.

    Args:
        contact_position: ``(..., m, 3)`` [m], world frame.
        origin: ``(..., 3)`` [m], or one ``(3,)`` for all.
        in_contact: ``(..., m)`` bool; None: all. Columns of the others are zero, and their rows
            are not read (they may hold NaN).
        normal: ``(..., m, 3)`` unit, into the object; needed for "soft" and "frictionless".
        model: "hard" (a force in world axes), "soft" (a force in world axes and a torque about
            the normal) or "frictionless" (a normal force).

    Returns:
        ``(..., 6, 3m)``; ``4m`` columns for soft, ``m`` for frictionless contacts; world frame.

    Raises:
        InvalidInput: shapes that do not belong together, numbers not finite, no normals.
        UnknownName: no such model.
    """
    check_model(model, CONTACT_MODELS)
    position = _rows(contact_position, "contact_position")
    batch, m = position.shape[:-2], position.shape[-2]
    if model == "hard":  # a hard finger's map does not depend on the normal
        normal = np.broadcast_to([0.0, 0.0, 1.0], position.shape)
    elif normal is None:
        raise InvalidInput(f"normal is None; the contact model {model!r} needs the normals")
    if in_contact is None:
        in_contact = np.ones((*batch, m), bool)
    r, n, active = check_contacts(position, normal, in_contact, origin)
    if model == "frictionless":
        return np.swapaxes(np.concatenate([n, cross(r, n)], axis=-1), -1, -2)
    columns = CONTACT_MODELS[model]
    g = np.zeros((*batch, 6, m, columns))
    for axis in range(3):
        g[..., axis, :, axis] = active
        # column `axis` of the skew matrix of r: r x e_axis
        following, last = (axis + 1) % 3, (axis + 2) % 3
        g[..., 3 + following, :, axis] = r[..., last]
        g[..., 3 + last, :, axis] = -r[..., following]
    if model == "soft":
        g[..., 3:, :, 3] = np.swapaxes(n, -1, -2)
    return g.reshape(*batch, 6, m * columns)


def hand_jacobian(
    hand: HandModel,
    q: ArrayLike,
    contact_position: ArrayLike,
    in_contact: ArrayLike | None = None,
) -> Floats:
    """The hand Jacobian J_S, stacked: contact velocities v = J dq, ``(..., 3m, d)``.

    Args:
        hand: the hand.
        q: ``(..., d)`` [rad].
        contact_position: ``(..., m, 3)`` [m], world frame.
        in_contact: ``(..., m)`` bool; None: all. Rows of the others are zero, and their
            positions are not read.

    Raises:
        InvalidInput: shapes that do not belong together, or numbers that are not finite.
    """
    if not isinstance(hand, HandModel):
        raise InvalidInput(f"hand is {shown(hand)}; expected a HandModel")
    position = _rows(contact_position, "contact_position")
    if in_contact is None:
        in_contact = np.ones(position.shape[:-1], bool)
    active = check_mask(in_contact, position.shape[:-1])[..., None]
    far = ~(np.abs(np.where(active, position, 0.0)) <= MAX_DISTANCE)
    if far.any():
        index = [int(i) for i in np.argwhere(far)[0][:-1]]
        raise InvalidInput(f"contact_position{index} is not finite, or over {MAX_DISTANCE:.0e} m")
    jacobian = hand.contact_jacobian(q, np.where(active, position, 0.0)) * active[..., None]
    return jacobian.reshape(*jacobian.shape[:-3], 3 * hand.n_fingers, hand.nq)


def cross(a: Floats, b: Floats) -> Floats:
    """Cross products of rows ``(..., 3)``; ``np.cross`` takes several times as long."""
    product = a[..., _NEXT] * b[..., _LAST]
    product -= a[..., _LAST] * b[..., _NEXT]
    return product


def check_model(model: object, known: Collection[str]) -> None:
    """Raise UnknownName where ``model`` is no contact model of those ``known``."""
    if not (isinstance(model, str) and model in known):
        raise UnknownName("contact model", model if isinstance(model, str) else shown(model), known)


def check_mask(in_contact: ArrayLike, shape: tuple[int, ...]) -> Bools:
    """``in_contact`` as bools of ``shape``."""
    active = truths("in_contact", in_contact)
    if active.shape != shape:
        raise InvalidInput(f"in_contact has shape {active.shape}; expected {shape}")
    return active


def check_count(active: Bools, most: int = MAX_CONTACTS) -> None:
    """Raise InvalidInput where more than ``most`` are ``active`` ``(..., m)`` at once."""
    count = int(active.sum(axis=-1).max(initial=0))
    if count > most:
        raise InvalidInput(f"in_contact has {count} contacts; expected at most {most}")


def check_origin(origin: ArrayLike, position: Floats) -> Floats:
    """``origin`` with an axis for the fingers, ``(..., 1, 3)`` or ``(1, 3)``."""
    origin = numbers("origin", origin, "(..., 3)")
    batch = position.shape[:-2]
    if origin.shape not in ((3,), (*batch, 3)):
        raise InvalidInput(f"origin has shape {origin.shape}; expected {(*batch, 3)} or (3,)")
    return origin[..., None, :]


def _rows(value: ArrayLike, name: str) -> Floats:
    rows = numbers(name, value, "(..., m, 3)")
    if rows.ndim < 2 or rows.shape[-1] != 3:
        raise InvalidInput(f"{name} has shape {rows.shape}; expected (..., m, 3)")
    return rows


def _what_is_wrong(offset: Floats, normal: Floats, wrong: Bools, far: Bools) -> str:
    bad = ~(np.isfinite(offset) & np.isfinite(normal)).all(axis=-1)
    which = bad if bad.any() else wrong if wrong.any() else far
    index = tuple(int(i) for i in np.argwhere(which)[0])
    if bad.any():
        return (
            "contact_position, contact_normal or origin is not finite for a finger in contact "
            f"(first at index {list(index)})"
        )
    if wrong.any():
        largest = np.abs(normal[index]).max()  # squares could overflow or vanish
        length = largest * np.linalg.norm(normal[index] / largest) if largest else 0.0
        return f"contact_normal{list(index)} has length {length:.4g}; expected 1"
    return (
        f"contact_position{list(index)} is {np.abs(offset[index]).max():.4g} m from the origin; "
        f"expected at most {MAX_DISTANCE:.0e} m"
    )
