"""Where the bodies of a description are, and which of them move together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from scipy.spatial.transform import Rotation

from dexctl.description.tree import Description, Joint
from dexctl.state import Floats


def placements(description: Description, q: Mapping[str, float]) -> list[tuple[Floats, Floats]]:
    """Rotation ``(3, 3)`` and origin ``(3,)`` [m] of each body in the file's world frame.

    Args:
        description: the tree.
        q: positions of joints [rad or m]; those left out, and joints that are neither hinge nor
            slide, are at their reference. Couplings are the caller's part.
    """
    found: list[tuple[Floats, Floats]] = []
    for body in description.bodies:
        rotation, origin = body.rotation, body.translation
        for joint in body.joints:
            travel = q.get(joint.name, joint.reference) - joint.reference
            if joint.kind == "hinge":
                turn = Rotation.from_rotvec(travel * joint.axis).as_matrix()
                origin = origin + rotation @ (joint.anchor - turn @ joint.anchor)
                rotation = rotation @ turn
            elif joint.kind == "slide":
                origin = origin + rotation @ (travel * joint.axis)
        if body.parent >= 0:
            above, at = found[body.parent]
            rotation, origin = above @ rotation, above @ origin + at
        found.append((rotation, origin))
    return found


@dataclass
class Segment:
    """Bodies that move as one: the first has joints (but the world's), the others hang on it fast.

    Attributes:
        bodies: their numbers, parents first.
        joints: of the first.
        parent: number of the segment that it hangs on, -1 for the world's.
        children: numbers of the segments that hang on it.
    """

    bodies: list[int]
    joints: list[Joint]
    parent: int
    children: list[int]


def segments(description: Description) -> list[Segment]:
    """The moving parts of a description, parents first; the first is what does not move."""
    found = [Segment([], [], -1, [])]
    own: list[int] = []
    for i, body in enumerate(description.bodies):
        at = own[body.parent] if body.parent >= 0 else 0
        if body.joints:
            found.append(Segment([], body.joints, at, []))
            found[at].children.append(len(found) - 1)
            at = len(found) - 1
        found[at].bodies.append(i)
        own.append(at)
    return found
