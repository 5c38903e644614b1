"""A URDF hand as a MuJoCo spec: the bodies and joints of its kinematics, the links' shapes.

MuJoCo's own reader of URDF leaves mimic joints and package paths alone and merges links that are
fixed to each other; here bodies and joints are those that `HandModel` has, so that simulated and
computed fingertips are at the same place.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from typing import NamedTuple

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from dexctl.description import Body
from dexctl.exceptions import SimulationError
from dexctl.hand import HandModel
from dexctl.sim.checks import listed
from dexctl.sim.inertia import LEAST_INERTIA, LEAST_MASS, mended_moments
from dexctl.sim.urdf_meshes import find_mesh
from dexctl.state import Floats

TIP_RADIUS = 0.008
"""Radius of the sphere that a fingertip without any collision geometry gets [m]."""
_DENSITY = 1000.0  # of links without a mass [kg/m^3]
_RANGE = 1e-6  # half the range of a joint whose limits are equal [rad], [m]
_VISUAL_GROUP = 2


class _Shape(NamedTuple):
    """A geometry element, in the frame of the link it is added to."""

    element: ElementTree.Element
    position: Floats
    rotation: Rotation
    weighs: bool = True  # not where another link has the mass already


def read_urdf(hand: HandModel, notes: list[str]) -> mujoco.MjSpec:
    """The spec of a hand's URDF, in the file's world frame, without actuators and couplings.

    Args:
        hand: joints that move none of its fingertips are left out: they stay at zero.
        notes: gets a line for everything that the file lacks or that was mended.

    Raises:
        SimulationError: a mesh that is not there or that MuJoCo cannot read, or an inertia that
            is none; the message says what to write.
    """
    return _Reader(hand, notes).spec


class _Reader:
    def __init__(self, hand: HandModel, notes: list[str]) -> None:
        self.hand, self.path, self.notes = hand, hand.path, notes
        self.bodies = hand.description.bodies
        root = ElementTree.parse(self.path).getroot()
        self.links = {link.get("name", ""): link for link in root.findall("link")}
        self.dynamics = {
            joint.get("name", ""): joint.find("dynamics") for joint in root.findall("joint")
        }
        self.used = {*hand.joint_names, *hand.couplings}
        self.spec = mujoco.MjSpec()
        self.spec.compiler.degree = False
        self.spec.modelname = root.get("name", "hand")
        self._mesh_of: dict[tuple[str, str], str | None] = {}
        self._unread: list[str] = []
        self._weightless: list[str] = []
        self._mended: list[str] = []
        collisions = self._collisions()
        made: list[mujoco.MjsBody] = []
        for i, body in enumerate(self.bodies):
            made.append(self._add_body(body, made, collisions[i]))
        self._report()

    def _report(self) -> None:
        if self._unread:
            self.notes.append(f"pictures lack what cannot be read: {listed(self._unread)}")
        if self._weightless:
            self.notes.append(
                f"no mass or inertia given: from the shape, {_DENSITY:g} kg/m^3: "
                f"{listed(self._weightless)}"
            )
        if self._mended:
            self.notes.append(f"principal moments with A + B < C mended: {listed(self._mended)}")

    def _add_body(
        self, body: Body, made: list[mujoco.MjsBody], collisions: list[_Shape]
    ) -> mujoco.MjsBody:
        link = self.links[body.name]
        if body.parent < 0 and body.name == "world":  # MuJoCo's world has that name
            item = self.spec.worldbody
        else:
            parent = self.spec.worldbody if body.parent < 0 else made[body.parent]
            item = parent.add_body(name=body.name, pos=body.translation)
            item.quat = Rotation.from_matrix(body.rotation).as_quat(scalar_first=True)
        moves = False
        for joint in body.joints:
            if joint.name not in self.used:
                continue
            moves = True
            hinge = joint.kind == "hinge"
            added = item.add_joint(
                name=joint.name,
                type=mujoco.mjtJoint.mjJNT_HINGE if hinge else mujoco.mjtJoint.mjJNT_SLIDE,
                axis=joint.axis,
            )
            if np.isfinite([joint.lower, joint.upper]).all():
                least = _RANGE if joint.lower == joint.upper else 0.0  # a joint that is held
                added.range, added.limited = [joint.lower - least, joint.upper + least], 1
            damping, friction = self._dynamics(joint.name)
            added.damping = [damping, 0.0, 0.0] if np.ndim(added.damping) else damping
            added.frictionloss = friction
        for shape in collisions:
            self._add_geom(item, shape, body.name, visual=False)
        for element in link.findall("visual"):
            shape = self._shape(element, Rotation.identity(), np.zeros(3))
            self._add_geom(item, shape, body.name, visual=True)
        if item.name != "world":
            self._add_inertia(item, link, moves, any(shape.weighs for shape in collisions))
        return item

    def _dynamics(self, joint: str) -> tuple[float, float]:
        found = self.dynamics.get(joint)
        values = [0.0, 0.0] if found is None else [
            float(found.get(name, 0.0)) for name in ("damping", "friction")
        ]  # fmt: skip
        return max(values[0], 0.0), max(values[1], 0.0)

    # ---- shapes

    def _collisions(self) -> list[list[_Shape]]:
        """The collision shapes of each body; a fingertip without gets those of its rigid group.

        A leaf of the tree is often a bare frame that is fixed to the last link; what the finger
        touches with is then that link's shape.
        """
        found = [
            [
                self._shape(element, Rotation.identity(), np.zeros(3))
                for element in self.links[body.name].findall("collision")
            ]
            for body in self.bodies
        ]
        index = {body.name: i for i, body in enumerate(self.bodies)}
        tips = [index[name] for name in self.hand.fingertip_bodies]
        for finger, tip in enumerate(tips):
            if found[tip]:
                continue
            root, group = self._rigid_group(tip)
            givers = [i for i in group if found[i] and i not in tips] if root else []
            rotation, origin = self._placement(tip, root)
            for i in givers:
                turned, at = self._placement(i, root)
                relative = rotation.inv() * turned
                shift = rotation.inv().apply(at - origin)
                found[tip] += [
                    _Shape(
                        s.element, relative.apply(s.position) + shift, relative * s.rotation, False
                    )
                    for s in found[i]
                ]
                found[i] = []
            name = self.bodies[tip].name
            if givers:
                named = ", ".join(self.bodies[i].name for i in givers)
                self.notes.append(
                    f"fingertip {name!r} has no shape: it touches with that of {named}"
                )
            else:
                ball = ElementTree.fromstring(
                    f"<collision><geometry><sphere radius='{TIP_RADIUS}'/></geometry></collision>"
                )
                offset = self.hand.fingertip_offsets[finger]
                found[tip].append(_Shape(ball, offset, Rotation.identity(), False))
                self.notes.append(
                    f"fingertip {name!r} has no collision geometry: it gets a sphere of "
                    f"{1000 * TIP_RADIUS:g} mm radius at the tip"
                )
        return found

    def _rigid_group(self, body: int) -> tuple[int, list[int]]:
        """The topmost of the bodies that are fixed to ``body``, and all of them."""
        root = body
        while not self._moved(root) and self.bodies[root].parent >= 0:
            root = self.bodies[root].parent
        group = [root]
        for i, item in enumerate(self.bodies):  # parents first
            if item.parent in group and not self._moved(i):
                group.append(i)
        return root, group

    def _moved(self, body: int) -> bool:
        return any(joint.name in self.used for joint in self.bodies[body].joints)

    def _placement(self, body: int, root: int) -> tuple[Rotation, Floats]:
        """Of ``body`` in ``root``, where no joint is between them."""
        rotation, translation = Rotation.identity(), np.zeros(3)
        while body != root:
            item = self.bodies[body]
            turn = Rotation.from_matrix(item.rotation)
            rotation, translation = turn * rotation, turn.apply(translation) + item.translation
            body = item.parent
        return rotation, translation

    def _shape(self, element: ElementTree.Element, rotation: Rotation, at: Floats) -> _Shape:
        turn, position = self._origin(element)
        return _Shape(element, rotation.apply(position) + at, rotation * turn)

    def _origin(self, element: ElementTree.Element) -> tuple[Rotation, Floats]:
        origin = element.find("origin")
        texts = ("0 0 0", "0 0 0") if origin is None else (
            origin.get("rpy", "0 0 0"), origin.get("xyz", "0 0 0")
        )  # fmt: skip
        rpy, xyz = (self._numbers(text, 3, "origin") for text in texts)
        return Rotation.from_euler("xyz", rpy), xyz

    def _numbers(self, text: str | None, count: int, where: str) -> Floats:
        try:
            values = np.array([float(word) for word in (text or "").split()])
        except ValueError:
            values = np.zeros(0)
        if len(values) != count or not np.isfinite(values).all():
            raise SimulationError(
                f"{self.path}: {text!r} in a <{where}>; expected {count} finite number(s)"
            )
        return values

    def _add_geom(self, item: mujoco.MjsBody, shape: _Shape, link: str, *, visual: bool) -> None:
        kinds = mujoco.mjtGeom
        geometry = shape.element.find("geometry")
        element = next(iter(geometry), None) if geometry is not None else None
        if element is None:
            return
        arguments: dict = {
            "pos": shape.position,
            "quat": shape.rotation.as_quat(scalar_first=True),
            "density": _DENSITY if shape.weighs else 0.0,
        }
        number = lambda name: float(self._numbers(element.get(name), 1, element.tag)[0])  # noqa: E731
        if element.tag == "box":
            half = self._numbers(element.get("size"), 3, "box") / 2
            arguments |= {"type": kinds.mjGEOM_BOX, "size": half}
        elif element.tag == "sphere":
            arguments |= {"type": kinds.mjGEOM_SPHERE, "size": [number("radius"), 0, 0]}
        elif element.tag in ("cylinder", "capsule"):
            kind = kinds.mjGEOM_CYLINDER if element.tag == "cylinder" else kinds.mjGEOM_CAPSULE
            size = [number("radius"), number("length") / 2, 0]
            arguments |= {"type": kind, "size": size}
        elif element.tag == "mesh":
            mesh = self._mesh(element, link, visual=visual)
            if mesh is None:
                return
            arguments |= {"type": kinds.mjGEOM_MESH, "meshname": mesh}
        else:
            raise SimulationError(
                f"{self.path}: link {link!r} has a <{element.tag}>; known shapes: box, sphere, "
                "cylinder, capsule, mesh"
            )
        if visual:
            arguments |= {"contype": 0, "conaffinity": 0, "density": 0, "group": _VISUAL_GROUP}
            colour = shape.element.find("material/color")
            if colour is not None and colour.get("rgba"):
                arguments["rgba"] = self._numbers(colour.get("rgba"), 4, "color")
        else:
            arguments["group"] = 3
        item.add_geom(**arguments)

    def _mesh(self, element: ElementTree.Element, link: str, *, visual: bool) -> str | None:
        """The name of a mesh in the spec; None for one that only pictures lack."""
        name, scale = element.get("filename", ""), element.get("scale", "1 1 1")
        key = (name, scale)
        if key in self._mesh_of and (self._mesh_of[key] is not None or visual):
            return self._mesh_of[key]
        file, why = find_mesh(self.path, name)
        factors = self._numbers(scale, 3, "mesh")
        if file is None:
            if visual:
                self._unread.append(name)
                self._mesh_of[key] = None
                return None
            raise SimulationError(f"{self.path}: link {link!r}: mesh {name!r}: {why}")
        own = f"mesh {len(self._mesh_of)}"
        self.spec.add_mesh(
            name=own,
            file=str(file),
            scale=factors,
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX,
        )
        self._mesh_of[key] = own
        return own

    # ---- inertias

    def _add_inertia(
        self, item: mujoco.MjsBody, link: ElementTree.Element, moves: bool, solid: bool
    ) -> None:
        element = link.find("inertial")
        mass, tensor = 0.0, np.zeros((3, 3))
        rotation, position = Rotation.identity(), np.zeros(3)
        if element is not None:
            rotation, position = self._origin(element)
            mass, tensor = self._mass(element), self._tensor(element)
        moments, axes = np.linalg.eigh(tensor)
        if mass > 0 and moments[-1] > 0:
            moments = self._mend(moments, item.name)
        elif solid:  # from the collision shapes
            if mass > 0:
                for geom in item.geoms:
                    if geom.contype:
                        geom.mass = mass / sum(bool(one.contype) for one in item.geoms)
            self._weightless.append(item.name)
            return
        elif mass > 0 or moves:
            mass = max(mass, LEAST_MASS)
            moments, axes = np.full(3, max(LEAST_INERTIA, mass * 1e-5)), np.eye(3)
            self._weightless.append(item.name)
        else:
            item.explicitinertial = True  # a frame, fixed to another link
            item.mass, item.inertia = 0.0, [0.0, 0.0, 0.0]
            return
        if np.linalg.det(axes) < 0:
            axes[:, 0] *= -1
        item.explicitinertial = True
        item.mass, item.ipos, item.inertia = mass, position, moments
        item.iquat = (rotation * Rotation.from_matrix(axes)).as_quat(scalar_first=True)

    def _mass(self, inertial: ElementTree.Element) -> float:
        element = inertial.find("mass")
        value = 0.0 if element is None else float(self._numbers(element.get("value"), 1, "mass")[0])
        return max(value, 0.0)

    def _tensor(self, inertial: ElementTree.Element) -> Floats:
        element = inertial.find("inertia")
        if element is None:
            return np.zeros((3, 3))
        xx, xy, xz, yy, yz, zz = (
            float(self._numbers(element.get(name, "0"), 1, "inertia")[0])
            for name in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        )
        return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])

    def _mend(self, moments: Floats, link: str) -> Floats:
        mended, short = mended_moments(moments)
        if mended is None:
            raise SimulationError(
                f"{self.path}: link {link!r} has the principal moments of inertia "
                f"{', '.join(f'{m:.3g}' for m in moments)} kg m^2; of no body the largest is more "
                "than the sum of the others: write those of its shape, or leave <inertia> out"
            )
        if short:
            self._mended.append(f"{link} (by {100 * short:.2g} % of C)")
        return mended
