"""URDF files: links, joints, limits and mimics."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from dexctl.description.tree import FARTHEST, Body, Description, Joint, Mimic
from dexctl.description.xml_text import parse_xml
from dexctl.exceptions import HandModelError
from dexctl.state import Floats


def read_urdf(path: Path) -> Description:
    """Read a URDF file: links, joints, limits and mimics; meshes are not looked at."""
    robot = parse_xml(path)
    if robot.tag != "robot":
        raise HandModelError(f"{path}: the root element is <{robot.tag}>; a URDF has <robot>")
    links = [link.get("name", "") for link in robot.findall("link")]
    elements = robot.findall("joint")
    for kind, names in (("links", links), ("joints", [e.get("name", "") for e in elements])):
        twice = sorted(name for name, count in Counter(names).items() if count > 1)
        if twice:
            raise HandModelError(f"{path}: several {kind} are called {', '.join(map(repr, twice))}")
    for link in robot.findall("link"):
        _check_mass(path, link)
        _check_shapes(path, link)
    place = {name: i for i, name in enumerate(links)}
    incoming: dict[str, tuple[str, _UrdfJoint]] = {}
    for element in elements:
        joint = _UrdfJoint(path, element)
        parent, child = joint.link("parent", place), joint.link("child", place)
        if child in incoming:
            other = incoming[child][1].name
            raise HandModelError(
                f"{path}: the link {child!r} is the child of two joints, {other!r} and "
                f"{joint.name!r}"
            )
        incoming[child] = (parent, joint)

    children: dict[str, list[str]] = {}
    for child, (parent, _) in incoming.items():
        children.setdefault(parent, []).append(child)
    bodies: list[Body] = []
    index: dict[str, int] = {}
    mimics: dict[str, Mimic] = {}
    layer = [name for name in links if name not in incoming]
    while layer:
        for name in layer:
            index[name] = len(bodies)
            if name in incoming:
                parent, joint = incoming[name]
                rotation, translation = joint.origin()
                bodies.append(Body(name, index[parent], rotation, translation, joint.joints()))
                mimics.update(joint.mimics())
            else:
                bodies.append(Body(name, -1, np.eye(3), np.zeros(3)))
        below = {child for name in layer for child in children.get(name, ())}
        layer = sorted(below, key=place.__getitem__)
    if len(bodies) < len(links):
        pending = [name for name in links if name not in index]
        raise HandModelError(f"{path}: the links {', '.join(pending)} form a loop")
    return Description(path, bodies, {}, mimics)


def rotation_of(rpy: Floats) -> Floats:
    """The rotation matrix of roll, pitch and yaw about fixed axes [rad]."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def numbers(text: str | None, count: int) -> Floats:
    """``count`` numbers out of an attribute; zeros where it is missing or holds none."""
    try:
        values = np.array([float(word) for word in (text or "").split()])
    except ValueError:
        values = np.zeros(0)
    usable = len(values) == count and np.isfinite(values).all()
    return values if usable else np.zeros(count)


def _check_mass(path: Path, link: ElementTree.Element) -> None:
    mass = link.find("inertial/mass")
    text = "0" if mass is None else mass.get("value", "")
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not 0 <= value < np.inf:
        raise HandModelError(
            f"{path}: link {link.get('name')!r} has the mass {text!r}; expected a finite number, "
            "0 or more"
        )


_COUNTS = {"xyz": 3, "rpy": 3, "size": 3, "scale": 3, "radius": 1, "length": 1}
_COUNTS |= dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), 1)
"""How many numbers attributes of a link have."""


def _check_shapes(path: Path, link: ElementTree.Element) -> None:
    """Raise HandModelError where a number of its inertia or of what it collides with is none."""
    for part in (*link.findall("inertial"), *link.findall("collision")):
        for element in part.iter():
            for name in _COUNTS.keys() & element.keys():
                text, count = element.get(name, ""), _COUNTS[name]
                try:
                    values = [float(word) for word in text.split()]
                except ValueError:
                    values = []
                if len(values) != count or not np.isfinite(values).all():
                    wanted = "a finite number" if count == 1 else f"{count} finite numbers"
                    raise HandModelError(
                        f"{path}: link {link.get('name')!r} has {name}={text!r} in the "
                        f"<{element.tag}> of its <{part.tag}>; expected {wanted}"
                    )


