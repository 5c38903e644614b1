"""The tree of bodies and joints that MJCF and URDF files are read into."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from dexctl.exceptions import HandModelError
from dexctl.state import Floats

FARTHEST = 100.0
"""A body or link further from its parent than this is no part of a hand [m]."""


@dataclass
class Joint:
    """One joint; ``kind`` is hinge, slide, or what the file calls a joint that is neither.

    Axis and anchor are in the frame of the body that the joint moves; ``reference`` is the joint
    position at which the body sits at its placement.
    """

    name: str
    kind: str
    axis: Floats
    anchor: Floats = field(default_factory=lambda: np.zeros(3))
    reference: float = 0.0
    lower: float = -np.inf
    upper: float = np.inf
    effort: float = np.inf
    velocity: float = np.inf


@dataclass
class Body:
    """A rigid body: placement (rotation, translation) in its parent (-1: the world)."""

    name: str
    parent: int
    rotation: Floats
    translation: Floats
    joints: list[Joint] = field(default_factory=list)


@dataclass
class Mimic:
    """``joint = scale * master + offset``; with no master the joint is held at ``offset``."""

    master: str | None
    scale: float
    offset: float
    linear: bool = True  # False: the file couples them otherwise, which is not supported


@dataclass
class Description:
    """The bodies parents first, the sites as (body index, offset), and the coupled joints."""

    path: Path
    bodies: list[Body]
    sites: dict[str, tuple[int, Floats]]
    mimics: dict[str, Mimic]

    @cached_property
    def joints(self) -> dict[str, Joint]:
        """The joints by name, in the order of the bodies."""
        return {joint.name: joint for body in self.bodies for joint in body.joints}

    def resolve(self, joint: str) -> Mimic:
        """What ``joint`` follows in the end, through chains of mimics; itself if nothing.

        Raises:
            HandModelError: the chain is a loop, ends at a joint that is not there, or is not
                linear.
        """
        found, seen = Mimic(joint, 1.0, 0.0), [joint]
        while found.master in self.mimics:
            mimic = self.mimics[found.master]
            if not mimic.linear:
                raise HandModelError(
                    f"{self.path}: joint {found.master!r} follows another by a polynomial of "
                    "degree 2 or more; only linear couplings are supported"
                )
            if mimic.master in seen:
                raise HandModelError(
                    f"{self.path}: joint {joint!r} follows itself through {', '.join(seen)}"
                )
            offset = found.offset + found.scale * mimic.offset
            found = Mimic(mimic.master, found.scale * mimic.scale, offset)
            if mimic.master is not None:
                seen.append(mimic.master)
        if found.master is not None and found.master not in self.joints:
            raise HandModelError(
                f"{self.path}: joint {joint!r} follows {found.master!r}, which is not there; "
                f"joints: {', '.join(self.joints)}"
            )
        return found
