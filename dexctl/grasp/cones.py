"""Friction cones, and the pyramids inscribed in them.

A point contact with friction mu carries f with |f_t| <= mu f_n. A soft finger carries a torque
tau about the normal too, within the ellipsoid (|f_t| / mu)^2 + (tau / torsion)^2 <= f_n^2 (Howe
and Cutkosky; Prattichizzo and Trinkle). The circle is replaced by the regular polygon inscribed
in it, and the ellipsoid by the double pyramid over that polygon, so whatever a pyramid can hold
the true cone can too.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from dexctl.exceptions import InvalidInput
from dexctl.grasp.contacts import Contacts, check_contacts, check_model, tangent_basis
from dexctl.grasp.stability import characteristic_length
from dexctl.state import Floats
from dexctl.validation import number, numbers, shown

MODELS = ("hard", "soft")
MIN_EDGES = 3
MAX_EDGES = 64
MAX_FRICTION = 1e3
TORSION = (1e-6, 1e3)
"""Least and greatest torsion [m]."""
_FRICTIONLESS = 1e-9
DEFAULT_EDGES = 16
"""Edges of the inscribed pyramid; its least friction is cos(pi / 16) = 0.981 of the cone's."""
DEFAULT_TORSION = 0.005
"""Torque about the normal that a soft finger carries, over its normal force [m]."""


class FrictionalContacts(NamedTuple):
    """Checked contacts with their cones.

    Attributes:
        contacts: positions relative to the origin, normals, mask.
        basis: ``(..., m, 3, 3)``; columns are two tangents and the normal.
        friction: mu, ``(..., m)``.
        torsion: torque over normal force [m]; 0 for hard fingers.
        edges: edges of the inscribed polygon.
        length: ``(...)`` [m], what torques are divided by.
    """

    contacts: Contacts
    basis: Floats
    friction: Floats
    torsion: float
    edges: int
    length: Floats

    @property
    def rays(self) -> Floats:
        """Edges of the pyramids in contact axes, ``(..., m, e, 4)``.

        Two tangential forces, the normal force (1) and the torque about the normal [N m].
        """
        angle = 2 * np.pi * np.arange(self.edges) / self.edges
        rays = np.zeros((*self.friction.shape, self.edges + 2 * (self.torsion > 0), 4))
        rays[..., : self.edges, 0] = self.friction[..., None] * np.cos(angle)
        rays[..., : self.edges, 1] = self.friction[..., None] * np.sin(angle)
        rays[..., 2] = 1.0
        if self.torsion > 0:
            rays[..., -2, 3], rays[..., -1, 3] = self.torsion, -self.torsion
        return rays

    @property
    def maps(self) -> Floats:
        """Wrench of a contact force in contact axes, ``(..., m, 6, 3 or 4)``, torques / length.

        Zero for fingers out of contact.
        """
        active = self.contacts.active[..., None, None]
        forces = np.where(active, self.basis, 0.0)
        length = self.length[..., None, None, None]
        torques = np.cross(self.contacts.position[..., None], forces, axis=-2) / length
        maps = np.concatenate([forces, torques], axis=-2)
        if self.torsion == 0:
            return maps
        twist = np.zeros((*maps.shape[:-1], 1))
        twist[..., 3:, 0] = self.contacts.normal / length[..., 0]
        return np.concatenate([maps, twist], axis=-1)


def check_cones(
    contact_position: ArrayLike,
    contact_normal: ArrayLike,
    in_contact: ArrayLike,
    origin: ArrayLike,
    friction: ArrayLike,
    model: str,
    edges: int,
    torsion: float,
    length: ArrayLike | None = None,
) -> FrictionalContacts:
    """The contacts and their cones, checked.

    Raises:
        InvalidInput: naming the argument, its value and what was expected.
        UnknownName: no such contact model.
    """
    check_model(model, MODELS)
    if not (isinstance(edges, (int, np.integer)) and MIN_EDGES <= edges <= MAX_EDGES):
        raise InvalidInput(
            f"edges is {shown(edges)}; expected a whole number from {MIN_EDGES} to {MAX_EDGES}"
        )
    if model == "soft":
        torsion = number("torsion", torsion, *TORSION, f"{TORSION[0]:g} to {TORSION[1]:g} m")
    contacts = check_contacts(contact_position, contact_normal, in_contact, origin)
    shape = contacts.active.shape
    mu = numbers("friction", friction, f"one number or {shape}")
    if mu.shape not in ((), shape, shape[-1:]):
        raise InvalidInput(f"friction has shape {mu.shape}; expected one number or {shape}")
    mu = np.where(contacts.active, mu, 0.0)
    if not ((mu >= 0) & (mu <= MAX_FRICTION)).all():
        raise InvalidInput(
            f"friction is {shown(friction)}; expected coefficients of 0 to {MAX_FRICTION:g}"
        )
    mu = np.where(mu < _FRICTIONLESS, 0.0, mu)
    return FrictionalContacts(
        contacts,
        tangent_basis(contacts.normal),
        mu,
        float(torsion) if model == "soft" else 0.0,
        int(edges),
        characteristic_length(contacts, length),
    )


def primitive_wrenches(cones: FrictionalContacts) -> Floats:
    """Wrenches of the pyramids' edges at unit normal force, ``(..., 6, m e)``.

    Torques are divided by the length; zero for fingers out of contact.
    """
    maps = cones.maps
    wrenches = maps @ np.swapaxes(cones.rays[..., : maps.shape[-1]], -1, -2)
    wrenches = np.swapaxes(wrenches, -3, -2)
    return wrenches.reshape(*wrenches.shape[:-2], wrenches.shape[-2] * wrenches.shape[-1])


def facets(edges: int, soft: bool) -> Floats:
    """Half-spaces of the pyramid, ``(rows, 3 or 4)``: rows @ (f_t / mu, f_n, tau / torsion) <= 0.

    The tangential forces are the first two entries, the normal force the third.
    """
    angle = (2 * np.arange(edges) + 1) * np.pi / edges
    apothem = np.cos(np.pi / edges)
    rows = np.stack([np.cos(angle) / apothem, np.sin(angle) / apothem, -np.ones(edges)], axis=-1)
    if not soft:
        return rows
    return np.vstack([np.hstack([rows, np.full((edges, 1), s)]) for s in (1.0, -1.0)])
