"""Contact forces inside friction cones that balance an external wrench with least effort.

The grasp's force distribution (Kerr and Roth 1986; Prattichizzo and Trinkle, section 38.5), with
friction pyramids inscribed in the cones and joint torque limits, as a QP solved by ProxQP.
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
from dexctl.grasp.contacts import MAX_DISTANCE
from dexctl.state import Bools, Floats
from dexctl.validation import number, numbers, shown

BALANCE = 1e-6
"""Share of the external wrench that feasible forces may leave unbalanced."""
MAX_WRENCH = 1e9
"""Greatest force and torque that is asked for [N, N m]."""
_ACCURACY = 1e-8
_NOTHING = 1e-100  # N; what is below would be lost in squares
_UNBOUNDED = 1e20  # to ProxQP
_MAX_ITERATIONS = 40
_MAX_INNER_ITERATIONS = 100
_EFFORT_SHARE = 3e-4  # weight of the effort beside the wrench left over
_MAX_ROUNDS = 20
_SETTLED = 1e-8
_LEAST_FRICTION = 1e-3  # weight floor, so that frictionless contacts leave no direction free


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
        in_contact: ``(..., m)`` bool; rows of the others are not read.
        origin: ``(..., 3)`` or ``(3,)`` [m], the point that torques are taken about.
        friction: coefficient, one number, ``(m,)`` or ``(..., m)``.
        external_wrench: ``(..., 6)`` or ``(6,)``, force [N] and torque [N m] that act on the
            object, gravity for one: (0, 0, -m g, 0, 0, 0) about the centre of mass.
        model: "hard" or "soft".
        jacobian: contact Jacobians ``(..., m, 3, d)``, from ``HandModel.contact_jacobian``.
        effort: joint torque limits ``(d,)`` [N m], ``|J^T f| <= effort``; needs the Jacobian. Only
            the forces count, not the torques of soft fingers, nor the weight of the fingers.
        max_normal: greatest normal force of a finger [N]; None: no limit.
        edges: edges of the pyramids inscribed in the cones.
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
    batch, m = cones.friction.shape[:-1], cones.friction.shape[-1]
    wrench = _finite(external_wrench, "external_wrench", (6,), batch)
    if max_normal is not None:
        wanted = f"newtons above 0, to {MAX_WRENCH:g}, or None"
        max_normal = number("max_normal", max_normal, 0.0, MAX_WRENCH, wanted, above=True)
    joints, limits = _check_effort(jacobian, effort, cones)
    scale = cones.length[..., None]
    wrench = np.concatenate([wrench[..., :3], wrench[..., 3:] / scale], axis=-1)

    count, columns = int(np.prod(batch)), cones.maps.shape[-1]
    maps = cones.maps.reshape(count, m, 6, columns)
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
        weight = np.maximum(unit[i, touch], _LEAST_FRICTION)
        weight[:, 3:] = cones.torsion / lengths[i]
        limit = np.empty((0, columns * touch.sum())), np.empty(0)
        if joints is not None and limits is not None:
            torque = np.swapaxes(joints[i, touch], -1, -2) @ basis[i, touch]  # (k, d, 3)
            torque = np.concatenate([torque, np.zeros((*torque.shape[:-1], columns - 3))], axis=-1)
            torque = np.swapaxes(torque * unit[i, touch][:, None], 0, 1).reshape(limits.size, -1)
            bounded = limits < _UNBOUNDED * size
            limit = torque[bounded], limits[bounded] / size
        solution = _least_effort(
            maps[i, touch] * unit[i, touch][:, None],
            -wrench[i] / size,
            weight,
            rows,
            limit,
            None if max_normal is None else min(max_normal / size, _UNBOUNDED),
        )
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


def _least_effort(
    maps: Floats,
    target: Floats,
    weight: Floats,
    rows: Floats,
    limit: tuple[Floats, Floats],
    max_normal: float | None,
) -> Floats:
    """Scaled contact forces ``(k, c)`` whose wrench is ``target`` (6,), or as near as can be.

    What is left over has six variables of its own: no forces at all are always feasible, and
    the Hessian stays diagonal (ProxQP takes a minute over the singular G'G, and calls some
    feasible equalities infeasible). The effort has a small weight beside it, whose effect the
    method of multipliers takes away: what is left over is asked for again on top.
    """
    import proxsuite  # here, so that importing dexctl does not load it

    k, _, columns = maps.shape
    count = k * columns
    grasp = np.swapaxes(maps, 0, 1).reshape(6, count)
    matrix = np.vstack([np.kron(np.eye(k), rows), limit[0]])
    upper = np.concatenate([np.zeros(k * len(rows)), limit[1]])
    lower = np.concatenate([np.full(k * len(rows), -_UNBOUNDED), -limit[1]])
    if max_normal is not None:
        normal = np.zeros((k, count))
        normal[np.arange(k), np.arange(k) * columns + 2] = 1.0
        matrix = np.vstack([matrix, normal])
        upper = np.concatenate([upper, np.full(k, max_normal)])
        lower = np.concatenate([lower, np.full(k, -_UNBOUNDED)])
    qp = proxsuite.proxqp.dense.QP(count + 6, 6, len(upper))
    qp.settings.eps_abs = _ACCURACY
    qp.settings.max_iter = _MAX_ITERATIONS
    qp.settings.max_iter_in = _MAX_INNER_ITERATIONS
    # Its warm start before a first solve crashes the process.
    qp.settings.initial_guess = proxsuite.proxqp.InitialGuess.NO_INITIAL_GUESS
    qp.init(
        np.diag(np.concatenate([_EFFORT_SHARE * weight.ravel() ** 2, np.ones(6)])),
        np.zeros(count + 6),
        np.hstack([grasp, -np.eye(6)]),
        target,
        np.hstack([matrix, np.zeros((len(matrix), 6))]),
        lower,
        upper,
    )
    asked, forces = target, np.zeros(count)
    for _ in range(_MAX_ROUNDS):
        qp.solve()
        found = np.array(qp.results.x)[:count]
        if not np.isfinite(found).all():
            break
        change, forces = np.abs(found - forces).max(), found
        if change < _SETTLED:
            break
        asked = asked + (target - grasp @ forces)
        qp.settings.initial_guess = proxsuite.proxqp.InitialGuess.WARM_START_WITH_PREVIOUS_RESULT
        qp.update(b=asked)
    return forces.reshape(k, columns)


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
