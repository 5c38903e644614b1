"""Whatever a hand's file holds, it is simulated with our solver, one position servo a joint."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from dexctl import HandModel
from dexctl.exceptions import HandModelError, SimulationError
from dexctl.hand import random_configurations
from dexctl.hand_config import Coupling, HandConfig, PalmConfig, PostureConfig, ServoConfig
from dexctl.sim import BatchSimulator, Scene
from dexctl.sim.file_settings import lean_model
from dexctl.sim.hand_spec import hand_spec, propose_servos
from dexctl.sim.visuals import visual_model

PALM = '<body name="palm" childclass="dex5">'
Hands = Callable[..., HandModel]
BoxFile = Callable[[Path, tuple[float, float, float], float], None]

OPTION = '<option timestep="0.005" integrator="implicitfast" cone="elliptic" impratio="10"/>'
ODD_OPTION = """
<option timestep="0.011" integrator="RK4" cone="pyramidal" impratio="3" iterations="1"
  ls_iterations="1" tolerance="0.1" ls_tolerance="0.5" solver="PGS" jacobian="dense"
  noslip_iterations="2" noslip_tolerance="0.3" ccd_iterations="3" ccd_tolerance="0.1"
  sdf_iterations="2" sdf_initpoints="3" o_margin="0.01" o_solref="0.3 2"
  o_solimp="0.1 0.2 0.1 0.5 1" o_friction="0.1 0.1 0.1 0.1 0.1" wind="1 2 3" density="9"
  viscosity="2" magnetic="1 1 1" gravity="1 2 3" actuatorgroupdisable="0 1">
  <flag warmstart="disable" contact="disable" eulerdamp="disable" override="enable"
    energy="enable" autoreset="disable" actuation="disable" limit="disable" filterparent="disable"/>
</option>
<size memory="300K"/>
"""


def options(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    return {n: np.array(getattr(model.opt, n)) for n in dir(model.opt) if not n.startswith("_")}


def test_no_option_of_the_file_reaches_the_simulation(changed_dex5: Hands) -> None:
    ours = options(Scene.build("dex5").model)
    found = Scene.build(changed_dex5((OPTION, ODD_OPTION)))
    for name, value in options(found.model).items():
        np.testing.assert_array_equal(value, ours[name], err_msg=name)
    assert (ours["iterations"], ours["ls_iterations"], ours["solver"]) == (100, 50, 2)
    assert (ours["integrator"], ours["cone"], ours["impratio"]) == (3, 1, 100)
    assert ours["timestep"] == 0.005
    assert found.model.narena == Scene.build("dex5").model.narena
    np.testing.assert_array_equal(found.settled.qpos, Scene.build("dex5").settled.qpos)


def test_contacts_are_as_soft_as_ours_whatever_the_file_says(changed_dex5: Hands) -> None:
    """The LEAP hand of the menagerie has contacts a fiftieth of a timestep stiff, which chatter."""
    stiff = '<geom solref="0.0001 1" solimp="0.999 0.999 0.001 0.0001 1" solmix="3"/>'
    found = Scene.build(changed_dex5(("\n  <default>\n", f"\n  <default>{stiff}\n"))).model
    ours = Scene.build("dex5").model
    for name in ("geom_solref", "geom_solimp", "geom_solmix"):
        np.testing.assert_array_equal(getattr(found, name), getattr(ours, name), err_msg=name)


def test_limits_pairs_and_priority_of_the_file_are_no_contacts_of_another_kind(
    changed_dex5: Hands,
) -> None:
    """With ``priority`` a geom's ``condim`` counts alone: 1 had the object slip out of the hand."""
    given = (
        '<geom priority="1" margin="0.004" gap="0.002"/>'
        '<joint solreflimit="0.0001 1" solimplimit="0.999 0.999 0.001 0.0001 1" margin="0.3"/>'
    )
    pair = (
        '<contact><pair name="p" geom1="f1_tip" geom2="f2_tip" solref="0.0001 1" '
        'solimp="0.999 0.999 0.001 0.0001 1" margin="0.01"/></contact></mujoco>'
    )
    hand = changed_dex5(
        ("\n  <default>\n", f"\n  <default>{given}\n"), ("</mujoco>", pair),
        ('condim="4"', 'condim="1"'),
    )  # fmt: skip
    found, ours = Scene.build(hand).model, Scene.build("dex5").model
    for name in ("geom_margin", "geom_gap", "jnt_solref", "jnt_solimp", "jnt_margin"):
        np.testing.assert_array_equal(getattr(found, name), getattr(ours, name), err_msg=name)
    assert found.geom_condim[found.geom_priority > 0].min() == 4
    assert found.npair == 1 and found.pair_margin[0] == 0.0
    np.testing.assert_array_equal(found.pair_solref[0], ours.geom_solref[0])
    np.testing.assert_array_equal(found.pair_solimp[0], ours.geom_solimp[0])


