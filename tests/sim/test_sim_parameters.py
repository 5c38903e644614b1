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


def met(model: mujoco.MjModel, scene: Scene, geom: int) -> float:
    """Sliding friction by which MuJoCo's own contact of this geom with the object goes."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    centre = data.geom_xpos[geom]
    qpos = model.qpos0.copy()
    qpos[scene.object_qpos][:3] = centre  # one in the other: they are in contact
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    own = {int(one) for one in np.flatnonzero(model.geom_bodyid == model.body("object").id)}
    found = {
        float(one.friction[0])
        for one in data.contact
        if geom in one.geom and own & {int(i) for i in one.geom}
    }
    (only,) = found
    return only


def test_friction_of_tips_and_links_by_mujocos_own_contacts(cylinder: Scene) -> None:
    """Object 0.8; fingertips as shares of that; links, 1 in the file, as shares of the larger."""
    shares = np.array([0.5, 0.75, 1.0, 1.25, 1.5])
    one = ParameterSet(cylinder, 3, cylinder.model.opt.timestep)
    one.set({"friction": 0.8})
    one.set({"tip_friction": np.tile(shares, (3, 1))}, np.array([True, True, False]))
    one.set({"link_friction": 0.6}, np.array([False, True, True]))
    model = cylinder.model
    tips = [model.body(name).id for name in cylinder.hand.fingertip_bodies]
    own = model.geom_bodyid == model.body("object").id
    links = np.flatnonzero(~own & ~np.isin(model.geom_bodyid, tips))
    assert len(links) > 5
    for model, tip, link in zip(
        one.models, (0.8 * shares, 0.8 * shares, np.full(5, 0.8)), (1.0, 0.6, 0.6), strict=True
    ):
        for body, expected in zip(tips, tip, strict=True):
            for geom in np.flatnonzero(model.geom_bodyid == body):
                assert met(model, cylinder, int(geom)) == pytest.approx(expected)
        for geom in links:
            assert met(model, cylinder, int(geom)) == pytest.approx(link)
        assert cylinder.friction(model) == pytest.approx(tip.min())


def test_shares_of_one_change_nothing_and_go_with_a_restore() -> None:
    slippery = Scene.build("dex5", "cylinder", friction=0.7)
    one = ParameterSet(slippery, 2, slippery.model.opt.timestep)
    one.set({"tip_friction": 1.0, "link_friction": 1.0})
    assert all(differing(model, slippery.model) == [] for model in one.models)
    one.set({"tip_friction": 0.5}, np.array([False, True]))
    assert differing(one.models[1], slippery.model) == ["geom_friction"]
    one.restore({})
    assert differing(one.models[1], slippery.model) == []


def test_friction_of_tips_and_links_whatever_their_priority(cylinder: Scene) -> None:
    """Of a geom of higher priority MuJoCo takes its own, of a lower one the object's."""
    scene = Scene.build("dex5", "cylinder")
    model = scene.model
    first, second, *_ = (model.body(name).id for name in scene.hand.fingertip_bodies)
    (high, *_), (low, *_) = (np.flatnonzero(model.geom_bodyid == body) for body in (first, second))
    model.geom_priority[[high, low]] = 2, -1
    model.geom_friction[high, 0], model.geom_friction[low, 0] = 0.4, 3.0
    one = ParameterSet(scene, 1, model.opt.timestep)
    shares = np.array([[1.5, 0.5, 1.0, 1.0, 1.0]])
    one.set({"tip_friction": shares})
    assert met(one.models[0], scene, int(high)) == pytest.approx(0.6)  # 1.5 of its own 0.4
    assert met(one.models[0], scene, int(low)) == pytest.approx(0.5)  # half of the object's 1


def test_shapes_that_do_not_fit(cylinder: Scene) -> None:
    sim = BatchSimulator(cylinder, 4, seed=0)
    with pytest.raises(InvalidInput, match=r"gravity has shape \(3,\); expected \(4, 3\)"):
        sim.set_parameters(gravity=[0.0, 0.0, -9.81])
    with pytest.raises(InvalidInput, match=r"kp has shape \(4, 2\); expected \(\) or \(4,\) or"):
        sim.set_parameters(kp=np.ones((4, 2)))
    with pytest.raises(InvalidInput, match=r"tip_friction has shape \(4, 2\); expected \(\) or"):
        sim.set_parameters(tip_friction=np.ones((4, 2)))
    with pytest.raises(InvalidInput, match=r"link_friction is -0.5; expected finite numbers >= 0"):
        sim.set_parameters(link_friction=-0.5)
    with pytest.raises(InvalidInput, match=r"object_size is 0.0; expected finite numbers > 0"):
        sim.set_parameters(object_size=0.0)
    with pytest.raises(InvalidInput, match=r"centre_of_mass is 'a'; expected numbers"):
        sim.set_parameters(centre_of_mass="a")
    with pytest.raises(InvalidInput, match=r"gravity is nan; expected finite numbers"):
        sim.set_parameters(gravity=np.full((4, 3), np.nan))
