"""Shapes: distance, normal, nearest point, ray and surface samples of objects, many points at once.

A shape is a union of convex parts: boxes, spheres, cylinders and convex hulls, as MuJoCo collides
with them. Everything is in the object's frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Protocol

import mujoco
import numpy as np
from scipy.spatial import ConvexHull

from dexctl.exceptions import SimulationError
from dexctl.sim.objects import add_object
from dexctl.state import Floats

_BLOCK = 2_000_000  # pairs of point and triangle that are looked at together
_TINY = 1e-300


class _Part(Protocol):
    """A convex part about its own centre."""

    @property
    def extent(self) -> float:
        """How far it reaches from its centre [m]."""
        ...

    def closest(self, points: Floats) -> tuple[Floats, Floats]:
        """Signed distances ``(n,)`` and the outward normals where the surface is nearest."""
        ...

    def bound(self, points: Floats) -> Floats:
        """See `Shape.bound`."""
        ...

    def crossings(self, start: Floats, along: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Where lines enter and leave, in units of ``along``, and the outward normals there.

        Where a line misses, it leaves before it enters.
        """
        ...

    def sample(self, count: int, rng: np.random.Generator) -> tuple[Floats, float]:
        """Points of the surface ``(count, 3)``, uniform, and its area [m^2]."""
        ...

    def scaled(self, factor: float) -> _Part: ...