def tip_errors(hand: HandModel, spec: mujoco.MjSpec) -> float:
    """How far simulated fingertips are from computed ones, at most over random postures [m]."""
    model = lean_model(spec, hand)
    data, worst = mujoco.MjData(model), 0.0
    for q in random_configurations(hand, 20, seed=3):
        for name, value in zip(hand.joint_names, q, strict=True):
            data.joint(name).qpos = value
        for name, mimic in hand.couplings.items():
            assert mimic.master is not None
            master = q[hand.joint_names.index(mimic.master)]
            data.joint(name).qpos = mimic.scale * master + mimic.offset
        mujoco.mj_kinematics(model, data)
        bodies = [data.body(name) for name in hand.fingertip_bodies]
        found = [
            body.xpos + body.xmat.reshape(3, 3) @ offset
            for body, offset in zip(bodies, hand.fingertip_offsets, strict=True)
        ]
        worst = max(worst, float(np.abs(found - hand.fingertip_positions(q)).max()))
    return worst


TIP = '<collision><geometry><sphere radius="0.014"/></geometry></collision>'
SIDEWAYS = PalmConfig(axis=(1.0, 0.2, 0.0), up=(0.0, 0.3, -1.0))


def test_a_turned_mjcf_has_its_fingertips_where_kinematics_says(changed_dex5: Hands) -> None:
    scene = (
        '<worldbody>\n    <body name="palm" childclass="dex5">',
        '<worldbody><geom name="floor" type="plane" size="1 1 1" pos="0 0 -1"/>'
        '<camera name="overview"/><light name="sky"/><site name="s"/>'
        '<frame euler="0.1 0.5 0" pos="0 0 1"><body name="palm" childclass="dex5">',
    )
    hand = changed_dex5(scene, ("</worldbody>", "</frame></worldbody>"), palm=SIDEWAYS)
    spec, notes = hand_spec(hand)
    assert tip_errors(hand, spec) < 1e-12
    assert notes == ()
    floor = lean_model(spec, hand)
    data = mujoco.MjData(floor)
    mujoco.mj_kinematics(floor, data)
    normal = data.geom("floor").xmat.reshape(3, 3)[:, 2]
    np.testing.assert_allclose(normal, hand.base_rotation[:, 2], atol=1e-12)


def test_urdf_tips_agree_with_kinematics_and_followers_follow(urdf_hand: Hands) -> None:
    mimic = '<mimic joint="f{i}_flexion1" multiplier="-1.2" offset="0.1"/>'
    hand = urdf_hand(
        base="0.3 1.2 0.5", mimic=mimic, config={"palm": SIDEWAYS, "postures": PostureConfig()}
    )
    spec, notes = hand_spec(hand)
    assert hand.nq == 10
    assert tip_errors(hand, spec) < 1e-12
    assert any("position servos added to 10 of 10 joints" in note for note in notes)
    model = lean_model(spec, hand)
    data = mujoco.MjData(model)
    joints = [model.joint(name) for name in hand.joint_names]
    np.testing.assert_allclose([j.range for j in joints], np.transpose([hand.lower, hand.upper]))
    model.opt.gravity[:] = 0
    for name in hand.joint_names:
        data.actuator(f"servo {name}").ctrl = 0.5
    push = model.body("f1_tip").id
    data.xfrc_applied[push, :3] = [0.5, 0.5, 0.5]  # [N], on a finger that weighs 90 g
    mujoco.mj_step(model, data, 400)
    for i in range(1, 6):
        wanted = -1.2 * data.joint(f"f{i}_flexion1").qpos + 0.1
        assert abs(data.joint(f"f{i}_flexion2").qpos - wanted) < 0.01


@pytest.mark.parametrize("gravity", ["up", "down"])
def test_a_urdf_that_points_elsewhere_holds(gravity: str, urdf_hand: Hands) -> None:
    """Its palm looks along x in the file, and it has neither actuators nor masses."""
    hand = urdf_hand(
        base="0 1.5707963 0", inertial="",
        config={"palm": PalmConfig(axis=(1.0, 0.0, 0.0), up=(0.0, 0.0, -1.0))},
    )  # fmt: skip
    scene = Scene.build(hand, "cube", gravity)
    plant = BatchSimulator(scene, 4, seed=0)
    for _ in range(40):
        plant.step()
    state = plant.read()
    assert state.object_position is not None
    moved = np.linalg.norm(state.object_position - plant.start_position, axis=1)
    assert (moved < 0.01).all()
    assert state.in_contact.sum(axis=1).min() >= 3
    assert any("no mass or inertia given" in note for note in scene.notes)


