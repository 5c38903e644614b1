"""Shapes of objects, against MuJoCo's own distances and rays."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from dexctl.sim.objects import add_object, object_names
from dexctl.sim.shapes import Shape

WIDTH = 0.1


def compiled(name: str, mesh: Path | None = None) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """An object at the origin and a probe: a ball of 1 um that is moved about."""
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(name="object")
    add_object(spec, body, name, width=WIDTH, mass=0.1, friction=(1, 0.005, 0.0001), mesh=mesh)
    probe = spec.worldbody.add_body(name="probe", mocap=True)
    probe.add_geom(name="probe", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[1e-6, 0, 0])
    model = spec.compile()
    return model, mujoco.MjData(model)


def parts_of(model: mujoco.MjModel) -> np.ndarray:
    return np.flatnonzero(model.geom_bodyid == model.body("object").id)


@pytest.mark.parametrize("name", object_names())
def test_distance_and_normal_are_mujocos(name: str) -> None:
    model, data = compiled(name)
    shape = Shape.of_body(model)
    points = np.random.default_rng(0).uniform(-0.12, 0.12, (150, 3))
    points[:80] *= 0.4
    found, normal, geom = shape.distance(points), shape.normal(points), model.geom("probe").id
    assert (found > 0).sum() > 40 and (found < 0).sum() > 10
    for point, distance, out in zip(points, found, normal, strict=True):
        data.mocap_pos[0] = point
        mujoco.mj_kinematics(model, data)
        fromto = np.zeros(6)
        each = [
            (mujoco.mj_geomDistance(model, data, int(g), geom, 1.0, fromto) + 1e-6, fromto.copy())
            for g in parts_of(model)
        ]
        theirs, ends = min(each, key=lambda one: one[0])
        if distance > 0:
            assert distance == pytest.approx(theirs, abs=2e-5)
            np.testing.assert_allclose(point - distance * out, ends[:3], atol=2e-4)
        assert (distance > 0) == (theirs > -1e-5) or abs(theirs) < 1e-4
        assert np.linalg.norm(out) == pytest.approx(1.0)
    nearest, _ = shape.nearest(points)
    np.testing.assert_allclose(shape.distance(nearest)[found > 0], 0.0, atol=1e-9)


def test_hand_computed_distances() -> None:
    cube, ball, tin = (Shape.of_body(compiled(name)[0]) for name in ("cube", "sphere", "cylinder"))
    points = np.array([[0.06, 0.0, 0.0], [0.08, 0.09, 0.05], [0.01, 0.0, 0.04]])
    np.testing.assert_allclose(cube.distance(points), [0.01, 0.05, -0.01], atol=1e-12)
    np.testing.assert_allclose(
        cube.normal(points), [[1, 0, 0], [0.6, 0.8, 0], [0, 0, 1]], atol=1e-9
    )
    np.testing.assert_allclose(ball.distance(points[:1]), [0.01])
    np.testing.assert_allclose(tin.distance(np.array([[0.08, 0.0, 0.09]])), [0.05])
    np.testing.assert_allclose(tin.normal(np.array([[0.08, 0.0, 0.09]])), [[0.6, 0, 0.8]])
    np.testing.assert_allclose(tin.distance(np.array([[0.0, 0.0, 0.02]])), [-0.03])
    np.testing.assert_allclose(cube.scaled(0.5).distance(points[:1]), [0.035])
    assert ball.radius == pytest.approx(0.05)
    assert cube.radius == pytest.approx(0.05 * 3**0.5)
    assert cube.distance(points.reshape(3, 1, 3)).shape == (3, 1)
    np.testing.assert_allclose(tin.bound(np.array([[0.08, 0.0, 0.09]])), [0.04])
    # the cheap bound: exact over faces and inside, less by an edge
    np.testing.assert_allclose(cube.bound(points), [0.01, 0.04, -0.01], atol=1e-12)


@pytest.mark.parametrize("name", object_names())
@pytest.mark.parametrize("inside", [False, True])
def test_rays_are_mujocos(name: str, inside: bool) -> None:
    model, data = compiled(name)
    mujoco.mj_kinematics(model, data)
    shape, rng = Shape.of_body(model), np.random.default_rng(1)
    along = rng.normal(size=(100, 3))
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    start = rng.uniform(-0.02, 0.02, (100, 3)) - (0.0 if inside else 0.3) * along
    distance, normals = shape.ray(start, along)
    for i in range(100):
        nearest, normal = np.inf, np.zeros(3)
        for geom in parts_of(model):
            out = np.zeros(3)
            if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
                t = mujoco.mj_rayMesh(model, data, int(geom), start[i], along[i], out)
            else:
                t = mujoco.mju_rayGeom(
                    data.geom_xpos[geom], data.geom_xmat[geom], model.geom_size[geom],
                    start[i], along[i], int(model.geom_type[geom]), out,
                )  # fmt: skip
            if 0 <= t < nearest:
                nearest, normal = t, out
        assert distance[i] == pytest.approx(nearest, abs=1e-6)
        if np.isfinite(nearest):
            sign = np.sign(normal @ normals[i])  # MuJoCo's looks back along the ray
            np.testing.assert_allclose(sign * normals[i], normal, atol=1e-5)
            if not inside:
                assert normals[i] @ along[i] < 0
        else:
            np.testing.assert_array_equal(normals[i], 0.0)


@pytest.mark.parametrize("name", object_names())
def test_samples_lie_on_the_surface(name: str) -> None:
    shape = Shape.of_body(compiled(name)[0])
    points, normals = shape.samples(400, seed=3)
    np.testing.assert_allclose(shape.distance(points), 0.0, atol=2e-6)
    assert (shape.distance(points + 1e-4 * normals) > 0).mean() > 0.98
    assert len(points) > 300
    assert (np.linalg.norm(points, axis=-1) <= shape.radius + 1e-9).all()


def test_which_objects_are_their_own_mirror_images() -> None:
    """In the xz planes of their bodies, hand-checked: L, U and the icosahedron lie otherwise."""
    found = {name for name in object_names() if Shape.of_body(compiled(name)[0]).is_mirrored}
    assert found == {*object_names()} - {"l_shape", "u_shape", "icosahedron"}


def test_rays_that_miss_and_run_along_faces() -> None:
    for name in ("cube", "sphere", "cylinder"):
        shape = Shape.of_body(compiled(name)[0])
        distance, normal = shape.ray(np.array([0.2, 0.0, 1.0]), np.array([0.0, 0.0, -1.0]))
        assert distance == np.inf
        np.testing.assert_array_equal(normal, 0.0)
        distance, normal = shape.ray(np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -2.0]))
        assert distance == pytest.approx(0.475)
        np.testing.assert_allclose(normal, [0, 0, 1], atol=1e-12)
