"""Scenes, objects and settled grasps."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from dexctl import HandModel, hands
from dexctl.exceptions import HandModelError, InvalidInput, SimulationError, UnknownName
from dexctl.hand_config import HeldObject, PostureConfig
from dexctl.sim import BatchSimulator, Scene, SceneConfig, object_names
from dexctl.sim import settle as settling
from dexctl.sim.settle import SettledGrasp
from dexctl.sim.settle_failure import SettleFailure


@pytest.mark.parametrize("gravity", ["up", "down"])
@pytest.mark.parametrize("name", object_names())
def test_dex5_holds_every_object(name: str, gravity: str) -> None:
    scene = Scene.build("dex5", name, gravity)
    body = scene.model.body("object")
    assert body.mass[0] == pytest.approx(0.1)
    np.testing.assert_allclose(body.ipos, 0.0, atol=1e-6)  # the body frame is the centre of mass
    settled = scene.settled
    centre = settled.qpos[scene.object_qpos][:3]
    assert np.linalg.norm(centre - scene.grasp_centre) < 0.01
    assert scene.settled is settled


@pytest.mark.parametrize("gravity", ["up", "down"])
@pytest.mark.parametrize("name", ["cube", "sphere", "cylinder"])
def test_four_fingers_hold_objects_of_their_size(
    four_fingers: HandModel, name: str, gravity: str
) -> None:
    scene = Scene.build(four_fingers, name, gravity)
    assert scene.object_width == pytest.approx(four_fingers.config.object.size)
    assert np.linalg.norm(scene.settled.qpos[scene.object_qpos][:3] - scene.grasp_centre) < 0.015


def test_the_mass_of_objects_is_that_of_the_hands_toml(dex5: HandModel) -> None:
    def masses(hand: HandModel, object_mass: float | None = None) -> tuple[float, float]:
        scene = Scene.build(hand, "sphere", object_mass=object_mass)
        config = SceneConfig(object=("sphere",), object_mass=object_mass)
        (configured,) = config.scenes(hand)
        assert scene.model.body("object").mass[0] == pytest.approx(scene.object_mass)
        return scene.object_mass, configured.object_mass

    assert masses(dex5) == (0.1, 0.1)
    light = replace(dex5.config, object=replace(dex5.config.object, mass=0.05)).build()
    assert masses(light) == (0.05, 0.05)
    assert masses(light, object_mass=0.2) == (0.2, 0.2)
    assert SceneConfig().with_mass(light.config) == SceneConfig(object_mass=0.05)
    assert SceneConfig(object_mass=0.2).with_mass(light.config) == SceneConfig(object_mass=0.2)
    assert light.digest == dex5.digest  # runs and policies name it


def test_visual_meshes_are_not_stepped(allegro: HandModel) -> None:
    scene = Scene.build(allegro, "cube")
    assert scene.model.nmesh == 0
    assert scene.spec.compile().nmesh > 0


def test_gravity_by_name_and_vector() -> None:
    np.testing.assert_allclose(Scene.build("dex5", gravity="up").model.opt.gravity, [0, 0, -9.81])
    np.testing.assert_allclose(Scene.build("dex5", gravity="down").model.opt.gravity, [0, 0, 9.81])
    sideways = Scene.build("dex5", "cube", (9.81, 0, 0))
    np.testing.assert_allclose(
        sideways.settled.qpos[sideways.object_qpos][:3], [0, 0, 0.13], atol=0.01
    )


def test_object_size_and_inertia() -> None:
    scene = Scene.build("dex5", "sphere", object_size=0.08, object_mass=0.2)
    inertia = scene.model.body("object").inertia
    np.testing.assert_allclose(inertia, 0.4 * 0.2 * 0.04**2, rtol=1e-6)  # 2/5 m r^2
    for name in ("icosahedron", "dodecahedron"):
        model = Scene.build("dex5", name).model
        vertices = model.mesh_vert
        height = np.ptp(vertices, axis=0)
        assert 0.09 < height.min() <= height.max() < 0.14
        inertia = model.body("object").inertia
        np.testing.assert_allclose(inertia, inertia[0], rtol=1e-3)  # as a sphere's: isotropic


def test_friction_is_that_of_object_and_fingertips() -> None:
    assert Scene.build("dex5", friction=0.3).friction() == 1.0  # the fingertips'; the larger counts
    slippery, rough = (Scene.build("dex5", friction=value) for value in (0.3, 1.5))
    assert rough.friction() == 1.5
    own = slippery.model.geom_bodyid == slippery.model.body("object").id
    slippery.model.geom_priority[own] = 1
    assert slippery.friction() == 0.3


def test_a_mesh_of_the_users(
    tmp_path: Path, box_stl: Callable[[Path, tuple[float, float, float], float], None]
) -> None:
    path = tmp_path / "box.stl"
    box_stl(path, (0.2, 0.2, 0.1), 0.7)
    own = Scene.build("dex5", "mesh", object_mesh=path)
    np.testing.assert_allclose(own.model.body("object").ipos, 0.0, atol=1e-6)
    scene = Scene.build("dex5", "mesh", object_mesh=path, object_size=0.1)
    lengths = np.ptp(scene.model.mesh_vert, axis=0)
    np.testing.assert_allclose(np.sort(lengths), [0.05, 0.1, 0.1], atol=1e-6)
    scene.settled  # noqa: B018 (raises where it is not held)
    with pytest.raises(SimulationError, match="no such file"):
        Scene.build("dex5", "mesh", object_mesh=tmp_path / "nothing.stl")
    (tmp_path / "broken.stl").write_bytes(b"not a mesh")
    with pytest.raises(SimulationError, match=r"broken.stl.*cannot read it"):
        Scene.build("dex5", "mesh", object_mesh=tmp_path / "broken.stl")
    with pytest.raises(InvalidInput, match="goes with object 'mesh' only"):
        Scene.build("dex5", "cube", object_mesh=path)


def test_wrong_names_and_numbers() -> None:
    with pytest.raises(UnknownName, match="unknown object 'teapot'; known: cube, sphere"):
        Scene.build("dex5", "teapot")
    with pytest.raises(UnknownName, match="unknown hand 'dex6'; known: dex5"):
        Scene.build("dex6")
    with pytest.raises(UnknownName, match="unknown gravity 'left'; known: up, down"):
        Scene.build("dex5", "cube", "left")
    with pytest.raises(InvalidInput, match="gravity is"):
        Scene.build("dex5", "cube", (0, np.nan, 0))
    with pytest.raises(InvalidInput, match="object_mass is 0"):
        Scene.build("dex5", object_mass=0)
    with pytest.raises(InvalidInput, match="object_size is -1"):
        Scene.build("dex5", object_size=-1)
    with pytest.raises(InvalidInput, match="object_size is 1e.300; .* above 0, at most 100"):
        Scene.build("dex5", object_size=1e300)
    with pytest.raises(InvalidInput, match="friction is -1"):
        Scene.build("dex5", friction=-1)


def test_an_object_of_a_toml_that_there_is_not(dex5: HandModel) -> None:
    held = replace(dex5.config.object, shape="cub")
    with pytest.raises(UnknownName, match="object.shape of dex5.toml 'cub'; known: cube"):
        Scene.build(replace(dex5.config, object=held).build(), "sphere")
    held = replace(dex5.config.object, sizes={"cube": 0.08, "cub": 0.08})
    with pytest.raises(UnknownName, match="object.sizes of dex5.toml 'cub'; known: cube"):
        Scene.build(replace(dex5.config, object=held).build(), "sphere")


def test_objects_are_as_wide_as_suits_the_hand_each(dex5: HandModel) -> None:
    held = replace(dex5.config.object, size=0.1, sizes={"cube": 0.08})
    hand = replace(dex5.config, object=held).build()
    assert Scene.build(hand, "cube").object_width == 0.08
    assert Scene.build(hand, "sphere").object_width == 0.1
    assert Scene.build(hand, "cube", object_size=0.09).object_width == 0.09


def test_what_cannot_be_held_says_so() -> None:
    scene = Scene.build("dex5", "sphere", object_mass=20.0)
    with pytest.raises(SimulationError, match=r"dex5 does not hold 'sphere' .*20 kg.*touch it"):
        scene.settled  # noqa: B018


def test_an_unknown_hand_may_say_what_it_holds(tmp_path: Path, dex5: HandModel) -> None:
    path = tmp_path / "mine.xml"
    path.write_text(dex5.path.read_text())
    mine = HandModel.from_mjcf(path, list(dex5.fingertip_names))
    opened = hands.config("dex5").postures.open
    scene = Scene.build(
        mine,
        "cube",
        object_size=0.1,
        grasp_centre=(0, 0, 0.13),
        open_q=opened,
    )
    np.testing.assert_array_equal(scene.settled.qpos, Scene.build("dex5", "cube").settled.qpos)


def test_a_joint_without_servo_gets_one(tmp_path: Path, dex5: HandModel) -> None:
    path = tmp_path / "dex5.xml"
    lines = dex5.path.read_text().splitlines()
    path.write_text("\n".join(line for line in lines if 'joint="f2_roll"' not in line))
    scene = Scene.build(replace(dex5.config, description=path).build(), "cube")
    assert any(note.startswith("position servos added to 1 of 15 joints") for note in scene.notes)
    assert scene.stiffness[scene.hand.joint_names.index("f2_roll")] > 0


def test_servo_maps_follow_gear(tmp_path: Path, dex5: HandModel) -> None:
    text = dex5.path.read_text().replace('joint="f2_roll"/>', 'joint="f2_roll" gear="2"/>')
    path = tmp_path / "dex5.xml"
    path.write_text(text)
    scene = Scene.build(replace(dex5.config, description=path).build(), "cube")
    joint = scene.hand.joint_names.index("f2_roll")
    assert scene.ctrl_per_radian[joint] == 2.0
    assert scene.stiffness[joint] == pytest.approx(12.0)  # kp 3, gear squared
    assert isinstance(scene.model, mujoco.MjModel)


def test_menagerie_failures_are_one_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("DEXCTL_MENAGERIE", raising=False)
    monkeypatch.setenv("MENAGERIE_ROOT", str(tmp_path))  # the package finds nothing, offline
    with pytest.raises(HandModelError, match="DEXCTL_MENAGERIE") as caught:
        hands.load("wonik_allegro")
    assert "\n" not in str(caught.value)
    with pytest.raises(HandModelError, match="is not there"):
        hands.load("wonik_allegro", folder=tmp_path)


@pytest.mark.slow
def test_an_object_that_is_not_held_where_another_is_gets_its_own_place(
    four_fingers: HandModel,
) -> None:
    own = four_fingers.config.object
    assert own.centre is not None and own.size is not None
    x, y, z = own.centre
    held = HeldObject(centre=(x, y, z + 0.15), size=own.size, shape="cube")
    config = replace(four_fingers.config, description=four_fingers.path)
    high = replace(config, object=held, postures=PostureConfig()).build()
    with pytest.raises(SettleFailure):  # what the toml says of its own object holds
        _ = Scene.build(high, "cube").settled
    with pytest.raises(SettleFailure):  # and so does what the owner says
        _ = Scene.build(high, "sphere", grasp_centre=held.centre).settled
    scene = Scene.build(high, "sphere")
    assert not any("suggested" in note for note in scene.notes)
    settled = scene.settled
    assert "not held where the hand's toml holds a cube: grasp suggested" in scene.notes[-1]
    assert scene.object_width == own.size and scene.grasp_centre[2] < z + 0.1
    assert np.linalg.norm(settled.qpos[scene.object_qpos][:3] - scene.grasp_centre) < 0.015
    np.testing.assert_array_equal(scene.spec.body("object").pos, scene.grasp_centre)
    wider = Scene.build(high, "sphere", object_size=1.05 * own.size)
    wider.hold_as(scene)
    assert wider.settled is not None and not any("suggested" in note for note in wider.notes)
    np.testing.assert_array_equal(wider.grasp_centre, scene.grasp_centre)
    with BatchSimulator(scene, 2, threads=1) as sim:
        sim.reset(seed=0)
        assert (sim.read().in_contact.sum(axis=-1) >= 3).all()


def test_fingertips_inside_of_an_object_want_a_smaller_one() -> None:
    with pytest.raises(SettleFailure, match="fingertips inside of it: f2_tip by 9 mm") as caught:
        _ = Scene.build("dex5", "cube", object_size=0.3).settled
    assert "take a smaller object_size" in str(caught.value)
    assert "friction" not in caught.value.advice


def test_what_settles_is_not_searched_for(dex5: HandModel, monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*_: object, **__: object) -> None:
        raise AssertionError("no grasp is to be searched")

    monkeypatch.setattr("dexctl.sim.suggest.suggested", never)
    scene = Scene.build(dex5, "sphere")
    assert scene.settled is not None
    assert scene.grasp_centre.tolist() == list(dex5.config.object.centre or ())
    with pytest.raises(SettleFailure, match="it weighs"):
        _ = Scene.build(dex5, "sphere", object_mass=20.0).settled


def test_a_file_by_its_path(dex5: HandModel, tmp_path: Path) -> None:
    dex5.config.write(tmp_path / "mine.toml")
    scene = Scene.build(tmp_path / "mine.toml", "cube")
    assert scene.hand.name == "dex5" and scene.object_width == dex5.config.object.size
    with pytest.raises(InvalidInput, match="hand is 5; expected a name"):
        Scene.build(5, "cube")  # type: ignore[arg-type]
    with pytest.raises(UnknownName, match="unknown object 'anvil'"):
        Scene.suggest_grasp(tmp_path / "mine.toml", "anvil")


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"open_q": {"f1_roll": np.nan}}, "angle of joint 'f1_roll' is nan; expected a finite"),
        ({"grasp_q": {"f1_roll": "far"}}, "angle of joint 'f1_roll' is 'far'; expected a finite"),
        ({"open_q": "far"}, "open_q is 'far'; expected 15 finite numbers"),
        ({"grasp_centre": "here"}, "grasp_centre is 'here'; expected 3 finite numbers"),
        ({"object_mass": "1 kg"}, "object_mass is '1 kg'; expected a finite number above 0"),
    ],
)
def test_numbers_that_are_none(given: dict[str, object], said: str) -> None:
    with pytest.raises(InvalidInput, match=said):
        Scene.build("dex5", "cube", **given)  # type: ignore[arg-type]


@pytest.mark.parametrize("size", [-1, 0, np.nan])
def test_a_size_to_search_a_grasp_for(size: float) -> None:
    with pytest.raises(InvalidInput, match="object_size is .*; expected a finite number above 0"):
        Scene.suggest_grasp("dex5", "cube", object_size=size)


def test_what_has_settled_once_is_not_settled_again(
    dex5: HandModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(settling, "_kept", OrderedDict())
    monkeypatch.setattr(settling, "_KEPT", 2)
    counted: list[Scene] = []

    def settled(scene: Scene, thorough: bool) -> SettledGrasp:
        counted.append(scene)
        return before(scene, thorough)

    before = settling._settled
    monkeypatch.setattr(settling, "_settled", settled)
    first = Scene.build(dex5, "cube").settled
    assert Scene.build(dex5, "cube").settled is first and len(counted) == 1
    assert not any(getattr(first, name).flags.writeable for name in first._fields[:-1])
    # whatever it depends on makes it another
    scenes = (
        Scene.build(dex5, "cube", friction=0.8),
        Scene.build(dex5, "cube", object_mass=0.11),
        Scene.build(dex5, "cube", grip=1.9),
        Scene.build(dex5, "cube", "down"),
    )
    assert all(scene.settled is not first for scene in scenes) and len(counted) == 5
    assert len(settling._kept) == 2
    # forgotten, and found again to the bit
    again = Scene.build(dex5, "cube").settled
    assert again is not first and len(counted) == 6
    for a, b in zip(again, first, strict=True):
        assert np.array_equal(a, b)