def test_servos_that_the_file_lacks_are_added_and_said(changed_dex5: Hands) -> None:
    hand = changed_dex5(("<position name=", "<motor name="))
    scene = Scene.build(hand)
    proposal = propose_servos(hand)
    np.testing.assert_allclose(scene.stiffness, proposal.stiffness)
    assert (scene.stiffness > 1.0).all() and (scene.stiffness < 10.0).all()
    assert scene.model.nu == hand.nq
    assert any(note.startswith("actuators taken away") for note in scene.notes)
    assert any("added to 15 of 15" in note and "proposed" in note for note in scene.notes)
    np.testing.assert_allclose(scene.lower, hand.lower)
    said = replace(hand.config, servos=ServoConfig(stiffness=2.5, damping=0.1, effort=0.3)).build()
    own = Scene.build(said)
    np.testing.assert_allclose(own.stiffness, 2.5)
    np.testing.assert_allclose(own.model.actuator_biasprm[own.actuators, 2], -0.1)
    np.testing.assert_allclose(own.model.actuator_forcerange[own.actuators], [[-0.3, 0.3]] * 15)
    own.settled  # noqa: B018 (raises where it does not hold)


def test_owner_overrules_the_servos_of_the_file(dex5: HandModel) -> None:
    servos = ServoConfig(stiffness={"f2_roll": 4.0}, effort={"f3_roll": 0.2})
    scene = Scene.build(replace(dex5.config, servos=servos).build())
    wanted = np.full(15, 3.0)
    wanted[scene.hand.joint_names.index("f2_roll")] = 4.0
    np.testing.assert_allclose(scene.stiffness, wanted)
    limits = scene.model.actuator_forcerange[scene.actuators, 1]
    assert limits[scene.hand.joint_names.index("f3_roll")] == 0.2
    assert limits[0] == 0.5
    assert scene.notes == ()


def test_a_proposal_of_one_link_is_what_hand_and_pencil_give(tmp_path: Path) -> None:
    path = tmp_path / "one.xml"
    path.write_text(
        '<mujoco><compiler angle="radian" autolimits="true"/><worldbody>'
        '<body name="palm"><body name="tip">'
        '<inertial pos="0 0 0.05" mass="0.2" diaginertia="1e-4 1e-4 1e-4"/>'
        '<joint name="j" axis="0 1 0" range="-1 1" damping="0.01"/>'
        '<geom size="0.01" pos="0 0 0.1" mass="0"/></body></body></worldbody></mujoco>'
    )
    hand = HandModel.from_mjcf(path, {"tip": (0.0, 0.0, 0.1)})
    gains = propose_servos(hand)
    inertia = 1e-4 + 0.2 * 0.05**2
    fastest = (2 * np.pi * 8.0) ** 2
    sag = 9.81 * 0.2 * 0.05 / 0.05
    pressing = 2.0 * 0.1 / 0.1
    assert gains.stiffness[0] == pytest.approx(max(inertia * fastest, sag, pressing))
    total = gains.stiffness[0] / fastest
    assert gains.armature[0] == pytest.approx(total - inertia)
    assert gains.damping[0] == pytest.approx(2 * np.sqrt(gains.stiffness[0] * total) - 0.01)
    # and it does so: the step response is as fast as it says and does not ring
    model = lean_model(hand_spec(hand).spec, hand)
    data = mujoco.MjData(model)
    model.opt.gravity[:] = 0
    data.ctrl[0] = 0.5
    path_of_q = []
    for _ in range(100):
        mujoco.mj_step(model, data)
        path_of_q.append(float(data.qpos[0]))
    assert max(path_of_q) < 0.505
    assert path_of_q[40] > 0.49  # 0.2 s


def test_followers_in_a_file_of_degrees_with_references(tmp_path: Path) -> None:
    path = tmp_path / "degrees.xml"
    path.write_text(
        '<mujoco><compiler angle="degree" autolimits="true"/><worldbody><body name="palm">'
        '<body><joint name="a" ref="30" range="-60 90" axis="0 1 0"/>'
        '<geom type="capsule" size="0.01" fromto="0 0 0 0 0 0.05"/>'
        '<body name="tip" pos="0 0 0.06"><joint name="b" ref="-20" range="-90 90" axis="0 1 0"/>'
        '<geom type="capsule" size="0.01" fromto="0 0 0 0 0 0.05"/></body></body></body>'
        '</worldbody><equality><joint joint1="b" joint2="a" polycoef="0.1 0.7 0 0 0"/></equality>'
        "</mujoco>"
    )
    hand = HandModel.from_mjcf(path, {"tip": (0.0, 0.0, 0.05)})
    spec, _ = hand_spec(hand)
    assert tip_errors(hand, spec) < 1e-12
    model = lean_model(spec, hand)
    data = mujoco.MjData(model)
    data.ctrl[0] = 1.0
    mujoco.mj_step(model, data, 300)
    a, b = (float(data.joint(name).qpos[0]) for name in "ab")
    assert a == pytest.approx(1.0, abs=0.05)
    assert b - np.deg2rad(-20) == pytest.approx(0.1 + 0.7 * (a - np.deg2rad(30)), abs=1e-3)


