"""The objects that a hand can be given: shapes made of MuJoCo geoms, by name.

Sizes are stated for a hand that suits objects 0.1 m wide and scale with ``size``. Every shape is
placed so that the body frame is at its centre of mass.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
from scipy.spatial import ConvexHull

from dexctl.exceptions import InvalidInput, SimulationError, UnknownName
from dexctl.sim.file_settings import TWISTING
from dexctl.state import Floats

MESH = "mesh"
OWN = "dexctl "
"""What begins the names that a scene adds to those of the hand's file."""
_GOLDEN_RATIO = (1 + 5**0.5) / 2


class Part(NamedTuple):
    """One geom of an object, in the object's frame.

    Attributes:
        kind: geom type.
        size: its size parameters (half lengths, radius) [m].
        position: its centre [m].
        volume: [m^3], for sharing the mass out.
        vertices: of a convex mesh ``(k, 3)`` [m], else None.
    """

    kind: mujoco.mjtGeom
    size: tuple[float, ...]
    position: tuple[float, float, float]
    volume: float
    vertices: Floats | None = None


def _box(x: float, y: float, z: float, position: tuple[float, float, float] = (0, 0, 0)) -> Part:
    """A box of full lengths x, y, z."""
    half = (x / 2, y / 2, z / 2)
    return Part(mujoco.mjtGeom.mjGEOM_BOX, half, position, x * y * z)


def _sphere(width: float) -> list[Part]:
    radius = width / 2
    volume = 4 / 3 * np.pi * radius**3
    return [Part(mujoco.mjtGeom.mjGEOM_SPHERE, (radius,), (0, 0, 0), volume)]


def _cylinder(width: float) -> list[Part]:
    radius, half = width / 2, width / 2
    volume = 2 * half * np.pi * radius**2
    return [Part(mujoco.mjtGeom.mjGEOM_CYLINDER, (radius, half), (0, 0, 0), volume)]


def _polyhedron(vertices: Floats, width: float) -> list[Part]:
    """The convex hull of ``vertices``, a face down, ``width`` between opposite faces."""
    hull = ConvexHull(vertices)
    down = hull.equations[0, :3]
    vertices = vertices @ _rotation_onto(down, np.array([0.0, 0.0, -1.0])).T
    vertices = vertices * (width / 2 / abs(hull.equations[0, 3]))
    volume = float(ConvexHull(vertices).volume)
    return [Part(mujoco.mjtGeom.mjGEOM_MESH, (), (0, 0, 0), volume, vertices)]


def _rotation_onto(a: Floats, b: Floats) -> Floats:
    """The shortest rotation that takes the unit vector a to b (not opposite to each other)."""
    if np.dot(a, b) < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    cross = np.cross(a, b)
    skew = np.array([[0, -cross[2], cross[1]], [cross[2], 0, -cross[0]], [-cross[1], cross[0], 0]])
    return np.eye(3) + skew + skew @ skew / (1 + np.dot(a, b))


def _icosahedron(width: float) -> list[Part]:
    corners = [
        np.roll((0.0, s, t * _GOLDEN_RATIO), shift)
        for shift in range(3)
        for s in (-1, 1)
        for t in (-1, 1)
    ]
    return _polyhedron(np.array(corners), width)


