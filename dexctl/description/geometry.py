"""Where the links of a hand are: points of their collision geometry, for proposals.

Links without any, and nothing beyond them has any either, have those of their visual geometry: the
ends of fingers, or all of a file that is drawn only.
"""

from __future__ import annotations

import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterable
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dexctl.description.mjcf import compile_mjcf, load_mujoco
from dexctl.description.placement import segments
from dexctl.description.tree import Description
from dexctl.description.urdf import numbers, rotation_of
from dexctl.description.xml_text import parse_xml, root_tag
from dexctl.state import Floats

READABLE = (".stl", ".obj")
_DIRECTIONS = np.array([d for d in product(np.linspace(-1, 1, 7), repeat=3) if max(np.abs(d)) == 1])
_DIRECTIONS /= np.linalg.norm(_DIRECTIONS, axis=1, keepdims=True)  # (218, 3)


class BodyPoints(NamedTuple):
    """Where the links are.

    Attributes:
        points: outermost ones of each body's geometry, in the body's frame, ``(k, 3)`` each [m].
        drawn: numbers of the bodies whose points are of their visual geometry.
    """

    points: list[Floats]
    drawn: frozenset[int]


def body_points(description: Description) -> BodyPoints:
    """See `BodyPoints`."""
    of = _urdf_points if root_tag(description.path) == "robot" else _mjcf_points
    points, parts = of(description, True), segments(description)
    solid = [any(len(points[body]) for body in part.bodies) for part in parts]
    for s in range(len(parts) - 1, 0, -1):
        solid[parts[s].parent] |= solid[s]
    bare = [b for part, on in zip(parts, solid, strict=True) if not on for b in part.bodies]
    if bare:
        seen = of(description, False)
        for body in bare:
            points[body] = seen[body]
    return BodyPoints(points, frozenset(body for body in bare if len(points[body])))


def _outermost(points: Floats) -> Floats:
    """Those that are farthest in some direction."""
    if len(points) <= len(_DIRECTIONS):
        return points
    return points[np.unique(np.argmax(_DIRECTIONS @ points.T, axis=1))]


def _box(half: Floats) -> Floats:
    return np.array(list(product((-1.0, 1.0), repeat=3))) * half


def _ball(radii: Floats) -> Floats:
    # the point with the normal n of an ellipsoid of radii r is r^2 n / |r n|
    return _DIRECTIONS * radii**2 / np.linalg.norm(_DIRECTIONS * radii, axis=1, keepdims=True)


def _capsule(radius: float, half: float) -> Floats:
    return _DIRECTIONS * radius + np.sign(_DIRECTIONS[:, 2:]) * [0.0, 0.0, half]


def _cylinder(radius: float, half: float) -> Floats:
    turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ring = np.stack([radius * np.cos(turn), radius * np.sin(turn), np.full(24, half)], axis=1)
    return np.concatenate([ring, ring * [1, 1, -1]])


def _mjcf_points(description: Description, solid: bool) -> list[Floats]:
    mujoco, model = load_mujoco(), compile_mjcf(description.path)
    kinds = mujoco.mjtGeom
    shapes: dict[int, Callable[[Floats], Floats]] = {
        int(kinds.mjGEOM_BOX): _box,
        int(kinds.mjGEOM_SPHERE): lambda size: _ball(np.full(3, size[0])),
        int(kinds.mjGEOM_ELLIPSOID): _ball,
        int(kinds.mjGEOM_CAPSULE): lambda size: _capsule(size[0], size[1]),
        int(kinds.mjGEOM_CYLINDER): lambda size: _cylinder(size[0], size[1]),
    }
    found: list[list[Floats]] = [[] for _ in description.bodies]
    for g in range(model.ngeom):
        if solid and not (model.geom_contype[g] or model.geom_conaffinity[g]):
            continue
        if model.geom_type[g] == kinds.mjGEOM_MESH:
            mesh = int(model.geom_dataid[g])
            first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
            points = _outermost(model.mesh_vert[first : first + count].astype(float))
        elif int(model.geom_type[g]) in shapes:
            points = shapes[int(model.geom_type[g])](model.geom_size[g])
        else:
            continue  # a plane, a height field
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, model.geom_quat[g])
        placed = points @ rotation.reshape(3, 3).T + model.geom_pos[g]
        found[int(model.geom_bodyid[g])].append(placed)
    return [np.concatenate(one) if one else np.zeros((0, 3)) for one in found]