def test_a_sliding_joint_gets_a_servo_for_lengths(urdf_hand: Hands) -> None:
    path = urdf_hand(1).path
    text = path.read_text().replace('"f1_roll" type="revolute"', '"f1_roll" type="prismatic"')
    path.write_text(text.replace('"f1_flexion2" type="revolute"', '"f1_flexion2" type="fixed"'))
    hand = HandModel.from_urdf(path, ["f1_tip"])
    slide, turn = propose_servos(hand).stiffness
    mass = 3 * 0.03 + 1000 * 4 / 3 * np.pi * 0.014**3
    pressing = 2.0 / 0.01  # 2 N with 10 mm between set-point and joint
    assert slide == pytest.approx(max(mass * (2 * np.pi * 8.0) ** 2, pressing))
    assert turn < 10.0
    scene = hand_spec(hand).spec
    assert lean_model(scene, hand).nu == 2


def test_a_joint_whose_limits_are_equal_is_held(urdf_hand: Hands) -> None:
    path = urdf_hand(1).path
    path.write_text(path.read_text().replace('lower="-0.7" upper="0.7"', 'lower="0.2" upper="0.2"'))
    hand = HandModel.from_urdf(path, ["f1_tip"])
    model = lean_model(hand_spec(hand).spec, hand)
    np.testing.assert_allclose(model.joint("f1_roll").range, 0.2, atol=1e-5)


def test_a_velocity_servo_beside_a_position_servo_stays_as_damping(changed_dex5: Hands) -> None:
    extra = '<velocity joint="f1_roll" kv="0.2" gear="2"/>'
    hand = changed_dex5(("</actuator>", extra + "</actuator>"))
    model = Scene.build(hand).model
    assert model.nu == 15
    roll = model.actuator("f1_roll").id
    assert model.actuator_biasprm[roll, 2] == pytest.approx(-0.15 - 0.2 * 4)


def tendon_hand(changed_dex5: Hands, actuator: str, other: str = "", **config: object) -> HandModel:
    """dex5 whose first finger flexes by one tendon, as Shadow's J0 does."""
    tendon = (
        '<tendon><fixed name="f1_J0" limited="true" range="-0.9 0.9">'
        '<joint joint="f1_flexion1" coef="1"/><joint joint="f1_flexion2" coef="-0.5"/>'
        "</fixed></tendon>"
    )
    return changed_dex5(
        ("<actuator>", tendon + "<actuator>"),
        ('<position name="f1_flexion1" class="dex5" joint="f1_flexion1"/>', other),
        ('<position name="f1_flexion2" class="dex5" joint="f1_flexion2"/>', actuator),
        postures=PostureConfig(),
        **config,
    )


def test_an_actuator_on_a_tendon_drives_the_joint_that_its_joints_follow(
    changed_dex5: Hands,
) -> None:
    actuator = (
        '<position name="J0" tendon="f1_J0" kp="2" kv="0.3" gear="1.2" forcerange="-0.4 0.4" '
        'ctrlrange="-0.5 1.2" ctrllimited="true"/>'
    )
    coupling = {"f1_flexion2": Coupling(joint="f1_flexion1", scale=-1.0, offset=0.2)}
    hand = tendon_hand(changed_dex5, actuator, couplings=coupling)
    assert "f1_flexion2" in hand.couplings
    scene = Scene.build(hand, object_size=0.1)
    j = hand.joint_names.index("f1_flexion1")
    # length = q1 - 0.5 (-q1 + 0.2) = 1.5 q1 - 0.1, times the gear
    ratio, constant = 1.2 * 1.5, -0.1 * 1.2
    assert scene.stiffness[j] == pytest.approx(2 * ratio**2)
    assert scene.ctrl_per_radian[j] == 1.0
    assert scene.upper[j] == pytest.approx((1.2 - constant) / ratio)
    servo = scene.actuators[j]
    assert scene.model.actuator_biasprm[servo, 2] == pytest.approx(-0.3 * ratio**2)
    np.testing.assert_allclose(scene.model.actuator_forcerange[servo], [-0.4 * ratio, 0.4 * ratio])
    model, data = scene.model, mujoco.MjData(scene.model)
    model.opt.gravity[:] = 0
    data.qpos[scene.object_qpos.start] = 1.0  # out of the way
    data.ctrl[scene.actuators] = 0.1
    data.ctrl[servo] = 0.6
    mujoco.mj_step(model, data, 400)
    q1, q2 = float(data.joint("f1_flexion1").qpos[0]), float(data.joint("f1_flexion2").qpos[0])
    assert q1 == pytest.approx(0.6, abs=0.01)
    assert q2 == pytest.approx(-0.6 + 0.2, abs=0.01)