def _dodecahedron(width: float) -> list[Part]:
    corners = [np.array((x, y, z), float) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    corners += [
        np.roll((0.0, s / _GOLDEN_RATIO, t * _GOLDEN_RATIO), shift)
        for shift in range(3)
        for s in (-1, 1)
        for t in (-1, 1)
    ]
    return _polyhedron(np.array(corners), width)


def _l_shape(width: float) -> list[Part]:
    """Two arms of length ``width`` and thickness ``width / 2``, with a corner in common."""
    thick = width / 2
    arms = [
        _box(width, thick, width, (0.0, -thick / 2, 0.0)),
        _box(thick, thick, width, (-thick / 2, thick / 2, 0.0)),
    ]
    return _centred(arms)


def _u_shape(width: float) -> list[Part]:
    """A base and two walls, ``width`` outside, with a channel of a third of it along x."""
    third = width / 3
    parts = [
        _box(width, third, width, (0.0, -third, 0.0)),
        _box(third, 2 * third, width, (-third, third / 2, 0.0)),
        _box(third, 2 * third, width, (third, third / 2, 0.0)),
    ]
    return _centred(parts)


def _centred(parts: list[Part]) -> list[Part]:
    """The same parts about their common centre of mass."""
    volume = np.array([part.volume for part in parts])
    centre = volume @ np.array([part.position for part in parts]) / volume.sum()
    return [part._replace(position=tuple(np.subtract(part.position, centre))) for part in parts]


_SHAPES: dict[str, Callable[[float], list[Part]]] = {
    "cube": lambda width: [_box(width, width, width)],
    "sphere": _sphere,
    "cylinder": _cylinder,
    "icosahedron": _icosahedron,
    "dodecahedron": _dodecahedron,
    "cuboid_tall": lambda width: [_box(0.9 * width, 0.9 * width, 1.5 * width)],
    "cuboid_long": lambda width: [_box(1.2 * width, 0.8 * width, 0.8 * width)],
    "l_shape": _l_shape,
    "u_shape": _u_shape,
}


def object_names() -> tuple[str, ...]:
    """The names that `Scene.build` takes; "mesh" (a file of the user's) is one beside these."""
    return tuple(_SHAPES)


def add_object(
    spec: mujoco.MjSpec,
    body: mujoco.MjsBody,
    name: str,
    *,
    width: float,
    mass: float,
    friction: tuple[float, float, float],
    mesh: str | Path | None = None,
) -> None:
    """Add the geoms of the object ``name`` to ``body``.

    Args:
        spec: what the body belongs to.
        body: the object's body; its frame becomes the object's centre of mass.
        name: one of `object_names`, or "mesh" with ``mesh`` the file.
        width: width of the object [m]; for a mesh, its largest extent, or 0 to keep its size.
        mass: of the whole object [kg].
        friction: sliding, torsional [m] and rolling [m] coefficients.
        mesh: STL or OBJ file. MuJoCo collides with its convex hull: a concave object has to be
            decomposed into convex parts by its user.

    Raises:
        UnknownName: no such object.
        InvalidInput: a mesh file and a name that do not belong together.
        SimulationError: the mesh cannot be read.
    """
    if name != MESH and name not in _SHAPES:
        raise UnknownName("object", name, (*_SHAPES, MESH))
    if (name == MESH) != (mesh is not None):
        raise InvalidInput(
            f"object {name!r} with object_mesh={mesh!r}; a mesh file goes with object 'mesh' only"
        )
    common = {
        "condim": TWISTING,
        "friction": list(friction),
        "contype": 1,
        "conaffinity": 1,
        "rgba": [0.27, 0.56, 0.79, 1.0],
        "group": 0,
    }
    if mesh is not None:
        vertices, faces = _read_mesh(Path(mesh))
        if width:
            vertices = vertices * (width / np.ptp(vertices, axis=0).max())
        spec.add_mesh(name=OWN + "object", uservert=vertices.ravel(), userface=faces.ravel())
        geom = body.add_geom(
            name=OWN + "object",
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=OWN + "object",
            mass=mass,
            **common,
        )
        geom.pos = -_centre_of_mass(vertices, faces)
        return
    parts = _SHAPES[name](width)
    total = sum(part.volume for part in parts)
    for i, part in enumerate(parts):
        geom = body.add_geom(
            name=f"{OWN}object{i or ''}",
            type=part.kind,
            pos=list(part.position),
            mass=mass * part.volume / total,
            **common,
        )
        if part.vertices is not None:
            spec.add_mesh(name=OWN + "object", uservert=part.vertices.ravel())
            geom.meshname = OWN + "object"
        else:
            geom.size[: len(part.size)] = part.size


def _read_mesh(path: Path) -> tuple[Floats, np.ndarray]:
    """Vertices ``(k, 3)`` and triangles ``(f, 3)`` of a mesh file, in the file's frame."""
    path = path.expanduser()
    if not path.is_file():
        raise SimulationError(f"object_mesh {str(path)!r}: no such file")
    spec = mujoco.MjSpec()
    convex = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
    spec.add_mesh(name="object", file=str(path.resolve()), inertia=convex)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="object")
    try:
        model = spec.compile()
    except ValueError as error:
        why = " ".join(str(error).split())
        raise SimulationError(f"object_mesh {str(path)!r}: MuJoCo cannot read it: {why}") from None
    # the compiler moves the vertices into the mesh's inertial frame; take them back
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.mesh_quat[0])
    vertices = model.mesh_vert @ rotation.reshape(3, 3).T + model.mesh_pos[0]
    return vertices.astype(float), np.asarray(model.mesh_face, np.int32)


def _centre_of_mass(vertices: Floats, faces: np.ndarray) -> Floats:
    """Centre of mass of a mesh of uniform density, as MuJoCo computes it."""
    spec = mujoco.MjSpec()
    spec.add_mesh(name="object", uservert=vertices.ravel(), userface=faces.ravel())
    body = spec.worldbody.add_body()
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="object", mass=1.0)
    return spec.compile().body_ipos[1].copy()