@dataclass(frozen=True)
class _Sphere:
    radius: float

    @property
    def extent(self) -> float:
        return self.radius

    def bound(self, points: Floats) -> Floats:
        return np.linalg.norm(points, axis=-1) - self.radius

    def closest(self, points: Floats) -> tuple[Floats, Floats]:
        return self.bound(points), _unit(points, np.array([0.0, 0.0, 1.0]))

    def crossings(self, start: Floats, along: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        enter, leave = _roots(start, along, self.radius)
        hits = (start + np.where(np.isfinite(t), t, 0.0)[:, None] * along for t in (enter, leave))
        first, last = (self.closest(hit)[1] for hit in hits)
        return enter, leave, first, last

    def sample(self, count: int, rng: np.random.Generator) -> tuple[Floats, float]:
        points = self.radius * self.closest(rng.normal(size=(count, 3)))[1]
        return points, 4 * np.pi * self.radius**2

    def scaled(self, factor: float) -> _Sphere:
        return _Sphere(self.radius * factor)


@dataclass(frozen=True)
class _Cylinder:
    """About z."""

    radius: float
    half: float

    @property
    def extent(self) -> float:
        return float(np.hypot(self.radius, self.half))

    def bound(self, points: Floats) -> Floats:
        return np.maximum(*self._sides(points))

    def closest(self, points: Floats) -> tuple[Floats, Floats]:
        side, end = self._sides(points)
        out = (side > 0) | (end > 0)
        weight_side = np.where(out, np.maximum(side, 0.0), side >= end)
        weight_end = np.where(out, np.maximum(end, 0.0), side < end)
        radial = _unit(points * [1.0, 1.0, 0.0], np.array([1.0, 0.0, 0.0]))
        axial = np.where(points[:, 2:] < 0, -1.0, 1.0) * [0.0, 0.0, 1.0]
        normal = _unit(weight_side[:, None] * radial + weight_end[:, None] * axial, radial)
        outside = np.hypot(np.maximum(side, 0.0), np.maximum(end, 0.0))
        return outside + np.minimum(np.maximum(side, end), 0.0), normal

    def _sides(self, points: Floats) -> tuple[Floats, Floats]:
        """How far outside of the mantle and of the nearer end."""
        across = np.hypot(points[..., 0], points[..., 1])
        return across - self.radius, np.abs(points[..., 2]) - self.half

    def crossings(self, start: Floats, along: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        around = _roots(start[:, :2], along[:, :2], self.radius)
        ends = _half_spaces(start, along, _AXIAL, np.array([-self.half, -self.half]))
        enter, leave = np.maximum(around[0], ends[0]), np.minimum(around[1], ends[1])
        normals = []
        for t, own, cap in ((enter, around[0], ends[2]), (leave, around[1], ends[3])):
            hit = start + np.where(np.isfinite(t), t, 0.0)[:, None] * along
            radial = _unit(hit * [1.0, 1.0, 0.0], np.array([1.0, 0.0, 0.0]))
            normals.append(np.where((t == own)[:, None], radial, cap))
        return enter, leave, normals[0], normals[1]

    def sample(self, count: int, rng: np.random.Generator) -> tuple[Floats, float]:
        side, cap = 4 * np.pi * self.radius * self.half, np.pi * self.radius**2
        which = rng.choice(3, count, p=np.array([side, cap, cap]) / (side + 2 * cap))
        angle = rng.uniform(0, 2 * np.pi, count)
        radius = np.where(which == 0, 1.0, np.sqrt(rng.uniform(size=count))) * self.radius
        height = np.select([which == 1, which == 2], [-self.half, self.half], 0.0)
        height = np.where(which == 0, rng.uniform(-self.half, self.half, count), height)
        points = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=-1)
        return points, side + 2 * cap

    def scaled(self, factor: float) -> _Cylinder:
        return _Cylinder(self.radius * factor, self.half * factor)


@dataclass(frozen=True)
class _Hull:
    """The convex hull of vertices ``(k, 3)``; a box is one of eight."""

    vertices: Floats

    @cached_property
    def _faces(self) -> tuple[Floats, Floats, Floats]:
        """Planes ``(f, 3)`` and ``(f,)``, n x + b <= 0 inside, and triangles ``(t, 3, 3)``."""
        hull = ConvexHull(self.vertices)
        planes = np.unique(hull.equations.round(12), axis=0)
        return planes[:, :3], planes[:, 3], self.vertices[hull.simplices]

    @property
    def extent(self) -> float:
        return float(np.linalg.norm(self.vertices, axis=-1).max())

    def bound(self, points: Floats) -> Floats:
        """The distance to the furthest plane: exact inside and over faces, else less."""
        normals, offsets, _ = self._faces
        # planes first: the maximum over few columns would take ten times as long
        height = normals @ points.reshape(-1, 3).T + offsets[:, None]
        return height.max(axis=0).reshape(points.shape[:-1])

    def closest(self, points: Floats) -> tuple[Floats, Floats]:
        normals, offsets, _ = self._faces
        height = normals @ points.T + offsets[:, None]
        first = height.argmax(axis=0)
        distance, normal = height[first, np.arange(len(points))], normals[first]
        out = np.flatnonzero(distance > 1e-9)
        # over a face it is that face's plane; over edges and corners all triangles are looked at
        foot = points[out] - distance[out, None] * normal[out]
        out = out[(normals @ foot.T + offsets[:, None]).max(axis=0) > 1e-12]
        away = points[out] - self._nearest(points[out])
        distance[out] = np.linalg.norm(away, axis=-1)
        normal[out] = _unit(away, normal[out])
        return distance, normal

    def _nearest(self, points: Floats) -> Floats:
        """The nearest points of the surface to points outside."""
        triangles = self._faces[2]
        found = np.empty_like(points)
        size = max(1, _BLOCK // len(triangles))
        for i in range(0, len(points), size):
            near = _nearest_on_triangles(points[i : i + size], triangles)
            away = ((near - points[i : i + size, None]) ** 2).sum(-1)
            found[i : i + size] = near[np.arange(len(near)), away.argmin(axis=-1)]
        return found

    def crossings(self, start: Floats, along: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        return _half_spaces(start, along, *self._faces[:2])

    def sample(self, count: int, rng: np.random.Generator) -> tuple[Floats, float]:
        a, b, c = np.swapaxes(self._faces[2], 0, 1)
        areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=-1)
        which = rng.choice(len(areas), count, p=areas / areas.sum())
        u, v = rng.uniform(size=(2, count, 1))
        root = np.sqrt(u)
        return (1 - root) * a[which] + root * ((1 - v) * b[which] + v * c[which]), areas.sum()

    def scaled(self, factor: float) -> _Hull:
        return _Hull(self.vertices * factor)


@dataclass(frozen=True)
class _Box(_Hull):
    """A hull that is a box along the axes: its distance and normal in closed form."""

    @cached_property
    def _half(self) -> Floats:
        return self.vertices.max(axis=0)

    def bound(self, points: Floats) -> Floats:
        beyond = np.abs(points) - self._half
        return np.maximum(np.maximum(beyond[..., 0], beyond[..., 1]), beyond[..., 2])

    def closest(self, points: Floats) -> tuple[Floats, Floats]:
        beyond = np.abs(points) - self._half
        side = np.where(points < 0, -1.0, 1.0)
        facing = side * (np.arange(3) == beyond.argmax(axis=-1)[:, None])
        outside = np.maximum(beyond, 0.0)
        away = np.sqrt((outside * outside).sum(-1))
        inside = np.minimum(self.bound(points), 0.0)
        return away + inside, _unit(side * outside, facing)

    def scaled(self, factor: float) -> _Box:
        return _Box(self.vertices * factor)


_SAMPLES = 200  # points that tell whether two shapes are the same, ...
_SAME = 1e-3  # ... when they are so near to its surface, as a share of its radius


@dataclass(frozen=True)
class Shape:
    """What an object is made of: convex parts, each with its centre in the object's frame."""

    parts: tuple[tuple[_Part, Floats], ...]

    @classmethod
    def of_body(cls, model: mujoco.MjModel, body: str = "object") -> Shape:
        """The shape of a compiled body's collision geoms, in the body's frame.

        Raises:
            SimulationError: a geom of a kind that objects are not made of.
        """
        own = model.geom_bodyid == model.body(body).id
        solid = (model.geom_contype | model.geom_conaffinity) != 0
        return cls(tuple(_part(model, int(geom)) for geom in np.flatnonzero(own & solid)))

    @classmethod
    def of_object(cls, name: str, width: float, *, mesh: str | Path | None = None) -> Shape:
        """The shape of an object by name, about its centre of mass.

        Args:
            name: one of `object_names`, or "mesh" with ``mesh`` the file.
            width: see `Scene.build`'s ``object_size``; of a mesh the largest extent, or 0 to keep
                its size [m].
            mesh: STL or OBJ file.

        Raises:
            UnknownName, InvalidInput, SimulationError: see `add_object`.
        """
        spec = mujoco.MjSpec()
        body = spec.worldbody.add_body(name="object")
        friction = (1.0, 0.005, 0.0001)
        add_object(spec, body, name, width=width, mass=1.0, friction=friction, mesh=mesh)
        return cls.of_body(spec.compile())

    def scaled(self, factor: float) -> Shape:
        """The same shape, ``factor`` times as large."""
        return Shape(tuple((part.scaled(factor), centre * factor) for part, centre in self.parts))

    @cached_property
    def radius(self) -> float:
        """Of a ball about the origin that holds it [m]."""
        return max(float(np.linalg.norm(centre)) + part.extent for part, centre in self.parts)

    @cached_property
    def is_mirrored(self) -> bool:
        """Whether it is its own mirror image in its xz plane."""
        points = self.samples(_SAMPLES)[0] * np.array([1.0, -1.0, 1.0])
        return bool(np.abs(self.distance(points)).max() < _SAME * self.radius)

    def distance(self, points: Floats) -> Floats:
        """Signed distances ``(...)`` of points ``(..., 3)`` [m], negative inside.

        Exact outside; inside of several parts at once, that to the nearest surface of one.
        """
        return self.closest(points)[0]

    def bound(self, points: Floats) -> Floats:
        """As `distance`, but cheap: less than it outside of edges and corners."""
        flat = np.asarray(points, float).reshape(-1, 3)
        each = [part.bound(flat - centre) for part, centre in self.parts]
        return np.min(each, axis=0).reshape(np.shape(points)[:-1])

    def normal(self, points: Floats) -> Floats:
        """Outward unit normals ``(..., 3)`` where the surface is nearest to each point."""
        return self.closest(points)[1]

    def nearest(self, points: Floats) -> tuple[Floats, Floats]:
        """The nearest points of the surface and the outward normals there, ``(..., 3)`` each."""
        distance, normal = self.closest(points)
        return points - distance[..., None] * normal, normal

    def closest(self, points: Floats) -> tuple[Floats, Floats]:
        """`distance` and `normal` at once."""
        flat = np.asarray(points, float).reshape(-1, 3)
        distance, normal = np.full(len(flat), np.inf), np.zeros_like(flat)
        for part, centre in self.parts:
            away, out = part.closest(flat - centre)
            normal = np.where((away < distance)[:, None], out, normal)
            distance = np.minimum(distance, away)
        return distance.reshape(np.shape(points)[:-1]), normal.reshape(np.shape(points))

    def ray(self, start: Floats, along: Floats) -> tuple[Floats, Floats]:
        """The first surface that rays ``(..., 3)`` cross, from outside or from inside.

        Returns:
            Distances ``(...)`` in lengths of ``along``, infinite where there is none, and the
            outward unit normals there ``(..., 3)``, zero where there is none.
        """
        start, along = np.broadcast_arrays(np.asarray(start, float), np.asarray(along, float))
        origin, direction = start.reshape(-1, 3), along.reshape(-1, 3)
        best, normal = np.full(len(origin), np.inf), np.zeros_like(origin)
        for part, centre in self.parts:
            enter, leave, first, last = part.crossings(origin - centre, direction)
            hit = (enter <= leave) & (leave >= 0)
            distance = np.where(hit, np.where(enter >= 0, enter, leave), np.inf)
            closer = distance < best
            best = np.where(closer, distance, best)
            there = np.where((enter >= 0)[:, None], first, last)
            normal = np.where(closer[:, None], there, normal)
        return best.reshape(start.shape[:-1]), normal.reshape(start.shape)

    def samples(self, count: int, seed: int = 0) -> tuple[Floats, Floats]:
        """About ``count`` points of the surface, uniform, and their normals, ``(k, 3)`` each.

        Those that lie inside of another part are left out, so k may be less.
        """
        rng = np.random.default_rng(seed)
        areas = np.array([part.sample(1, rng)[1] for part, _ in self.parts])
        points, normals = [], []
        for (part, centre), share in zip(self.parts, areas / areas.sum(), strict=True):
            found = part.sample(max(1, round(count * share)), rng)[0]
            points.append(found + centre)
            normals.append(part.closest(found)[1])
        point, normal = np.concatenate(points), np.concatenate(normals)
        free = self.bound(point + 1e-5 * normal) > 0  # not where two parts meet
        return point[free], normal[free]


_AXIAL = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])