def test_a_tendon_over_joints_that_nothing_couples_says_what_to_write(changed_dex5: Hands) -> None:
    actuator, other = '<position name="J0" tendon="f1_J0" kp="2"/>', '<motor joint="f1_flexion1"/>'
    hand = tendon_hand(changed_dex5, actuator, other)
    with pytest.raises(SimulationError, match=r"'J0' drives f1_flexion1 and f1_flexion2 together"):
        Scene.build(hand)
    nameless = tendon_hand(changed_dex5, actuator.replace('name="J0" ', ""), other)
    with pytest.raises(SimulationError, match=r"actuator \d+, without a name, drives f1_flexion1"):
        Scene.build(nameless)
    own = replace(hand.config, servos=ServoConfig(stiffness=3.0)).build()
    assert Scene.build(own).model.nu == 15


def test_what_belongs_to_another_simulation_is_left_out(changed_dex5: Hands) -> None:
    extra = """
      <body name="object" pos="0.5 0 0"><freejoint name="object"/><geom name="object" size="0.02"/>
      </body>
      <body name="goal" mocap="true"><geom size="0.02" contype="0" conaffinity="0"/></body>
      <body name="table" pos="0 0 -1"><geom type="box" size="1 1 0.1"/></body>
      <body name="other hand" pos="0 1 0"><joint name="their joint"/><geom size="0.02"/></body>
      <geom name="floor" type="plane" size="1 1 1" pos="0 0 -2"/>
    </worldbody>
    <asset><material name="object"/><material name="floor"/>
      <texture name="sky" type="skybox" builtin="flat" width="8" height="48"/></asset>
    <tendon><fixed name="theirs"><joint joint="their joint" coef="1"/></fixed></tendon>
    <sensor><jointpos name="touch_0" joint="f1_roll"/><framepos objtype="body" objname="object"/>
    </sensor>
    <keyframe><key name="home" time="1"/></keyframe>
    <equality><weld body1="object" body2="palm" active="false"/></equality>"""
    end = '<motor joint="their joint"/><position tendon="theirs"/></actuator>'
    hand = changed_dex5(("</worldbody>", extra), ("</actuator>", end))
    scene = Scene.build(hand)
    assert (scene.model.nq, scene.model.nu, scene.model.nkey) == (15 + 7, 15, 0)
    assert [n.split(":")[0] for n in scene.notes] == [
        "loose bodies of the file left out",
        "joints that move no fingertip stay where they are",
    ]
    assert visual_model(scene).nbody == scene.model.nbody
    np.testing.assert_allclose(
        scene.settled.qpos, Scene.build("dex5").settled.qpos, rtol=0, atol=1e-3
    )


def test_a_link_that_is_called_object_keeps_its_name(changed_dex5: Hands) -> None:
    hand = changed_dex5(('"f2_proximal"', '"object"'))
    scene = Scene.build(hand)
    assert scene.object_body == "held_object"
    assert visual_model(scene).body("held_object").id != scene.model.body("object").id
    np.testing.assert_array_equal(scene.settled.qpos, Scene.build("dex5").settled.qpos)


def test_the_object_meets_geoms_of_any_collision_bits(changed_dex5: Hands) -> None:
    hand = changed_dex5(("<geom density=", '<geom contype="2" conaffinity="4" density='))
    assert Scene.build(hand).settled.yaw == 0.0


def test_a_fingertip_without_geometry(changed_dex5: Hands) -> None:
    tip = '<geom name="f1_tip" class="dex5_tip"/>'
    with pytest.raises(SimulationError, match=r"'f1_tip' has no collision .*'f1_distal'"):
        Scene.build(changed_dex5((tip, "")))
    link = '<geom type="capsule" size="0.008" fromto="0 0 0 0 0 0.065" rgba="0.45 0.48 0.52 1"/>'
    ghost = link.replace("<geom ", '<geom contype="0" conaffinity="0" ')
    scene = Scene.build(changed_dex5((tip, ""), (link, ghost)))
    assert any(
        "'f1_tip' has no collision geometry: it gets a sphere of 8 mm" in n for n in scene.notes
    )
    scene.settled  # noqa: B018


