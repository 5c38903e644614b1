"""Hand descriptions: reads MJCF and URDF into one tree of bodies and joints.

MuJoCo compiles the MJCF (defaults, includes, frames and welds are resolved there), and the tree is
taken from the compiled model, so that it is what the simulator moves.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass, field
from pathlib import Path

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


@dataclass
class Description:
    """The bodies parents first, the sites as (body index, offset), and the coupled joints."""

    bodies: list[Body]
    sites: dict[str, tuple[int, Floats]]
    mimics: dict[str, Mimic]


def read_mjcf(path: Path) -> Description:
    """Read an MJCF file through MuJoCo's compiler."""
    import mujoco  # its own import cost is paid only where an MJCF is read

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
    return Description(bodies, sites, _mjcf_mimics(model, joints, path))


def _mjcf_mimics(model, joints: list[Joint], path: Path) -> dict[str, Mimic]:
    import mujoco

    mimics = {}
    for e in range(model.neq):
        if model.eq_type[e] != mujoco.mjtEq.mjEQ_JOINT or not model.eq_active0[e]:
            continue
        slave, master = joints[model.eq_obj1id[e]], model.eq_obj2id[e]
        constant, slope, *higher = model.eq_data[e, :5]
        if np.any(higher):
            raise HandModelError(
                f"{path}: joint {slave.name!r} follows another by a polynomial of degree 2 or "
                "more; only linear couplings are supported"
            )
        # MuJoCo: slave - ref_slave = constant + slope (master - ref_master)
        offset = slave.reference + constant
        if master < 0:
            mimics[slave.name] = Mimic(None, 0.0, float(offset))
        else:
            offset -= slope * joints[master].reference
            mimics[slave.name] = Mimic(joints[master].name, float(slope), float(offset))
    return mimics


def read_urdf(path: Path) -> Description:
    """Read a URDF file: links, joints, limits and mimics; meshes and inertias are not looked at."""
    try:
        robot = ElementTree.parse(path).getroot()
    except ElementTree.ParseError as error:
        raise HandModelError(f"{path}: not well-formed XML: {error}") from None
    if robot.tag != "robot":
        raise HandModelError(f"{path}: the root element is <{robot.tag}>; a URDF has <robot>")
    links = [link.get("name", "") for link in robot.iter("link")]
    incoming = {}
    for element in robot.findall("joint"):
        child, parent = element.find("child"), element.find("parent")
        if child is None or parent is None:
            raise HandModelError(f"{path}: joint {element.get('name')!r} lacks parent or child")
        for name in (child.get("link"), parent.get("link")):
            if name not in links:
                raise HandModelError(
                    f"{path}: joint {element.get('name')!r} names the link {name!r}, which is "
                    f"not there; links: {', '.join(links)}"
                )
        incoming[child.get("link")] = (parent.get("link"), element)

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
                parent, element = incoming[name]
                rotation, translation = _urdf_origin(element)
                joints = _urdf_joint(element, mimics)
                bodies.append(Body(name, index[parent], rotation, translation, joints))
            else:
                bodies.append(Body(name, -1, np.eye(3), np.zeros(3)))
        pending = [n for n in pending if n not in index]
    return Description(bodies, {}, mimics)


def _urdf_origin(element: ElementTree.Element) -> tuple[Floats, Floats]:
    origin = element.find("origin")
    attributes = {} if origin is None else origin.attrib
    roll, pitch, yaw = (float(x) for x in attributes.get("rpy", "0 0 0").split())
    (cr, cp, cy), (sr, sp, sy) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    rotation = np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
    return rotation, np.array([float(x) for x in attributes.get("xyz", "0 0 0").split()])


def _urdf_joint(element: ElementTree.Element, mimics: dict[str, Mimic]) -> list[Joint]:
    kind = element.get("type", "")
    if kind == "fixed":
        return []
    name = element.get("name", "")
    axis_element, limit, mimic = (element.find(tag) for tag in ("axis", "limit", "mimic"))
    axis = np.array([1.0, 0.0, 0.0])
    if axis_element is not None:
        axis = np.array([float(x) for x in axis_element.get("xyz", "1 0 0").split()])
    joint = Joint(
        name,
        {"revolute": "hinge", "continuous": "hinge", "prismatic": "slide"}.get(kind, kind),
        axis / (np.linalg.norm(axis) or 1.0),
    )
    if limit is not None:
        joint.effort = float(limit.get("effort", "inf"))
        joint.velocity = float(limit.get("velocity", "inf"))
        if kind != "continuous":
            joint.lower, joint.upper = float(limit.get("lower", 0)), float(limit.get("upper", 0))
    if mimic is not None:
        scale, offset = float(mimic.get("multiplier", 1)), float(mimic.get("offset", 0))
        mimics[name] = Mimic(mimic.get("joint"), scale, offset)
    return [joint]