class _UrdfJoint:
    """One <joint> of a URDF; every error names the file, the joint and the attribute."""

    def __init__(self, path: Path, element: ElementTree.Element) -> None:
        self.path = path
        self.element = element
        self.name = element.get("name", "")
        self.type = element.get("type", "")

    def link(self, tag: str, links: Mapping[str, int]) -> str:
        """The name of the parent or child link."""
        found = self.element.find(tag)
        if found is None:
            raise self._error("lacks parent or child")
        name = found.get("link", "")
        if name not in links:
            raise self._error(
                f"names the link {name!r}, which is not there; links: {', '.join(links)}"
            )
        return name

    def origin(self) -> tuple[Floats, Floats]:
        """Rotation and translation of the child link in the parent link, at joint position 0."""
        rotation = rotation_of(self._numbers("origin", "rpy", (0, 0, 0)))
        translation = self._numbers("origin", "xyz", (0, 0, 0))
        if np.abs(translation).max() > FARTHEST:
            found = " ".join(f"{one:g}" for one in translation)
            raise self._error(
                f"has xyz={found!r} in <origin>; expected metres, at most {FARTHEST:g}"
            )
        return rotation, translation

    def joints(self) -> list[Joint]:
        """The joint, or none for a fixed one."""
        if self.type == "fixed":
            return []
        axis = self._numbers("axis", "xyz", (1, 0, 0))
        length = float(np.linalg.norm(axis))
        if length == 0:
            raise self._error("has an axis of length zero")
        kinds = {"revolute": "hinge", "continuous": "hinge", "prismatic": "slide"}
        joint = Joint(self.name, kinds.get(self.type, self.type), axis / length)
        if self.element.find("limit") is not None:
            # many files have a zero here for what nobody knew; no motor has
            joint.effort = self._most("effort") or np.inf
            joint.velocity = self._most("velocity") or np.inf
            if self.type != "continuous":
                joint.lower = self._number("limit", "lower", 0.0)
                joint.upper = self._number("limit", "upper", 0.0)
                if joint.lower > joint.upper:
                    raise self._error(
                        f"has the lower limit {joint.lower:g} above the upper, {joint.upper:g}"
                    )
        return [joint]

    def mimics(self) -> dict[str, Mimic]:
        """The joint that this one follows, if any."""
        found = self.element.find("mimic")
        if found is None:
            return {}
        scale = self._number("mimic", "multiplier", 1.0)
        return {self.name: Mimic(found.get("joint"), scale, self._number("mimic", "offset", 0.0))}

    def _most(self, attribute: str) -> float:
        value = self._number("limit", attribute, np.inf)
        if value < 0:
            raise self._error(f"has {attribute}={value:g} in <limit>; expected 0 or more")
        return value

    def _number(self, tag: str, attribute: str, default: float) -> float:
        return float(self._numbers(tag, attribute, (default,))[0])

    def _numbers(self, tag: str, attribute: str, default: tuple[float, ...]) -> Floats:
        found = self.element.find(tag)
        text = None if found is None else found.get(attribute)
        if text is None:
            return np.array(default, float)
        try:
            values = np.array([float(word) for word in text.split()])
        except ValueError:
            values = np.array([np.nan])
        endless = tag == "limit"  # only there does inf mean something
        usable = not np.isnan(values).any() if endless else np.isfinite(values).all()
        if len(values) != len(default) or not usable:
            raise self._error(
                f"has {attribute}={text!r} in <{tag}>; expected {len(default)} "
                f"{'' if endless else 'finite '}number(s)"
            )
        return values

    def _error(self, what: str) -> HandModelError:
        return HandModelError(f"{self.path}: joint {self.name!r} {what}")