def test_a_urdf_fingertip_without_geometry_touches_with_its_link(
    tmp_path: Path, urdf_hand: Hands
) -> None:
    hand = urdf_hand(
        tip="", distal=TIP.replace("<collision>", '<collision><origin xyz="0 0 0.075"/>')
    )
    scene = Scene.build(hand)
    assert any("'f1_tip' has no shape: it touches with that of f1_distal" in n for n in scene.notes)
    assert not any("no mass" in n for n in scene.notes if "tip" in n)
    whole = Scene.build(urdf_hand())
    mass = [m.body_subtreemass[m.body("palm").id] for m in (scene.model, whole.model)]
    assert mass[0] == pytest.approx(mass[1] - 5 * 1000 * 4 / 3 * np.pi * 0.014**3)
    assert scene.settled.yaw == whole.settled.yaw
    text = whole.hand.path.read_text().replace("<collision>", "<!--").replace("</collision>", "-->")
    (tmp_path / "bare.urdf").write_text(text)
    spec, notes = hand_spec(HandModel.from_urdf(tmp_path / "bare.urdf", ["f1_tip"]))
    assert any("it gets a sphere of 8 mm radius" in note for note in notes)
    assert len(spec.body("f1_tip").geoms) == 1


def inertial(*moments: float) -> str:
    xx, yy, zz = moments
    return (
        f'<inertial><mass value="0.03"/><inertia ixx="{xx}" iyy="{yy}" izz="{zz}" ixy="0" ixz="0" '
        'iyz="0"/></inertial>'
    )


def test_inertias_that_no_body_has_are_mended_within_a_bound(urdf_hand: Hands) -> None:
    scene_of = lambda text: Scene.build(urdf_hand(inertial=text))  # noqa: E731
    scene = scene_of(inertial(2e-5, 3e-5, 6e-5))
    (note,) = (n for n in scene.notes if "A + B < C mended" in n)
    assert "f1_base (by 17 % of C)" in note
    found = np.sort(scene.model.body("f1_distal").inertia)
    np.testing.assert_allclose(found, [2.5e-5, 3.5e-5, 6e-5], rtol=1e-6)
    with pytest.raises(SimulationError, match="link 'f1_base' has the principal moments"):
        scene_of(inertial(1e-6, 1e-6, 6e-5))
    with pytest.raises(HandModelError, match="link 'f1_base' has izz='inf' in the <inertia>"):
        scene_of(inertial(2e-5, 3e-5, np.inf))


def test_friction_and_damping_that_no_servo_overcomes_are_left_out(urdf_hand: Hands) -> None:
    scene = Scene.build(urdf_hand(dynamics='<dynamics damping="3" friction="10"/>'))
    assert any("more friction or damping in the file" in note for note in scene.notes)
    assert (scene.model.dof_frictionloss == 0).all()
    scene.settled  # noqa: B018
    little = Scene.build(urdf_hand(dynamics='<dynamics damping="0.01" friction="0.02"/>'))
    np.testing.assert_allclose(little.model.dof_frictionloss[little.qvel_columns], 0.02)


def mesh(file: str, kind: str = "collision") -> str:
    return f'<{kind}><geometry><mesh filename="{file}" scale="0.5 1 1"/></geometry></{kind}>'


def test_meshes_of_packages_beside_and_unreadable(
    tmp_path: Path, urdf_hand: Hands, box_stl: BoxFile
) -> None:
    package = tmp_path / "my_hand"
    (package / "meshes" / "visual").mkdir(parents=True)
    (package / "urdf").mkdir()
    box_stl(package / "meshes" / "box.stl", (0.02, 0.02, 0.02), -0.01)
    box_stl(package / "meshes" / "visual" / "box.stl", (0.04, 0.02, 0.02), -0.01)
    (package / "meshes" / "box.dae").write_text("<COLLADA/>")
    (package / "meshes" / "only.dae").write_text("<COLLADA/>")
    hand = urdf_hand(
        folder=package / "urdf",
        palm=mesh("package://my_hand/meshes/box.stl")
        + mesh("../meshes/visual/box.stl", "visual")
        + mesh("package://my_hand/meshes/box.dae", "visual")
        + mesh("package://my_hand/meshes/only.dae", "visual")
        + mesh("../meshes/none.stl", "visual"),
    )
    spec, notes = hand_spec(hand)
    (note,) = (n for n in notes if n.startswith("pictures lack"))
    assert "only.dae" in note and "none.stl" in note and "box.dae" not in note
    whole = spec.copy().compile()
    assert whole.nmesh == 3
    assert lean_model(spec, hand).nmesh == 1
    for file, why in (
        ("../meshes/none.stl", r"not found; looked for \S+none.stl$"),
        ("../meshes/only.dae", "convert it"),
    ):
        broken = urdf_hand(folder=package / "urdf", palm=mesh(file))
        with pytest.raises(SimulationError, match=rf"link 'palm': mesh .*{why}"):
            hand_spec(broken)


def test_links_side_by_side_do_not_collide(urdf_hand: Hands) -> None:
    """A finger's first link stands in the palm, which is fixed to the world."""
    inside = (
        '<collision><origin xyz="0 0 -0.01"/><geometry><cylinder radius="0.075" length="0.04"/>'
        "</geometry></collision>"
    )
    hand = urdf_hand(palm=inside)
    model = lean_model(hand_spec(hand).spec, hand)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert data.ncon == 0
    assert model.nexclude >= 5