def _urdf_points(description: Description, solid: bool) -> list[Floats]:
    path = description.path
    links = {link.get("name", ""): link for link in parse_xml(path).findall("link")}
    found = []
    for body in description.bodies:
        parts = [np.zeros((0, 3))]
        for element in links[body.name].findall("collision" if solid else "visual"):
            points = _urdf_shape(path, element.find("geometry"))
            origin = element.find("origin")
            rpy, xyz = (
                numbers(None if origin is None else origin.get(name), 3) for name in ("rpy", "xyz")
            )
            parts.append(points @ rotation_of(rpy).T + xyz)
        found.append(np.concatenate(parts))
    return found


def _urdf_shape(path: Path, geometry: ElementTree.Element | None) -> Floats:
    shape = None if geometry is None else next(iter(geometry), None)
    if shape is None:
        return np.zeros((0, 3))
    if shape.tag == "box":
        return _box(numbers(shape.get("size"), 3) / 2)
    if shape.tag == "sphere":
        return _ball(np.full(3, numbers(shape.get("radius"), 1)[0]))
    if shape.tag in ("cylinder", "capsule"):
        radius, length = (float(numbers(shape.get(name), 1)[0]) for name in ("radius", "length"))
        return (_capsule if shape.tag == "capsule" else _cylinder)(radius, length / 2)
    file = find_mesh(path, shape.get("filename", "")) if shape.tag == "mesh" else None
    if file is None:
        return np.zeros((0, 3))
    scale = numbers(shape.get("scale") or "1 1 1", 3)
    return _outermost(vertices(file)) * scale


def mesh_places(urdf: Path, name: str) -> list[Path]:
    """Where the file of a mesh may be, the likeliest place first.

    ``package://NAME/REST`` is looked for as ``NAME/REST`` and ``REST`` in the folders above the
    URDF and in those of ROS_PACKAGE_PATH.
    """
    folder = urdf.absolute().parent
    scheme, _, rest = name.rpartition("://")
    if scheme not in ("package", "model"):
        return [folder / rest]
    package, _, inside = rest.partition("/")
    above = (folder, *folder.parents)
    roots = os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep)
    return [
        *(parent / rest for parent in above),
        *(parent / inside for parent in above if parent.name == package),
        *(Path(root) / rest for root in roots if root),
        *(parent / inside for parent in above[:3]),
    ]


def find_mesh(urdf: Path, name: str) -> Path | None:
    """The file of a mesh that can be read here, or None.

    A mesh of another format is replaced by an STL or OBJ of the same name beside it.
    """
    places = mesh_places(urdf, name)
    for place in places:
        for suffix in (place.suffix, *READABLE):
            found = place.with_suffix(suffix)
            if suffix.lower() in READABLE and found.is_file():
                return found
    return None


def missing_meshes(urdf: Path, link: str, kinds: Iterable[str]) -> tuple[str, ...]:
    """Meshes of a URDF's link that are not there, or cannot be read here; as it names them.

    Args:
        urdf: the file.
        link: name of the link.
        kinds: of its elements: ``collision``, ``visual``.
    """
    named = [
        mesh.get("filename", "")
        for element in parse_xml(urdf).findall("link")
        if element.get("name") == link
        for kind in kinds
        for part in element.findall(kind)
        for mesh in part.iter("mesh")
    ]
    return tuple(name for name in dict.fromkeys(named) if find_mesh(urdf, name) is None)


def vertices(file: Path) -> Floats:
    """The vertices ``(k, 3)`` of an STL or OBJ file, none where it is neither."""
    content = file.read_bytes()
    if file.suffix.lower() == ".obj":
        rows = [line.split()[1:4] for line in content.splitlines() if line.startswith(b"v ")]
        return np.array(rows, float).reshape(-1, 3)
    count = int.from_bytes(content[80:84], "little")
    if len(content) == 84 + 50 * count:  # binary: normal, three corners, attribute
        facets = np.frombuffer(content, np.dtype([("f", "<f4", 12), ("a", "<u2")]), count, 84)
        return facets["f"][:, 3:].reshape(-1, 3).astype(float)
    rows = [line.split()[1:4] for line in content.splitlines() if b"vertex" in line]
    return np.array(rows, float).reshape(-1, 3)
