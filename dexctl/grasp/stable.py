"""Whether a grasp is stable: the static check from contacts, the dynamic one by waiting.

The dynamic check is the thesis's (chapter 5, the stability check of G-RRT): hold the set-points
for 2 s and see whether the object is still there. There a drop is a height below a threshold; a
distance from where the object started, which also serves with the palm down, replaces it.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from dexctl.exceptions import InvalidInput
from dexctl.grasp.closure import is_force_closure
from dexctl.grasp.cones import DEFAULT_EDGES, DEFAULT_TORSION
from dexctl.grasp.contacts import check_mask
from dexctl.grasp.forces import GraspForces, grasp_forces
from dexctl.state import Bools, Floats, GraspState
from dexctl.validation import DAY, number
from dexctl.validation import check_mask as check_chosen

_MOST = float(np.finfo(float).max)


class HoldsSetPoints(Protocol):
    """What the dynamic check needs: any plant whose states say where the object is.

    A plant with ``save()`` and ``restore(saved)`` is left as it was. One with an attribute
    ``diverged``, ``(...)`` bool, has the environments marked there counted as unstable. One that
    takes ``step(mask)`` can be checked in part, or until each has failed.
    """

    control_period: float

    def read(self) -> GraspState:
        """The state now."""
        ...

    def write(self, q_target: Floats) -> Floats:
        """Take set-points ``(..., d)`` [rad]."""
        ...

    def step(self) -> None:
        """Let one control period pass."""
        ...


class StaticStability(NamedTuple):
    """The static check.

    Attributes:
        stable: ``(...)`` bool, all of what follows that was asked for.
        closure: ``(...)`` bool, force closure.
        contacts: ``(...)`` int, fingers in contact.
        forces: what holds the external wrench; None where none was given.
    """

    stable: Bools
    closure: Bools
    contacts: np.ndarray
    forces: GraspForces | None


class DynamicStability(NamedTuple):
    """The dynamic check.

    Attributes:
        stable: ``(...)`` bool.
        displacement: ``(...)`` [m], the farthest that the object was from where it started.
        rotation: ``(...)`` [rad], the farthest that it turned; 0 where orientation is unknown.
        contacts: ``(...)`` int, fingers in contact at the end.
        held: ``(...)`` [s], time up to the first control step that broke a bound.
    """

    stable: Bools
    displacement: Floats
    rotation: Floats
    contacts: np.ndarray
    held: Floats


def check_static(
    contact_position: ArrayLike,
    contact_normal: ArrayLike,
    in_contact: ArrayLike,
    origin: ArrayLike,
    friction: ArrayLike,
    *,
    external_wrench: ArrayLike | None = None,
    jacobian: ArrayLike | None = None,
    effort: ArrayLike | None = None,
    max_normal: float | None = None,
    min_contacts: int = 3,
    model: str = "hard",
    edges: int = DEFAULT_EDGES,
    torsion: float = DEFAULT_TORSION,
) -> StaticStability:
    """Force closure, enough contacts and, for a given wrench, forces within the limits.

    Args:
        contact_position: ``(..., m, 3)`` [m], world frame.
        contact_normal: ``(..., m, 3)``, unit, from the fingertip into the object.
        in_contact: ``(..., m)`` bool; rows of the others are not read.
        origin: ``(..., 3)`` or ``(3,)`` [m].
        friction: coefficient, one number, ``(m,)`` or ``(..., m)``.
        external_wrench: what the grasp must hold, see :func:`grasp_forces`; None: not checked.
        jacobian: see :func:`grasp_forces`.
        effort: joint torque limits, see :func:`grasp_forces`.
        max_normal: greatest normal force of a finger [N]; None: no limit.
        min_contacts: fewest fingers in contact; 0: any number.
        model: "hard" or "soft".
        edges: edges of the inscribed pyramids.
        torsion: torque about the normal over normal force of a soft finger [m].

    Raises:
        InvalidInput: naming the argument, its value and what was expected.
        UnknownName: no such contact model.
    """
    if external_wrench is None and (effort is not None or max_normal is not None):
        raise InvalidInput("effort or max_normal is given without external_wrench to hold")
    closure = is_force_closure(
        contact_position,
        contact_normal,
        in_contact,
        origin,
        friction,
        model=model,
        edges=edges,
        torsion=torsion,
    )
    touch = check_mask(in_contact, np.shape(contact_position)[:-1])
    contacts = touch.sum(axis=-1)
    stable = closure & (contacts >= min_contacts)
    forces = None
    if external_wrench is not None:
        forces = grasp_forces(
            contact_position,
            contact_normal,
            in_contact,
            origin,
            friction,
            external_wrench,
            model=model,
            jacobian=jacobian,
            effort=effort,
            max_normal=max_normal,
            edges=edges,
            torsion=torsion,
        )
        stable = stable & forces.feasible
    return StaticStability(np.asarray(stable), np.asarray(closure), np.asarray(contacts), forces)


def check_stable(
    plant: HoldsSetPoints,
    seconds: float = 2.0,
    *,
    max_distance: float = 0.05,
    max_rotation: float | None = None,
    min_contacts: int = 0,
    fingertips_only: bool = False,
    restore: bool = True,
    early: bool = False,
    mask: ArrayLike | None = None,
) -> DynamicStability:
    """Hold the set-points and see whether the object stays (thesis chapter 5).

    Args:
        plant: one hand, or N; its states must say where the object is.
        seconds: how long to hold [s], rounded up to whole control periods.
        max_distance: how far the object may move from where it is now [m].
        max_rotation: how far it may turn [rad]; None: as far as it will.
        min_contacts: fewest fingers in contact at the end.
        fingertips_only: the object must at no moment touch more of the hand than fingertips; the
            plant says so by its ``other_contact``, ``(...)`` [N].
        restore: put the plant back as it was, where it has save() and restore(); False leaves
            it where the check ended.
        early: step a hand no further once it has broken a bound; what is reported of it is up to
            there. The plant must take ``step(mask)``.
        mask: which hands of N are checked, ``(N,)`` bool; the others stay as they are and count
            as unstable. The plant must take ``step(mask)``.

    Raises:
        InvalidInput: bounds out of range, or a plant that does not track the object.
    """
    seconds = number("seconds", seconds, 0.0, DAY, "seconds above 0, a day at most", above=True)
    wanted = "metres above 0"
    max_distance = number("max_distance", max_distance, 0.0, _MOST, wanted, above=True)
    if max_rotation is not None:
        wanted = "radians above 0, or None"
        max_rotation = number("max_rotation", max_rotation, 0.0, _MOST, wanted, above=True)
    min_contacts = int(number("min_contacts", min_contacts, 0, 1e6, "a number of fingers"))
    period = plant.control_period
    period = number("plant.control_period", period, 1e-6, DAY, "seconds from 1e-6 on")
    start = plant.read()
    if start.object_position is None:
        raise InvalidInput("plant.read().object_position is None; the check needs a tracked object")
    if max_rotation is not None and start.object_quaternion is None:
        raise InvalidInput("plant.read().object_quaternion is None; max_rotation needs it")
    saved = plant.save() if restore and hasattr(plant, "save") else None  # type: ignore[attr-defined]
    try:
        return _hold(
            plant,
            start,
            seconds,
            period,
            max_distance,
            max_rotation,
            min_contacts,
            fingertips_only,
            early,
            None if mask is None else check_chosen(mask, start.batch_shape),
        )
    finally:
        if saved is not None:
            plant.restore(saved)  # type: ignore[attr-defined]


def _hold(
    plant: HoldsSetPoints,
    start: GraspState,
    seconds: float,
    period: float,
    max_distance: float,
    max_rotation: float | None,
    min_contacts: int,
    fingertips_only: bool,
    early: bool,
    mask: Bools | None,
) -> DynamicStability:
    batch = start.batch_shape
    stable = np.ones(batch, bool) if mask is None else mask.copy()
    displacement, rotation, held = np.zeros(batch), np.zeros(batch), np.zeros(batch)
    state = start
    for _ in range(int(np.ceil(seconds / period - 1e-9))):
        plant.write(start.q_target)
        if early or mask is not None:
            if not stable.any():
                break
            plant.step(stable if early else mask)  # type: ignore[call-arg]
        else:
            plant.step()
        state = plant.read()
        moved = _distance(start.object_position, state.object_position)
        turned = _angle(start.object_quaternion, state.object_quaternion)
        # Not "> bound": NaN counts as gone. fmax keeps the numbers reported finite.
        stable &= moved <= max_distance
        if max_rotation is not None:
            stable &= turned <= max_rotation
        stable &= ~np.asarray(getattr(plant, "diverged", False), bool)
        if fingertips_only:
            stable &= np.asarray(plant.other_contact) == 0  # type: ignore[attr-defined]
        displacement = np.fmax(displacement, moved)
        rotation = np.fmax(rotation, turned)
        held = held + period * stable
    contacts = state.in_contact.sum(axis=-1)
    stable = stable & (contacts >= min_contacts)
    return DynamicStability(np.asarray(stable), displacement, rotation, np.asarray(contacts), held)


def _distance(before: Floats | None, after: Floats | None) -> Floats:
    """How far the object moved [m]; NaN where it is no longer tracked."""
    if before is None or after is None:
        return np.asarray(np.nan)
    return np.sqrt(((after - before) ** 2).sum(axis=-1))


def _angle(before: Floats | None, after: Floats | None) -> Floats:
    """Angle between two orientations, wxyz ``(..., 4)`` [rad]; 0 where they are unknown."""
    if before is None or after is None:
        return np.asarray(0.0)
    w0, w1 = before[..., 0], after[..., 0]
    v0, v1 = before[..., 1:], after[..., 1:]
    vector = w0[..., None] * v1 - w1[..., None] * v0 - np.cross(v0, v1)
    scalar = w0 * w1 + np.einsum("...i,...i->...", v0, v1)
    return 2 * np.arctan2(np.linalg.norm(vector, axis=-1), np.abs(scalar))