def test_links_of_an_mjcf_that_lie_in_a_palm_fixed_to_the_world_do_not_collide(
    dex5: HandModel, changed_dex5: Hands
) -> None:
    """Under a palm that moves MuJoCo leaves such contacts out by itself."""
    palm = '<body name="palm" childclass="dex5"><geom type="cylinder" size="0.075 0.02"/>'
    excluded = re.search(r"<contact>.*?</contact>", dex5.path.read_text(), re.DOTALL)
    assert excluded is not None
    hand = changed_dex5((PALM, palm), (excluded.group(), ""))
    spec, notes = hand_spec(hand)
    model = lean_model(spec, hand)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert data.ncon == 0
    assert any(
        "lie in each other, whose contacts are excluded: palm and f1_base" in n for n in notes
    )
    assert not hand_spec(dex5).notes  # its file excludes them itself


def test_two_hands_in_one_file_by_include_and_fused(tmp_path: Path, dex5: HandModel) -> None:
    """The one whose fingertips are named moves; the other stays where it is."""
    text = dex5.path.read_text()
    (tmp_path / "right.xml").write_text(text)
    names = re.compile(r'(name|class|childclass|joint|body1|body2)="((?:f\d|palm|dex5)[^"]*)"')
    (tmp_path / "left.xml").write_text(names.sub(r'\1="left_\2"', text))
    both = tmp_path / "both.xml"
    both.write_text(
        '<mujoco><compiler fusestatic="true"/><include file="right.xml"/>'
        '<include file="left.xml"/></mujoco>'
    )
    for side in ("", "left_"):
        config = replace(
            dex5.config,
            description=both,
            fingertips={f"{side}{tip}": at for tip, at in dex5.config.fingertips.items()},
            postures=PostureConfig(
                open={f"{side}{j}": a for j, a in dex5.config.postures.open.items()}
            ),
        )
        hand = config.build()
        assert len(hand.ignored_joints) == 15
        spec, notes = hand_spec(hand)
        assert tip_errors(hand, spec) < 1e-12
        model = lean_model(spec, hand)
        assert (model.nq, model.nu) == (15, 15)
        assert {j.name.startswith("left") for j in spec.joints} == {bool(side)}
        assert any("stay where they are" in note for note in notes)


LEAKING = """
<default>
  <geom margin="0.01" gap="0.01" solref="0.1 1" solimp="0.1 0.2 0.1" priority="2" solmix="3"
    group="3" type="box" density="9" material="m"/>
  <joint damping="1" armature="1" frictionloss="2" range="0 1" limited="true"/>
  <position ctrlrange="-9 9" forcerange="-0.1 0.1" timeconst="0.1"/>
  <general gear="3" ctrlrange="-9 9" forcerange="-0.1 0.1" biasprm="1 2 3" delay="0.1" nsample="3"/>
  <mesh scale="2 2 2"/><equality solref="0.5 1" solimp="0.1 0.2 0.1"/>
</default>"""


@pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass'")
def test_defaults_and_masses_of_the_file_are_not_the_objects(changed_dex5: Hands) -> None:
    plain = Scene.build("dex5", "icosahedron")
    hand = changed_dex5(
        ("\n  <default>\n", "\n" + LEAKING + '<asset><material name="m"/></asset>\n<default>\n'),
        ("<compiler ", '<compiler settotalmass="2" inertiagrouprange="3 3" '),
        ("<position name=", "<motor name="),
        servos=ServoConfig(stiffness=3.0, damping=0.15, effort=0.5),
    )  # fmt: skip
    scene = Scene.build(hand, "icosahedron")
    for name in ("margin", "gap", "solref", "solimp", "priority", "solmix", "friction", "condim"):
        field = f"geom_{name}"
        ours = [getattr(one.model, field)[one.model.ngeom - 1] for one in (plain, scene)]
        np.testing.assert_array_equal(ours[1], ours[0], err_msg=name)
    np.testing.assert_allclose(scene.model.mesh_vert, plain.model.mesh_vert, atol=1e-6)
    body, other = (one.model.body(one.object_body) for one in (scene, plain))
    np.testing.assert_allclose(body.mass, 0.1)
    np.testing.assert_allclose(body.inertia, other.inertia)
    hands = scene.model.body_mass.sum() - 0.1
    assert hands == pytest.approx(2.0)  # as the file has it, for the hand alone
    assert (scene.model.dof_damping[scene.object_qvel] == 0).all()
    np.testing.assert_array_equal(scene.ctrl_per_radian, 1.0)
    np.testing.assert_allclose(scene.stiffness, 3.0)
    np.testing.assert_allclose(
        scene.model.actuator_biasprm[scene.actuators, :3], [[0, -3.0, -0.15]] * 15
    )
    np.testing.assert_allclose(scene.model.actuator_forcerange[scene.actuators, 1], 0.5)
    assert scene.model.na == 0


