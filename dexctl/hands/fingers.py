"""Which parts of a description are fingers, and where their tips are: a proposal from the file."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from dexctl.description import Description, root_tag
from dexctl.description.geometry import body_points, missing_meshes
from dexctl.description.placement import Segment, placements, segments
from dexctl.exceptions import HandModelError, UnknownName
from dexctl.state import Floats

_SHORT = 0.4  # a branch of less than this part of the median length is no finger
_FAR = 0.9  # points this far from the last joint, as a part of the farthest, are the tip's end


@dataclass(frozen=True)
class Finger:
    """A finger as it was found.

    Attributes:
        body: the body that the tip is on, or the site that it is at.
        offset: where the tip is in its frame ``(3,)`` [m].
        radius: half the width of the tip [m].
        width: of its last two links, along the axis of the last joint [m].
        joints: its own, base to tip, those that follow others among them.
        base: where the first of them is ``(3,)`` [m], world frame of the file, joints at zero or
            at the end of their range that is nearest to it.
        tip: where the tip is then ``(3,)`` [m].
    """

    body: str
    offset: Floats
    radius: float
    width: float
    joints: tuple[str, ...]
    base: Floats
    tip: Floats


class Fingers(NamedTuple):
    """What was found in a file.

    Attributes:
        fingers: in the order of the file.
        trunk: joints that all of them share (an arm, a wrist), base to tip.
        dropped: why other ends of the tree are no fingers, by body.
        drawn: bodies of fingers that have visual geometry only.
    """

    fingers: list[Finger]
    trunk: tuple[str, ...]
    dropped: dict[str, str]
    drawn: tuple[str, ...]


def stretched(description: Description) -> dict[str, float]:
    """Every joint at zero, or at the end of its range that is nearest to it."""
    return {
        name: float(np.clip(0.0, joint.lower, joint.upper))
        for name, joint in description.joints.items()
    }


def find_fingers(
    description: Description, chosen: tuple[str, ...] = (), base: str | None = None
) -> Fingers:
    """The fingers of a hand: the ends of the tree that carry geometry.

    Args:
        description: the file.
        chosen: bodies, links or sites that are the fingertips; none: found.
        base: only what hangs on this body.

    Raises:
        UnknownName: there is no such body or site.
        HandModelError: no finger, those of several hands, a joint that is neither hinge nor slide
            on the way to one, a chosen fingertip that does not move, that moves with another, or of
            which nothing says where it ends.
    """
    (points, drawn), parts = body_points(description), segments(description)
    names = [body.name for body in description.bodies]
    for name in chosen:
        if name not in names and name not in description.sites:
            raise UnknownName("body", name, [*names, *description.sites])
    if base and base not in names:
        raise UnknownName("body", base, names)
    if chosen:
        leaves, dropped = _chosen_leaves(description, parts, points, chosen), {}
    else:
        below = _below(description, None if base is None else names.index(base))
        leaves, dropped = _leaves(description, parts, points, below)
    chains = {leaf: _chain(parts, leaf) for leaf in leaves}
    trunk = [s for s in chains[leaves[0]] if all(s in chain for chain in chains.values())]
    if len(leaves) == 1:
        trunk = []
    if not chosen:
        _check_one_hand(description, parts, chains, trunk)
    placed = placements(description, stretched(description))
    found = {
        leaf: _finger(description, parts, points, placed, leaf, chain[_own_from(chains, leaf) :])
        for leaf, chain in chains.items()
    }
    if not chosen:
        _drop_short(found, dropped)
    if chosen:  # the tip is on the body that was named, wherever the far end is
        found = {
            leaf: _moved(description, placed, finger, name, _has_shape(parts[leaf], points))
            for name, (leaf, finger) in zip(chosen, found.items(), strict=True)
        }
    held = tuple(joint.name for s in trunk for joint in parts[s].joints)
    bare = [description.bodies[b].name for s in found for b in parts[s].bodies if b in drawn]
    return Fingers(list(found.values()), held, dropped, tuple(bare))


def _has_shape(part: Segment, points: list[Floats]) -> bool:
    return any(len(points[body]) for body in part.bodies)


def _chosen_leaves(
    description: Description,
    parts: list[Segment],
    points: list[Floats],
    chosen: tuple[str, ...],
) -> list[int]:
    """The segments of fingertips that were named, one each."""
    names = [body.name for body in description.bodies]
    of_body = {body: s for s, part in enumerate(parts) for body in part.bodies}
    found: dict[int, str] = {}
    for name in chosen:
        body = names.index(name) if name in names else description.sites[name][0]
        leaf = of_body[body]
        if leaf == 0:
            raise HandModelError(f"{description.path}: no joint moves the fingertip {name!r}")
        if found.get(leaf) == name:
            raise HandModelError(f"{description.path}: the fingertip {name!r} is named twice")
        if leaf in found:
            raise HandModelError(
                f"{description.path}: the fingertips {found[leaf]!r} and {name!r} move as one; "
                "name one for each finger"
            )
        if body == parts[leaf].bodies[0] and name in names and not _has_shape(parts[leaf], points):
            raise HandModelError(
                f"{description.path}: the fingertip {name!r} has no geometry that can be read: "
                "give it one, or name a link or site that is fixed to it where the tip is"
            )
        found[leaf] = name
    return list(found)


def _below(description: Description, base: int | None) -> set[int]:
    if base is None:
        return set(range(len(description.bodies)))
    found = {base}
    for i, body in enumerate(description.bodies):  # parents first
        if body.parent in found:
            found.add(i)
    return found


def _check_meshes(description: Description, part: Segment, points: list[Floats]) -> None:
    """Raise HandModelError where a link at the end has no shape since its meshes are missing.

    Drawn ones count where nothing else of the part has a shape; decoration may be missing.
    """
    if root_tag(description.path) != "robot":
        return
    kinds = ("collision",) if _has_shape(part, points) else ("collision", "visual")
    for body in part.bodies:
        if len(points[body]):
            continue
        link = description.bodies[body].name
        if missing := missing_meshes(description.path, link, kinds):
            raise HandModelError(
                f"{description.path}: link {link!r}: no mesh {missing[0]!r} that can be read (STL "
                "or OBJ, beside the file or below a folder in ROS_PACKAGE_PATH); without it "
                "nobody knows whether that is a fingertip"
            )


def _leaves(
    description: Description, parts: list[Segment], points: list[Floats], below: set[int]
) -> tuple[list[int], dict[str, str]]:
    """Segments that nothing with a shape hangs on; and what was left out."""
    dropped: dict[str, str] = {}

    def name(s: int) -> str:
        return description.bodies[parts[s].bodies[-1]].name

    solid = [_has_shape(part, points) for part in parts]
    carries = solid.copy()
    for s in range(len(parts) - 1, 0, -1):
        carries[parts[s].parent] |= carries[s]
    leaves = []
    for s in range(1, len(parts)):
        part = parts[s]
        if any(carries[child] for child in part.children) or part.bodies[0] not in below:
            continue
        _check_meshes(description, part, points)
        if not solid[s]:
            if not part.children:
                dropped[name(s)] = "no geometry"
            continue
        above = [joint for one in _chain(parts, s) for joint in parts[one].joints]
        other = [joint for joint in above if joint.kind not in ("hinge", "slide")]
        if other:
            why = f"moves on the {other[0].kind} joint {other[0].name!r}"
            # what lies about free, or hangs on one such joint, is no part of the hand; a finger
            # that has one cannot be controlled, and is not to be missing without a word
            if len(other) < len(above) and above[0].kind != "free":
                raise HandModelError(
                    f"{description.path}: {name(s)!r} {why}; the base must be fixed and fingers "
                    "have hinge or slide joints only; make it one, or say which other bodies are "
                    "the fingertips"
                )
            dropped[name(s)] = why
            continue
        leaves.append(s)
    if not leaves:
        reasons = "".join(f"; {body}: {why}" for body, why in dropped.items())
        raise HandModelError(
            f"{description.path}: no end of the tree carries geometry and moves on hinge or slide "
            f"joints over a fixed base; say which bodies are the fingertips{reasons}"
        )
    return sorted(leaves, key=lambda leaf: _chain(parts, leaf)), dropped


def _chain(parts: list[Segment], leaf: int) -> list[int]:
    """Segments from the world's (which is left out) to ``leaf``."""
    found = []
    while leaf > 0:
        found.append(leaf)
        leaf = parts[leaf].parent
    return found[::-1]