def _part(model: mujoco.MjModel, geom: int) -> tuple[_Part, Floats]:
    kind, size = int(model.geom_type[geom]), model.geom_size[geom]
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    rotation, centre = rotation.reshape(3, 3), model.geom_pos[geom].copy()
    kinds = mujoco.mjtGeom
    if kind == kinds.mjGEOM_SPHERE:
        return _Sphere(float(size[0])), centre
    if kind == kinds.mjGEOM_CYLINDER and np.allclose(rotation, np.eye(3)):
        return _Cylinder(float(size[0]), float(size[1])), centre
    if kind == kinds.mjGEOM_BOX:
        corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        upright = np.allclose(rotation, np.eye(3))
        return (_Box if upright else _Hull)((corners * size) @ rotation.T), centre
    if kind == kinds.mjGEOM_MESH:
        mesh = int(model.geom_dataid[geom])
        first = int(model.mesh_vertadr[mesh])
        vertices = model.mesh_vert[first : first + int(model.mesh_vertnum[mesh])].astype(float)
        corners = vertices[ConvexHull(vertices).vertices]
        return _Hull(corners @ rotation.T), centre
    raise SimulationError(
        f"geom {model.geom(geom).name!r} is a {kinds(kind).name}; shapes are made of boxes, "
        "spheres, upright cylinders and convex meshes"
    )


