"""Parameters of each environment: what they do to the model, against a scene built with them."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from dexctl.exceptions import InvalidInput
from dexctl.rotations import rotate
from dexctl.sim import BatchSimulator, Scene
from dexctl.sim.parameters import ParameterSet

# of the whole scene, or of how it is drawn or hashed
_NOT_PHYSICS = {"stat", "signature", "mesh_normal", "mesh_scale", "mesh_pos", "mesh_quat"}
# in which order the faces of a hull are listed is up to the hull's algorithm
_FACES = {
    "bvh_aabb", "bvh_nodeid", "mesh_extrema", "mesh_face", "mesh_facenormal", "mesh_graph",
    "mesh_polymap", "mesh_polynormal", "mesh_polyvert",
}  # fmt: skip


def differing(a: mujoco.MjModel, b: mujoco.MjModel) -> list[str]:
    """Names of the arrays that two models have otherwise."""
    found = []
    for name in dir(a):
        one = getattr(a, name)
        if isinstance(one, np.ndarray) and name not in _NOT_PHYSICS:
            other = getattr(b, name)
            if one.shape != other.shape or not np.allclose(one, other, rtol=1e-5, atol=1e-7):
                found.append(name)
    return found


@pytest.mark.parametrize(
    "name", ["cube", "sphere", "cylinder", "icosahedron", "cuboid_tall", "l_shape", "u_shape"]
)
def test_a_scaled_object_is_the_object_of_that_size(name: str) -> None:
    scene = Scene.build("dex5", name)
    larger = Scene.build("dex5", name, object_size=1.1 * scene.object_width, object_mass=0.15)
    one = ParameterSet(scene, 2, scene.model.opt.timestep)
    one.set({"object_size": 1.1, "object_mass": 0.15}, np.array([False, True]))
    found = differing(one.models[1], larger.model)
    assert found == [] or (name == "icosahedron" and set(found) <= _FACES)
    assert differing(one.models[0], scene.model) == []
    assert "geom_rbound" in differing(one.models[1], scene.model)


@pytest.fixture(scope="module")
def cylinder() -> Scene:
    return Scene.build("dex5", "cylinder")


def test_the_centre_of_mass_moves_and_the_shape_stays(cylinder: Scene) -> None:
    centre = np.array([0.004, -0.003, 0.005])
    sim = BatchSimulator(cylinder, 2, disturbance=0.0, seed=0)
    sim.set_parameters(centre_of_mass=np.stack([np.zeros(3), centre]))
    sim.reset()
    state = sim.read()
    assert state.object_position is not None
    np.testing.assert_allclose(state.object_position[1], state.object_position[0], atol=1e-12)
    np.testing.assert_allclose(sim.qpos[1], sim.qpos[0], atol=1e-12)
    np.testing.assert_allclose(sim.start_position[1], sim.start_position[0], atol=1e-12)
    grasp = (state.q, state.q_target, state.object_position, state.object_quaternion)
    sim.set_grasp(*grasp)  # type: ignore[arg-type]
    touch = sim.read()
    np.testing.assert_allclose(touch.contact_position[1], touch.contact_position[0], atol=1e-6)
    sim.step()
    assert not np.allclose(sim.read().q[1], sim.read().q[0], atol=1e-9)  # it hangs otherwise


def test_a_free_object_turns_about_its_centre_of_mass(cylinder: Scene) -> None:
    centre = np.array([[0.01, 0.0, 0.005]])
    sim = BatchSimulator(cylinder, 1, seed=0)
    sim.set_parameters(centre_of_mass=centre, gravity=np.zeros((1, 3)))
    away = np.array([[1.0, 0.0, 1.0]])
    sim.place_object(away, [[1.0, 0.0, 0.0, 0.0]])
    placed = sim.read().object_position
    assert placed is not None
    np.testing.assert_allclose(placed, away)
    sim._physics[:, sim._layout.object_velocity] = [0, 0, 0, 3.0, 1.0, 2.0]
    start = away + centre
    for _ in range(5):
        sim.step()
    state = sim.read()
    assert state.object_position is not None
    assert state.object_quaternion is not None
    turned = rotate(state.object_quaternion, centre)
    assert np.abs(turned - centre).max() > 1e-3
    np.testing.assert_allclose(state.object_position + turned, start, atol=1e-9)


def test_gravity_of_each_environment(cylinder: Scene) -> None:
    sim = BatchSimulator(cylinder, 2, seed=0)
    fields = np.array([[0.0, 0.0, -9.81], [3.0, 0.0, 0.0]])
    sim.set_parameters(gravity=fields)
    sim.place_object(np.tile([0.0, 0.0, 2.0], (2, 1)), np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)))
    before = sim.read().object_position
    sim.step()
    fallen = sim.read().object_position - before  # type: ignore[operator]
    np.testing.assert_allclose(fallen, fields * 0.005**2 * 55, atol=1e-9)


def test_joints_each_with_their_own(cylinder: Scene) -> None:
    sim = BatchSimulator(cylinder, 3, seed=0)
    rng = np.random.default_rng(0)
    kp = cylinder.stiffness * rng.uniform(0.7, 1.3, (3, sim.hand.nq))
    dry, rotor = rng.uniform(0.0, 0.02, (2, 3, sim.hand.nq))
    sim.set_parameters(mask=[False, True, True], kp=kp, gear_friction=dry, armature=rotor)
    models = sim._parameters.models
    np.testing.assert_allclose(models[1].dof_armature[cylinder.qvel_columns], rotor[1])
    np.testing.assert_allclose(models[1].actuator_gainprm[cylinder.actuators, 0], kp[1])
    np.testing.assert_allclose(models[2].dof_frictionloss[cylinder.qvel_columns], dry[2])
    np.testing.assert_array_equal(models[0].actuator_gainprm, cylinder.model.actuator_gainprm)
    assert np.isnan(sim.parameters["kp"][0]).all()
    saved = sim.save()
    sim.set_parameters(kp=1.0, gear_friction=0.0, friction=0.3)
    sim.restore(saved)
    models = sim._parameters.models
    np.testing.assert_allclose(models[1].actuator_gainprm[cylinder.actuators, 0], kp[1])
    np.testing.assert_array_equal(models[0].geom_friction, cylinder.model.geom_friction)
    assert sim.parameters.keys() == {"kp", "gear_friction", "armature"}


def test_shapes_that_do_not_fit(cylinder: Scene) -> None:
    sim = BatchSimulator(cylinder, 4, seed=0)
    with pytest.raises(InvalidInput, match=r"gravity has shape \(3,\); expected \(4, 3\)"):
        sim.set_parameters(gravity=[0.0, 0.0, -9.81])
    with pytest.raises(InvalidInput, match=r"kp has shape \(4, 2\); expected \(\) or \(4,\) or"):
        sim.set_parameters(kp=np.ones((4, 2)))
    with pytest.raises(InvalidInput, match=r"object_size is 0.0; expected finite numbers > 0"):
        sim.set_parameters(object_size=0.0)
    with pytest.raises(InvalidInput, match=r"centre_of_mass is 'a'; expected numbers"):
        sim.set_parameters(centre_of_mass="a")
    with pytest.raises(InvalidInput, match=r"gravity is nan; expected finite numbers"):
        sim.set_parameters(gravity=np.full((4, 3), np.nan))
