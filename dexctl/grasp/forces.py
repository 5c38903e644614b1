"""Contact forces inside friction cones that balance an external wrench with least effort.

The grasp's force distribution (Kerr and Roth 1986; Prattichizzo and Trinkle, section 38.5), with
friction pyramids inscribed in the cones and joint torque limits.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from dexctl.exceptions import InvalidInput
from dexctl.grasp.cones import (
    DEFAULT_EDGES,
    DEFAULT_TORSION,
    FrictionalContacts,
    check_cones,
    facets,
)
from dexctl.grasp.contacts import MAX_DISTANCE, check_count
from dexctl.grasp.least_effort import UNBOUNDED, least_effort
from dexctl.state import Bools, Floats
from dexctl.validation import number, numbers, shown

BALANCE = 1e-6
"""Share of the external wrench that feasible forces may leave unbalanced."""
MAX_WRENCH = 1e9
"""Greatest force and torque that is asked for [N, N m]."""
MAX_ALL_EDGES = 2048
"""Most edges of all pyramids at once, 16 of 128 contacts; solved in a second or so."""
_SLIPPERY = 1e-6  # N per newton pressed; what friction carries no more than this is left out
_NOTHING = 1e-100  # N; what is below would be lost in squares


class GraspForces(NamedTuple):
    """Contact forces that balance an external wrench.

    Attributes:
        forces: ``(..., m, 3)`` [N] on the object, world frame; zero out of contact.
        normal: ``(..., m)`` [N], their components along the normals, 0 or more.
        twist: ``(..., m)`` [N m], torques of soft fingers about the normals; 0 for hard ones.
        feasible: ``(...)`` bool; whether the forces balance the wrench.
        violation: ``(...)`` [N], norm of the wrench left unbalanced, torques divided by the
            length: the least that any allowed forces leave.
        torques: ``(..., d)`` [N m], joint torques ``J^T f`` that press the fingertips on the object
            with these forces; None without a Jacobian.
    """

    forces: Floats
    normal: Floats
    twist: Floats
    feasible: Bools
    violation: Floats
    torques: Floats | None


def grasp_forces(
    contact_position: ArrayLike,
    contact_normal: ArrayLike,
    in_contact: ArrayLike,
    origin: ArrayLike,
    friction: ArrayLike,
    external_wrench: ArrayLike,
    *,
    model: str = "hard",
    jacobian: ArrayLike | None = None,
    effort: ArrayLike | None = None,
    max_normal: float | None = None,
    edges: int = DEFAULT_EDGES,
    torsion: float = DEFAULT_TORSION,
    length: ArrayLike | None = None,
) -> GraspForces:
    """The forces that hold ``external_wrench`` inside the friction cones with the least effort.

    Least effort is the least sum of squared forces (torques of soft fingers over the length).
    Where no forces balance the wrench, those that leave the least of it, ``feasible`` False,
    and ``violation`` says how much. Grasps of a batch are solved one after another.

    Args:
        contact_position: ``(..., m, 3)`` [m], world frame.
        contact_normal: ``(..., m, 3)``, unit, from the fingertip into the object.
        in_contact: ``(..., m)`` bool, at most 128 at once; rows of the others are not read.
        origin: ``(..., 3)`` or ``(3,)`` [m], the point that torques are taken about.
        friction: coefficient, one number, ``(m,)`` or ``(..., m)``.
        external_wrench: ``(..., 6)`` or ``(6,)``, force [N] and torque [N m] that act on the
            object, gravity for one: (0, 0, -m g, 0, 0, 0) about the centre of mass.
        model: "hard" or "soft".
        jacobian: contact Jacobians ``(..., m, 3, d)``, from ``HandModel.contact_jacobian``.
        effort: joint torque limits ``(d,)`` [N m], ``|J^T f| <= effort``; needs the Jacobian. Only
            the forces count, not the torques of soft fingers, nor the weight of the fingers.
        max_normal: greatest normal force of a finger [N]; None: no limit.
        edges: edges of the pyramids inscribed in the cones, at most 2048 of all contacts.
        torsion: torque about the normal over normal force of a soft finger [m].
        length: what torques are divided by in ``violation`` [m]; None: the mean distance of
            the contacts from the origin, at least 1 mm.

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
    check_count(cones.contacts.active)
    batch, m = cones.friction.shape[:-1], cones.friction.shape[-1]
    most_edges = cones.edges * int(cones.contacts.active.sum(axis=-1).max(initial=0))
    if most_edges > MAX_ALL_EDGES:
        raise InvalidInput(
            f"edges is {edges}, {most_edges} of all contacts; expected at most {MAX_ALL_EDGES}"
        )
    wrench = _finite(external_wrench, "external_wrench", (6,), batch)
    if max_normal is not None:
        wanted = f"newtons above 0, to {MAX_WRENCH:g}, or None"
        max_normal = number("max_normal", max_normal, 0.0, MAX_WRENCH, wanted, above=True)
    joints, limits = _check_effort(jacobian, effort, cones)
    scale = cones.length[..., None]
    wrench = np.concatenate([wrench[..., :3], wrench[..., 3:] / scale], axis=-1)

    maps = cones.maps
    count, columns = int(np.prod(batch)), maps.shape[-1]
    maps = maps.reshape(count, m, 6, columns)
    unit = np.ones((*batch, m, columns))  # contact axes, in units of the friction limits
    unit[..., :2] = cones.friction[..., None]
    unit[..., 3:] = cones.torsion
    unit = unit.reshape(count, m, columns)
    basis = cones.basis.reshape(count, m, 3, 3)
    active = cones.contacts.active.reshape(count, m)
    wrench, lengths = wrench.reshape(count, 6), cones.length.ravel()
    rows = facets(cones.edges, cones.torsion > 0)
    contact_force = np.zeros((len(maps), m, columns))
    violation = np.linalg.norm(wrench, axis=-1)
    for i in np.flatnonzero(active.any(axis=-1) & (violation > 0)):
        touch = active[i]
        size = violation[i]
        weight = unit[i, touch].copy()
        weight[:, 3:] = cones.torsion / lengths[i]
        pulls = (weight > _SLIPPERY).ravel()
        fingers = int(touch.sum())
        limit = np.empty((0, columns * fingers)), np.empty(0)
        if joints is not None and limits is not None:
            torque = np.swapaxes(joints[i, touch], -1, -2) @ basis[i, touch]  # (k, d, 3)
            torque = np.concatenate([torque, np.zeros((*torque.shape[:-1], columns - 3))], axis=-1)
            torque = np.swapaxes(torque * unit[i, touch][:, None], 0, 1).reshape(limits.size, -1)
            bounded = limits < UNBOUNDED * size
            limit = torque[bounded], limits[bounded] / size
        most = np.inf if max_normal is None else max_normal / size
        scaled = np.swapaxes(maps[i, touch] * unit[i, touch][:, None], 0, 1)
        matrix, upper = _limits(fingers, columns, rows, limit, most)
        solution = np.zeros(fingers * columns)
        solution[pulls] = least_effort(
            scaled.reshape(6, -1)[:, pulls],
            -wrench[i] / size,
            weight.ravel()[pulls],
            matrix[:, pulls],
            upper,
        )
        solution = solution.reshape(fingers, columns)
        contact_force[i, touch] = solution * size * unit[i, touch]
    reached = np.einsum("nmij,nmj->ni", maps, contact_force)
    left = np.linalg.norm(reached + wrench, axis=-1)
    forces = np.einsum("nmij,nmj->nmi", basis, contact_force[..., :3])
    torques = None
    if joints is not None:
        torques = np.einsum("nmij,nmi->nj", joints, forces).reshape(*batch, joints.shape[-1])
    twist = contact_force[..., 3] if columns == 4 else np.zeros((len(maps), m))
    return GraspForces(
        forces.reshape(*batch, m, 3),
        contact_force[..., 2].reshape(*batch, m),
        twist.reshape(*batch, m),
        (left <= BALANCE * violation).reshape(batch),
        left.reshape(batch),
        torques,
    )