def _unit(vectors: Floats, otherwise: Floats) -> Floats:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(length > 1e-12, vectors / np.maximum(length, _TINY), otherwise)


def _roots(start: Floats, along: Floats, radius: float) -> tuple[Floats, Floats]:
    """Where lines enter and leave a ball, or a circle."""
    a, b = (along**2).sum(-1), (start * along).sum(-1)
    c = (start**2).sum(-1) - radius**2
    inside = b**2 - a * c
    root = np.sqrt(np.maximum(inside, 0.0))
    moves = a > 1e-24
    safe = np.where(moves, a, 1.0)
    # a line that does not move in the plane of the circle is always in it, or never
    enter = np.where(moves, (-b - root) / safe, np.where(c <= 0, -np.inf, np.inf))
    leave = np.where(moves, (-b + root) / safe, np.where(c <= 0, np.inf, -np.inf))
    missed = moves & (inside < 0)
    return np.where(missed, np.inf, enter), np.where(missed, -np.inf, leave)


def _half_spaces(
    start: Floats, along: Floats, normals: Floats, offsets: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """Where lines enter and leave an intersection of half-spaces n x + b <= 0."""
    height, climb = start @ normals.T + offsets, along @ normals.T
    parallel = np.abs(climb) < 1e-15
    t = -height / np.where(parallel, 1.0, climb)
    outside = np.where(parallel & (height > 0), np.inf, -np.inf)
    into = np.where(~parallel & (climb < 0), t, outside)
    out = np.where(~parallel & (climb > 0), t, np.inf)
    first, last = into.argmax(axis=-1), out.argmin(axis=-1)
    return into.max(axis=-1), out.min(axis=-1), normals[first], normals[last]


def _nearest_on_triangles(points: Floats, triangles: Floats) -> Floats:
    """The nearest point of each triangle ``(t, 3, 3)`` to each point, ``(n, t, 3)``.

    The projection on the plane where it falls inside, else the nearest of the three edges.
    """
    a, b, c = np.swapaxes(triangles, 0, 1)
    edges = ((a, b), (b, c), (c, a))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), _TINY)
    foot = points[:, None] - ((points[:, None] - a) * normal).sum(-1)[..., None] * normal
    inside = np.ones(foot.shape[:-1], bool)
    for start, end in edges:
        inside &= ((foot - start) * np.cross(normal, end - start)).sum(-1) >= 0
    best, found = np.where(inside, 0.0, np.inf), foot
    for start, end in edges:
        edge = end - start
        share = ((points[:, None] - start) * edge).sum(-1) / np.maximum((edge**2).sum(-1), _TINY)
        near = start + np.clip(share, 0.0, 1.0)[..., None] * edge
        away = ((near - points[:, None]) ** 2).sum(-1)
        found = np.where((away < best)[..., None], near, found)
        best = np.minimum(away, best)
    return found