def _own_from(chains: dict[int, list[int]], leaf: int) -> int:
    """From which place of its chain on segments are the leaf's alone."""
    others = {s for other, chain in chains.items() if other != leaf for s in chain}
    chain = chains[leaf]
    return next((i for i, s in enumerate(chain) if s not in others), len(chain) - 1)


def _check_one_hand(
    description: Description, parts: list[Segment], chains: dict[int, list[int]], trunk: list[int]
) -> None:
    """Raise where the fingers hang in bundles on bodies far apart: several hands."""
    bundles: dict[int, list[int]] = {}
    for leaf, chain in chains.items():
        bundles.setdefault(chain[min(len(trunk), len(chain) - 1)], []).append(leaf)
    hands = [first for first, leaves in bundles.items() if len(leaves) > 1]
    if len(hands) < 2:
        # two hands that are fixed to the world: bundles by the body that their fingers hang on
        on: dict[int, list[int]] = {}
        for first in bundles:
            on.setdefault(description.bodies[parts[first].bodies[0]].parent, []).append(first)
        bodies = [body for body, fingers in on.items() if len(fingers) > 2 and body >= 0]
    else:
        bodies = [parts[first].bodies[0] for first in hands]
    if len(bodies) > 1:
        named = " and ".join(repr(description.bodies[body].name) for body in bodies)
        raise HandModelError(
            f"{description.path}: {len(bodies)} hands, below {named}; write a toml of one of them: "
            f"dexctl hands add {shlex.quote(description.path.name)} --base "
            f"{shlex.quote(description.bodies[bodies[0]].name)}"
        )


