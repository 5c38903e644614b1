"""Hand descriptions: reads MJCF and URDF into one tree of bodies and joints.

MuJoCo compiles the MJCF (defaults, includes, frames and welds are resolved there), and the tree is
taken from the compiled model, so that it is what the simulator moves.
"""

from __future__ import annotations

import importlib
import os
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType

import numpy as np

from dexctl.exceptions import HandModelError
from dexctl.state import Floats


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
        names = [item.name for body in self.bodies for item in body.joints]
        if found.master is not None and found.master not in names:
            raise HandModelError(
                f"{self.path}: joint {joint!r} follows {found.master!r}, which is not there; "
                f"joints: {', '.join(names)}"
            )
        return found


def read(path: Path) -> Description:
    """Read a URDF, which has <robot> as its root, or an MJCF file.

    Raises:
        HandModelError: it is neither, or not well made.
    """
    return read_urdf(path) if root_tag(path) == "robot" else read_mjcf(path)


def root_tag(path: Path) -> str:
    """The name of an XML file's root element.

    Raises:
        HandModelError: the file is not XML.
    """
    try:
        for _, element in ElementTree.iterparse(path, events=("start",)):
            return element.tag
    except (ElementTree.ParseError, LookupError, ValueError) as error:
        raise HandModelError(f"{path}: not well-formed XML: {error}") from None
    raise HandModelError(f"{path}: no element in it")


def load_mujoco() -> ModuleType:
    """MuJoCo, imported when it is first needed.

    Raises:
        HandModelError: it cannot be imported, as with a MUJOCO_GL that does not work here.
    """
    try:
        return importlib.import_module("mujoco")
    except (AttributeError, ImportError, OSError, RuntimeError) as error:
        asked = os.environ.get("MUJOCO_GL")
        hint = f" with MUJOCO_GL={asked}: unset it, or set it to egl" if asked else ""
        raise HandModelError(f"MuJoCo cannot be loaded{hint} ({error})") from None


def read_mjcf(path: Path) -> Description:
    """Read an MJCF file through MuJoCo's compiler."""
    mujoco = load_mujoco()
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise HandModelError(f"{path}: MuJoCo cannot compile it: {error}") from None
    kinds = {
        mujoco.mjtJoint.mjJNT_HINGE: "hinge",
        mujoco.mjtJoint.mjJNT_SLIDE: "slide",
        mujoco.mjtJoint.mjJNT_BALL: "ball",
        mujoco.mjtJoint.mjJNT_FREE: "free",
    }
    joints = []
    for j in range(model.njnt):
        info = model.joint(j)
        limited = bool(model.jnt_limited[j])
        effort = model.jnt_actfrcrange[j, 1] if model.jnt_actfrclimited[j] else np.inf
        joints.append(
            Joint(
                name=info.name or f"joint {j}",
                kind=kinds[mujoco.mjtJoint(model.jnt_type[j])],
                axis=model.jnt_axis[j].copy(),
                anchor=model.jnt_pos[j].copy(),
                reference=float(model.qpos0[model.jnt_qposadr[j]]),
                lower=float(model.jnt_range[j, 0]) if limited else -np.inf,
                upper=float(model.jnt_range[j, 1]) if limited else np.inf,
                effort=float(effort),
            )
        )
    for a in range(model.nu):
        on_joint = model.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_JOINT
        if on_joint and model.actuator_forcelimited[a]:
            joint = joints[model.actuator_trnid[a, 0]]
            gear = abs(float(model.actuator_gear[a, 0]))
            force = float(np.abs(model.actuator_forcerange[a]).max())
            joint.effort = min(joint.effort, gear * force)
    bodies = []
    for b in range(model.nbody):
        first, count = model.body_jntadr[b], model.body_jntnum[b]
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, model.body_quat[b])
        bodies.append(
            Body(
                name=model.body(b).name or f"body {b}",
                parent=int(model.body_parentid[b]) if b else -1,
                rotation=rotation.reshape(3, 3),
                translation=model.body_pos[b].copy(),
                joints=joints[first : first + count] if count else [],
            )
        )
    sites = {
        model.site(s).name: (int(model.site_bodyid[s]), model.site_pos[s].copy())
        for s in range(model.nsite)
        if model.site(s).name
    }
    return Description(path, bodies, sites, _mjcf_mimics(model, joints))


