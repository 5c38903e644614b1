"""Trees without physics: contacts stay where they are, links are clear, and MuJoCo agrees."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexctl.exceptions import InvalidInput
from dexctl.planning import Kinematic, Stability, Tree, grow, holding, link_clearance
from dexctl.planning.contacts import ContactModel, Reached
from dexctl.planning.kinematic import projected
from dexctl.rotations import inverse, rotate
from dexctl.sim import Scene, Shape
from dexctl.sim.hand_geometry import HandGeometry


@pytest.fixture(scope="module")
def l_shape() -> Scene:
    return Scene.build("dex5", "l_shape", "up")


@pytest.fixture(scope="module")
def tree(l_shape: Scene) -> Tree:
    return grow(l_shape, Kinematic(batch=64), nodes=400, seed=0)


def in_object(tree: Tree, scene: Scene) -> np.ndarray:
    """The fingertips' balls in the object's frame, ``(N, m, 3)``."""
    nodes, geometry = tree.nodes, HandGeometry(scene)
    tip = geometry.poses(nodes.q).centres(geometry.tips)
    turn = inverse(nodes.object_quaternion)[:, None]
    return rotate(np.broadcast_to(turn, (*tip.shape[:2], 4)), tip - nodes.object_position[:, None])


def test_fingertips_touch_and_stay_where_they_touch(l_shape: Scene, tree: Tree) -> None:
    balls, touch = in_object(tree, l_shape), tree.nodes.in_contact
    gap = Shape.of_body(l_shape.model).distance(balls) - 0.014
    assert (touch.sum(axis=1) >= 3).all()
    assert np.abs(gap[touch]).max() < 0.002  # those of the root are pressed in by its grip
    assert gap[~touch].min(initial=1.0) > 0.005
    finger = tree.action[1:, tree.header.action_names.index("finger")].astype(int)
    parent = tree.parent[1:]
    still = np.arange(touch.shape[1]) != finger[:, None]
    np.testing.assert_array_equal(touch[1:][still], touch[parent][still])
    both = still & touch[1:]
    moved = np.linalg.norm(balls[1:] - balls[parent], axis=-1)
    assert moved[both].max() < 1.5e-3
    assert {-1, 0, 1, 2, 3, 4} == set(finger.tolist())


def test_landings_are_on_the_surface(l_shape: Scene, tree: Tree) -> None:
    names = tree.header.action_names
    action = dict(zip(names, tree.action[1:].T, strict=True))
    switched = action["finger"] >= 0
    landing = np.stack([action[f"landing_{one}"] for one in "xyz"], axis=-1)
    assert np.isnan(landing[~switched]).all()
    distance = Shape.of_body(l_shape.model).distance(landing[switched])
    np.testing.assert_allclose(distance, 0.0, atol=1e-9)


def test_mujoco_sees_only_fingertips_on_the_object(l_shape: Scene, tree: Tree) -> None:
    model, data = l_shape.model, mujoco.MjData(l_shape.model)
    tips = {model.body(name).id for name in l_shape.hand.fingertip_bodies}
    for i in range(1, len(tree), 7):
        data.qpos[l_shape.qpos_columns] = tree.nodes.q[i]
        data.qpos[l_shape.object_qpos] = np.concatenate(
            [tree.nodes.object_position[i], tree.nodes.object_quaternion[i]]
        )
        mujoco.mj_forward(model, data)
        for contact in data.contact[: data.ncon]:
            bodies = {int(model.geom_bodyid[geom]) for geom in contact.geom}
            assert model.body("object").id in bodies
            assert bodies & tips


def test_nearly_all_hold_in_simulation(l_shape: Scene, tree: Tree) -> None:
    rows = np.arange(1, len(tree), 4)
    held = holding(l_shape, tree, rows, threads=1, batch=64)
    assert held.shape == rows.shape and held.mean() > 0.9
    # the batches are each node's own check
    one = holding(l_shape, tree, rows[:3], threads=1, batch=2)
    np.testing.assert_array_equal(one, held[:3])
    with pytest.raises(InvalidInput, match="the scene is Scene"):
        holding(Scene.build("dex5", "cube", "up"), tree)


def test_links_keep_off_the_object_by_the_margin(l_shape: Scene, tree: Tree) -> None:
    nodes = tree.nodes.take(np.arange(1, 200))
    pose = nodes.object_position, nodes.object_quaternion
    found = link_clearance(l_shape, nodes.q, *pose)
    assert found.links.min() >= Kinematic().margin and found.fingers.min() >= Kinematic().margin
    assert np.abs(found.fingertips[nodes.in_contact]).max() < 1e-3
    assert (found.fingertips[~nodes.in_contact] >= Kinematic().margin).all()
    one = link_clearance(l_shape, nodes.q[3], pose[0][3], pose[1][3])
    assert one.links.shape == () and one.fingertips.shape == (5,)
    for a, b in zip(one, found, strict=True):
        np.testing.assert_allclose(a, b[3], atol=1e-12)
    # the quick test agrees at any margin
    model = ContactModel(l_shape, 0.5, float(np.median(found.links)))
    poses = model.geometry.poses(nodes.q)
    there = Reached(nodes.q, poses, poses.centres(model.geometry.tips), np.ones(199, bool))
    enough = (found.links > model.margin) & (found.fingers > model.margin)
    enough &= ((found.fingertips > model.margin) | nodes.in_contact).all(axis=1)
    np.testing.assert_array_equal(model.clear(there, nodes.in_contact, *pose), enough)
    assert 0 < enough.sum() < 199
    with pytest.raises(
        InvalidInput, match=r"object_position has shape \(3,\); expected \(199, 3\)"
    ):
        link_clearance(l_shape, nodes.q, np.zeros(3), pose[1])


def test_whether_they_hold_goes_by_the_trees_own_check(l_shape: Scene) -> None:
    """It went by the default one: with a hand whose links touch, nothing of a tree was left."""
    from dexctl.planning import path_states

    strict = Stability(max_distance=1e-7)
    tree = grow(l_shape, Kinematic(batch=64), nodes=60, seed=1, stability=strict)
    assert not holding(l_shape, tree, [1, 2, 3], threads=1, batch=4)[1:].any()
    assert holding(l_shape, tree, [1, 2, 3], stability=Stability(), threads=1, batch=4).any()
    with pytest.raises(InvalidInput, match="none of .* holds"):
        path_states(tree, 10, scene=l_shape, threads=1)


def test_without_fingers_that_move_it_only_turns_as_far_as_they_reach(l_shape: Scene) -> None:
    tree = grow(l_shape, Kinematic(batch=64, switch=0.0), seconds=1.5, seed=0)
    assert 0.3 < tree.rotation.max() < 2.5
    assert (tree.nodes.in_contact == tree.nodes.in_contact[0]).all()


def test_a_finger_that_is_moved_turns_it_further(l_shape: Scene) -> None:
    tree = grow(l_shape, Kinematic(), nodes=3000, until_rotation=3.0, seed=1)
    assert tree.rotation.max() > 2.5
    assert tree.header.physics_steps == 0


def test_a_batch_may_be_refused_as_a_whole(l_shape: Scene) -> None:
    tree = grow(l_shape, Kinematic(batch=1), nodes=10, seed=0)
    assert len(tree) == 10 and tree.header.expansions > 12


def test_a_root_that_nothing_leads_away_from_is_given_up(tmp_path: Path) -> None:
    stone, path = Scene.build("dex5", "dodecahedron", "up"), tmp_path / "tree.npz"
    why = "no grasp of the dodecahedron was reached .* in 3072 expansions, refused most for closure"
    with pytest.raises(InvalidInput, match=why):
        grow(stone, Kinematic(), nodes=600, seed=0, path=path)
    assert len(Tree.load(path)) == 1


@pytest.mark.slow
def test_about_x_more_may_be_left_to_friction() -> None:
    cube = Scene.build("dex5", "cube", "up")
    default, same, strict = (
        grow(cube, Kinematic(batch=64, residual_limit=limit), nodes=400, axis="x", seed=0)
        for limit in (None, 2.0, 0.3)
    )
    np.testing.assert_array_equal(default.rotation, same.rotation)
    assert default.header.refused.get("residual", 0) < strict.header.refused["residual"]
    assert holding(cube, default, threads=1).mean() > 0.95


@given(st.integers(0, 2**32 - 1), st.integers(1, 6))
def test_the_projection_keeps_what_the_constraints_let_pass(seed: int, rows: int) -> None:
    rng = np.random.default_rng(seed)
    constraint, wanted = rng.normal(size=(2, rows, 9)), rng.normal(size=(2, 9))
    kept = projected(constraint, wanted)
    np.testing.assert_allclose((constraint @ kept[..., None])[..., 0], 0.0, atol=1e-5)
    np.testing.assert_allclose(projected(constraint, kept), kept, atol=1e-5)
    pinv = np.linalg.pinv(constraint)
    plain = wanted - (pinv @ constraint @ wanted[..., None])[..., 0]
    np.testing.assert_allclose(kept, plain, atol=1e-5)
    np.testing.assert_allclose(projected(0 * constraint, wanted), wanted)


def test_bad_settings() -> None:
    settings: dict
    for settings, why in (
        ({"step": 0.0}, "step is 0.0"), ({"switch": 1.5}, "switch is 1.5"),
        ({"batch": 0}, "batch is 0"), ({"margin": -0.1}, "margin is -0.1"),
    ):  # fmt: skip
        with pytest.raises(InvalidInput, match=why):
            Kinematic(**settings)
    assert Stability.thesis().seconds == 2.0