def test_a_filter_of_a_position_actuator_is_left_out(changed_dex5: Hands) -> None:
    """Its state would begin at zero, so that the hand opens whenever an episode begins."""
    hand = changed_dex5(('kv="0.15"', 'kv="0.15" timeconst="0.1"'))
    scene = Scene.build(hand)
    assert scene.model.na == 0
    assert any(note.startswith("filters of position actuators left out") for note in scene.notes)
    np.testing.assert_array_equal(scene.settled.qpos, Scene.build("dex5").settled.qpos)


def test_a_hand_on_a_wrist(changed_dex5: Hands) -> None:
    mass = '<inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>'
    wrist = '<body name="arm"><joint name="wrist" axis="0 0 1" range="-1 1" damping="0.5"/>'
    hand = changed_dex5(
        (PALM, wrist + mass + PALM),
        ("</worldbody>", "</body></worldbody>"),
    )  # fmt: skip
    assert hand.joint_names[0] == "wrist" and hand.shares_joints
    scene = Scene.build(hand)
    assert scene.model.nu == 16
    assert any("added to 1 of 16 joints" in note for note in scene.notes)
    scene.settled  # noqa: B018


def test_leap_made_for_gpu_physics_holds(leap_mjx: HandModel) -> None:
    """Its file says iterations="5" ls_iterations="8", with which the object is thrown out."""
    scene = Scene.build(leap_mjx, "cube", object_size=0.07, grasp_centre=(0.1, 0.0, 0.08))
    plant = BatchSimulator(scene, 16, seed=0)
    for _ in range(100):
        plant.step()
    moved = np.linalg.norm(plant.read().object_centre() - plant.start_position, axis=1)
    assert (moved < 0.03).all()  # it sinks by 17 to 22 mm


def test_leap_urdf_has_its_fingertips_where_kinematics_says(leap_urdf: HandModel) -> None:
    assert tip_errors(leap_urdf, hand_spec(leap_urdf).spec) < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("gravity", ["up", "down"])
def test_leap_urdf_holds_what_is_suggested(leap_urdf: HandModel, gravity: str) -> None:
    """Its fingers point along the file's z; neither actuators nor fingertip shapes in the file."""
    grasp, *_ = Scene.suggest_grasp(leap_urdf, "cube", count=1, tries=6)
    scene = Scene.build(
        leap_urdf, "cube", gravity, object_size=grasp.size, grasp_centre=grasp.centre,
        open_q=grasp.open_q, grasp_q=grasp.grasp_q,
    )  # fmt: skip
    plant = BatchSimulator(scene, 16, seed=0)
    for _ in range(200):
        plant.step()
    moved = np.linalg.norm(plant.read().object_centre() - plant.start_position, axis=1)
    assert (moved < 0.03).mean() > 0.9


@pytest.fixture(scope="module")
def leap_mjx(shared_hands: Path) -> HandModel:
    fingers, thumb = (0.8, 0.0, 0.75, 0.6), (1.5, 0.3, 0.4, 0.4)
    joints, own = ("mcp", "rot", "pip", "dip"), ("cmc", "axl", "mcp", "ipl")
    opened = {
        f"{finger}_{joint}": angle
        for finger in ("if", "mf", "rf")
        for joint, angle in zip(joints, fingers, strict=True)
    } | {f"th_{joint}": angle for joint, angle in zip(own, thumb, strict=True)}
    return HandConfig(
        description=_file(shared_hands / "leap_hand_mjx" / "leap_rh.xml"),
        fingertips={f"{name}_tip": (0.0, 0.0, 0.0) for name in ("if", "mf", "rf", "th")},
        postures=PostureConfig(open=opened),
    ).build()


@pytest.fixture(scope="module")
def leap_urdf(shared_hands: Path) -> HandModel:
    return HandConfig(
        description=_file(shared_hands / "leap_hand_urdf" / "leap_hand_right.urdf"),
        fingertips={
            f"{name}_tip_head": (0.0, 0.0, 0.0) for name in ("index", "middle", "ring", "thumb")
        },
        palm=PalmConfig(axis=(1.0, 0.0, 0.0), up=(0.0, 0.0, 1.0)),
    ).build()


def _file(path: Path) -> Path:
    if not path.is_file():
        pytest.skip(f"{path} is not here")
    return path


@pytest.fixture(scope="module")
def shared_hands() -> Path:
    folder = os.environ.get("DEXCTL_MENAGERIE")
    if not folder:
        pytest.skip("DEXCTL_MENAGERIE names no folder with hands")
    return Path(folder)