def _limits(
    count: int, columns: int, rows: Floats, torques: tuple[Floats, Floats], max_normal: float
) -> tuple[Floats, Floats]:
    """Rows and upper limits of what scaled contact forces ``(count * columns,)`` may be."""
    matrix = [np.kron(np.eye(count), rows), torques[0], -torques[0]]
    upper = [np.zeros(count * len(rows)), torques[1], torques[1]]
    if max_normal < UNBOUNDED:
        normal = np.zeros((count, columns))
        normal[:, 2] = 1.0
        matrix.append((np.eye(count)[..., None] * normal[:, None]).reshape(count, -1))
        upper.append(np.full(count, max_normal))
    return np.concatenate(matrix), np.concatenate(upper)


def _finite(value: ArrayLike, name: str, tail: tuple[int, ...], batch: tuple[int, ...]) -> Floats:
    array = numbers(name, value, f"{(*batch, *tail)}")
    if array.shape not in (tail, (*batch, *tail)):
        raise InvalidInput(f"{name} has shape {array.shape}; expected {(*batch, *tail)}")
    if not (np.abs(array) <= MAX_WRENCH).all():
        wanted = f"numbers of at most {MAX_WRENCH:g} N and N m"
        raise InvalidInput(f"{name} is not finite, or too large: {shown(value)}; expected {wanted}")
    array = np.where(np.abs(array) < _NOTHING, 0.0, array)
    return np.broadcast_to(array, (*batch, *tail))


def _check_effort(
    jacobian: ArrayLike | None, effort: ArrayLike | None, cones: FrictionalContacts
) -> tuple[Floats | None, Floats | None]:
    """The Jacobians ``(n, m, 3, d)``, zero out of contact, and the limits ``(d,)``."""
    if jacobian is None:
        if effort is not None:
            raise InvalidInput("effort is given without jacobian; expected both")
        return None, None
    joints = numbers("jacobian", jacobian, f"{(*cones.friction.shape, 3, 'd')}")
    fingers = cones.friction.shape
    if joints.ndim != len(fingers) + 2 or joints.shape[:-1] != (*fingers, 3):
        raise InvalidInput(f"jacobian has shape {joints.shape}; expected {(*fingers, 3, 'd')}")
    joints = np.where(cones.contacts.active[..., None, None], joints, 0.0)
    if not (np.abs(joints) <= MAX_DISTANCE).all():
        raise InvalidInput(
            "jacobian is not finite for a finger in contact, or above "
            f"{MAX_DISTANCE:.0e} m: {shown(jacobian)}"
        )
    joints = joints.reshape(int(np.prod(fingers[:-1])), *joints.shape[-3:])
    if effort is None:
        return joints, None
    limits = numbers("effort", effort, f"{joints.shape[-1]} torque limits")
    if limits.shape != joints.shape[-1:] or not (limits >= 0).all():
        raise InvalidInput(
            f"effort is {shown(effort)}; expected {joints.shape[-1]} torque limits of 0 N m or more"
        )
    return joints, limits