def _mjcf_mimics(model, joints: list[Joint]) -> dict[str, Mimic]:
    import mujoco

    mimics = {}
    for e in range(model.neq):
        if model.eq_type[e] != mujoco.mjtEq.mjEQ_JOINT or not model.eq_active0[e]:
            continue
        slave, master = joints[model.eq_obj1id[e]], model.eq_obj2id[e]
        constant, slope, *higher = (float(c) for c in model.eq_data[e, :5])
        # MuJoCo: slave - ref_slave = constant + slope (master - ref_master)
        offset = slave.reference + constant
        if master < 0:
            mimics[slave.name] = Mimic(None, 0.0, offset)
        else:
            offset -= slope * joints[master].reference
            mimics[slave.name] = Mimic(joints[master].name, slope, offset, not any(higher))
    return mimics


def read_urdf(path: Path) -> Description:
    """Read a URDF file: links, joints, limits and mimics; meshes and inertias are not looked at."""
    try:
        robot = ElementTree.parse(path).getroot()
    except ElementTree.ParseError as error:
        raise HandModelError(f"{path}: not well-formed XML: {error}") from None
    if robot.tag != "robot":
        raise HandModelError(f"{path}: the root element is <{robot.tag}>; a URDF has <robot>")
    links = [link.get("name", "") for link in robot.findall("link")]
    elements = robot.findall("joint")
    for kind, names in (("links", links), ("joints", [e.get("name", "") for e in elements])):
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise HandModelError(f"{path}: several {kind} are called {', '.join(map(repr, twice))}")
    incoming: dict[str, tuple[str, _UrdfJoint]] = {}
    for element in elements:
        joint = _UrdfJoint(path, element)
        parent, child = joint.link("parent", links), joint.link("child", links)
        if child in incoming:
            other = incoming[child][1].name
            raise HandModelError(
                f"{path}: the link {child!r} is the child of two joints, {other!r} and "
                f"{joint.name!r}"
            )
        incoming[child] = (parent, joint)

    bodies: list[Body] = []
    index: dict[str, int] = {}
    mimics: dict[str, Mimic] = {}
    pending = list(links)
    while pending:
        ready = [n for n in pending if n not in incoming or incoming[n][0] in index]
        if not ready:
            raise HandModelError(f"{path}: the links {', '.join(pending)} form a loop")
        for name in ready:
            index[name] = len(bodies)
            if name in incoming:
                parent, joint = incoming[name]
                rotation, translation = joint.origin()
                bodies.append(Body(name, index[parent], rotation, translation, joint.joints()))
                mimics.update(joint.mimics())
            else:
                bodies.append(Body(name, -1, np.eye(3), np.zeros(3)))
        pending = [n for n in pending if n not in index]
    return Description(path, bodies, {}, mimics)


class _UrdfJoint:
    """One <joint> of a URDF; every error names the file, the joint and the attribute."""

    def __init__(self, path: Path, element: ElementTree.Element) -> None:
        self.path = path
        self.element = element
        self.name = element.get("name", "")
        self.type = element.get("type", "")

    def link(self, tag: str, links: list[str]) -> str:
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
        roll, pitch, yaw = self._numbers("origin", "rpy", (0, 0, 0))
        (cr, cp, cy), (sr, sp, sy) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
        rotation = np.array(
            [
                [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
                [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
                [-sp, cp * sr, cp * cr],
            ]
        )
        return rotation, self._numbers("origin", "xyz", (0, 0, 0))

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
            joint.effort = self._number("limit", "effort", np.inf)
            joint.velocity = self._number("limit", "velocity", np.inf)
            if self.type != "continuous":
                joint.lower = self._number("limit", "lower", 0.0)
                joint.upper = self._number("limit", "upper", 0.0)
        return [joint]

    def mimics(self) -> dict[str, Mimic]:
        """The joint that this one follows, if any."""
        found = self.element.find("mimic")
        if found is None:
            return {}
        scale = self._number("mimic", "multiplier", 1.0)
        return {self.name: Mimic(found.get("joint"), scale, self._number("mimic", "offset", 0.0))}

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
        if len(values) != len(default) or np.isnan(values).any():
            raise self._error(
                f"has {attribute}={text!r} in <{tag}>; expected {len(default)} number(s)"
            )
        return values

    def _error(self, what: str) -> HandModelError:
        return HandModelError(f"{self.path}: joint {self.name!r} {what}")