def _finger(
    description: Description,
    parts: list[Segment],
    points: list[Floats],
    placed: list[tuple[Floats, Floats]],
    leaf: int,
    own: list[int],
) -> Finger:
    part = parts[leaf]
    rotation, origin = placed[part.bodies[0]]
    anchor = rotation @ part.joints[-1].anchor + origin
    clouds = [points[body] @ placed[body][0].T + placed[body][1] for body in part.bodies]
    owner = np.concatenate(
        [np.full(len(cloud), body) for body, cloud in zip(part.bodies, clouds, strict=True)]
    )
    cloud = np.concatenate(clouds) if len(owner) else anchor[None]
    distance = np.linalg.norm(cloud - anchor, axis=1)
    far = distance >= _FAR * distance.max()
    along = cloud[far].mean(axis=0) - anchor
    length = float(np.linalg.norm(along))
    along = along / length if length > 0 else rotation[:, 2]
    reach = (cloud - anchor) @ along
    end = float(reach.max())
    # the narrow half of the last part is the radius of what touches
    last = cloud[reach > end - 0.012] - anchor
    across = last - np.outer(last @ along, along)
    narrow = np.linalg.eigh(across.T @ across)[1][:, 1]  # 0 is along the finger
    radius = float(np.clip(np.ptp(across @ narrow) / 2, 0.0, 0.5 * max(end, 0.0)))
    tip = anchor + (end - radius) * along
    body = int(np.bincount(owner[far]).argmax()) if len(owner) else part.bodies[-1]
    axis = rotation @ part.joints[-1].axis
    links = [
        clouds,
        [points[b] @ placed[b][0].T + placed[b][1] for s in own[-2:-1] for b in parts[s].bodies],
    ]
    widths = [float(np.ptp(np.concatenate(one) @ axis)) for one in links if sum(map(len, one))]
    first = parts[own[0]]
    turn, at = placed[first.bodies[0]]
    turn_of_tip, at_tip = placed[body]
    return Finger(
        body=description.bodies[body].name,
        offset=turn_of_tip.T @ (tip - at_tip),
        radius=radius,
        width=max(widths, default=0.0),
        joints=tuple(joint.name for s in own for joint in parts[s].joints),
        base=turn @ first.joints[0].anchor + at,
        tip=tip,
    )


def _moved(
    description: Description,
    placed: list[tuple[Floats, Floats]],
    finger: Finger,
    name: str,
    has_shape: bool,
) -> Finger:
    """The finger with its tip on the body ``name``, or at the site of that name.

    A body stands for its origin where nothing that moves with it has a shape.
    """
    if all(body.name != name for body in description.bodies):  # a site is a point as it is
        body, at = description.sites[name]
        rotation, origin = placed[body]
        tip = rotation @ at + origin
        return replace(finger, body=name, offset=np.zeros(3), tip=tip)
    index = next(i for i, body in enumerate(description.bodies) if body.name == name)
    rotation, origin = placed[index]
    tip = finger.tip if has_shape else origin
    return replace(finger, body=name, offset=rotation.T @ (tip - origin), tip=tip)


def _drop_short(found: dict[int, Finger], dropped: dict[str, str]) -> None:
    lengths = {leaf: float(np.linalg.norm(f.tip - f.base)) for leaf, f in found.items()}
    joints = {leaf: len(finger.joints) for leaf, finger in found.items()}
    middle, usual = np.median(list(lengths.values())), np.median(list(joints.values()))
    for leaf, finger in list(found.items()):
        why = None
        if lengths[leaf] < _SHORT * middle:
            why = f"{1000 * lengths[leaf]:.0f} mm long, the others {1000 * middle:.0f} mm"
        elif joints[leaf] < usual / 2:
            why = f"{joints[leaf]} joint of its own, the others {usual:.0f}"
        if why and len(found) > 2:
            dropped[finger.body] = why
            del found[leaf]
