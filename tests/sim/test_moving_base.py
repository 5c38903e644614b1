"""A hand that is carried: what it holds stays in it, and controllers see it in the hand's frame."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import dexctl
from dexctl import HandModel
from dexctl.exceptions import InvalidInput, SimulationError
from dexctl.hand_config import PalmConfig
from dexctl.sim import BatchSimulator, Scene
from dexctl.sim.moving_base import BaseMotion

PERIOD = 0.05
ROWS = ("contact_position", "contact_normal", "object_position", "object_quaternion")


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene.build("dex5", "cube", moving_base=True)


def swing(angle: float) -> tuple[np.ndarray, np.ndarray]:
    """The hand turned by ``angle`` about the world's x, on an arm 0.1 m long."""
    turn = Rotation.from_rotvec([angle, 0.0, 0.0])
    return turn.apply([0.0, 0.0, 0.1]) - (0.0, 0.0, 0.1), turn.as_quat(scalar_first=True)


def gravity(sim: BatchSimulator) -> np.ndarray:
    found = sim.read().gravity
    assert found is not None
    return found


def distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angle between orientations [rad]."""
    first, second = (Rotation.from_quat(q, scalar_first=True) for q in (a, b))
    return (first * second.inv()).magnitude()


@pytest.mark.parametrize("name", ["in-grasp", "gait"])
def test_a_held_object_is_turned_while_the_hand_is_turned_over(scene: Scene, name: str) -> None:
    """0.5 rad/s about a horizontal axis, from palm up to palm down, in 6.3 s."""
    hand = scene.hand
    controller = (
        dexctl.InGraspManipulation(hand, twist=(0, 0, 0, 0, 0, 0.2))
        if name == "in-grasp"
        else dexctl.gait.CoordinatedGait(hand)
    )
    sim = BatchSimulator(scene, 2, seed=0)
    controller.reset(seed=0)
    turned = np.zeros(2)
    for step in range(round(np.pi / 0.5 / PERIOD)):
        state = sim.read()  # in the hand's frame
        sim.write(state.q_target + controller.act(state))
        place, turn = swing(0.5 * (step + 1) * PERIOD)
        sim.move_base(np.tile(place, (2, 1)), np.tile(turn, (2, 1)))
        sim.step()
        turned += sim.object_angular_velocity[:, 2] * PERIOD
        at, oriented = sim.base_pose
        assert np.abs(at - place).max() < 2e-3
        assert distance(oriented, np.tile(turn, (2, 1))).max() < 0.015
    position = sim.read().object_position
    assert position is not None
    assert not sim.diverged.any()
    assert (np.linalg.norm(position - sim.start_position, axis=1) < 0.02).all()
    assert (turned > 0.4).all()  # 1.0 and 0.8 rad
    np.testing.assert_allclose(gravity(sim), [[0, 0, 9.81]] * 2, atol=0.4)  # palm down


def test_the_state_is_that_of_the_world_in_the_hands_frame(scene: Scene) -> None:
    sim = BatchSimulator(scene, 3, seed=0)
    place, turn = swing(0.8)
    for share in np.linspace(0, 1, 20):
        sim.move_base(*(np.tile(value, (3, 1)) for value in swing(0.8 * share)))
        sim.step()
    for _ in range(10):
        sim.step()
    np.testing.assert_allclose(sim.base_pose[0], np.tile(place, (3, 1)), atol=1e-4)
    seen, world = sim.read(), sim.read(in_world=True)
    moved = world.in_frame(*sim.base_pose)
    for name in ROWS:
        np.testing.assert_array_equal(getattr(seen, name), getattr(moved, name))
    # the object went along: at its place in the hand, and turned with it in the world
    assert seen.object_position is not None and world.object_position is not None
    np.testing.assert_allclose(seen.object_position, sim.start_position, atol=0.01)
    assert np.linalg.norm(world.object_position - sim.start_position, axis=1).min() > 0.05
    # contacts are at the fingertips that kinematics says
    tips = scene.hand.fingertip_positions(seen.q)
    away = np.linalg.norm(seen.contact_position - tips, axis=-1)[seen.in_contact]
    assert (np.abs(away - 0.014) < 0.003).all()
    down = Rotation.from_quat(turn, scalar_first=True).inv().apply([0, 0, -9.81])
    np.testing.assert_allclose(gravity(sim), np.tile(down, (3, 1)), atol=1e-3)


def test_a_base_at_rest_is_a_fixed_base(scene: Scene) -> None:
    moving, fixed = BatchSimulator(scene), BatchSimulator(Scene.build("dex5", "cube"))
    for sim in (moving, fixed):
        sim.reset(seed=1)
        for _ in range(20):
            sim.step()
    np.testing.assert_allclose(moving.base_pose[0], 0.0, atol=1e-4)
    np.testing.assert_allclose(moving.read().q, fixed.read().q, atol=5e-3)
    np.testing.assert_allclose(
        moving.read().object_centre(), fixed.read().object_centre(), atol=2e-3
    )


def test_replays_and_rows_keep_the_base(scene: Scene) -> None:
    sim = BatchSimulator(scene, 2, seed=0)
    poses = [np.tile(value, (2, 1)) for value in swing(0.3)]
    sim.move_base(*poses)
    sim.step()
    saved = sim.save()
    sim.step()
    first = sim.read(in_world=True)
    sim.restore(saved)
    sim.step()
    for name in ROWS:
        np.testing.assert_array_equal(getattr(sim.read(in_world=True), name), getattr(first, name))
    rows, before = sim.rows(), sim.base_pose
    sim.reset()
    np.testing.assert_allclose(sim.base_pose[0], 0.0, atol=1e-3)
    sim.place(rows)
    np.testing.assert_allclose(np.hstack(sim.base_pose), np.hstack(before))
    sim.step()  # and it stays there
    np.testing.assert_allclose(sim.base_pose[1], before[1], atol=5e-3)


def test_what_cannot_be_moved_says_so(changed_dex5: Callable[..., HandModel], scene: Scene) -> None:
    fixed = BatchSimulator(Scene.build("dex5", "cube"))
    with pytest.raises(SimulationError, match="moving_base=True"):
        fixed.move_base((0, 0, 0), (1, 0, 0, 0))
    np.testing.assert_array_equal(fixed.read().gravity, [0, 0, -9.81])
    with pytest.raises(InvalidInput, match="quaternion"):
        BatchSimulator(scene).move_base((0, 0, 0), (1, 1, 0, 0))
    palm = '<body name="palm" childclass="dex5">'
    wrist = changed_dex5((palm, palm + '<joint name="wrist" axis="0 0 1" range="-1 1"/>'))
    with pytest.raises(SimulationError, match=r"hang on palm; .* put a <body> around the hand"):
        Scene.build(wrist, moving_base=True)


def test_a_turned_hand_that_its_file_carries_begins_at_rest(
    changed_dex5: Callable[..., HandModel],
) -> None:
    """A root body that a mocap pose would move, in a file whose palm looks along y."""
    palm = '<body name="palm" childclass="dex5"'
    hand = changed_dex5(
        (palm, palm + ' mocap="true" pos="0.1 0.2 0" euler="0.3 0 0"'),
        palm=PalmConfig(axis=(0.0, 1.0, 0.0), up=(1.0, 0.0, 0.0)),
    )
    scene = Scene.build(hand, moving_base=True, grasp_centre=(0.1, 0.0, 0.3))
    model = scene.model
    physics = np.concatenate([[0.0], model.qpos0, np.zeros(model.nv)])
    base = BaseMotion(model, 1, 0)
    np.testing.assert_allclose(base.pose(physics), [0, 0, 0, 1, 0, 0, 0], atol=1e-12)


def test_on_the_way_the_base_moves_evenly() -> None:
    start = np.array([[0.0, 0, 0, 1, 0, 0, 0]])
    angle = 0.2
    end = np.array([[1.0, 0, 0, -np.cos(angle / 2), -np.sin(angle / 2), 0, 0]])  # the same turn
    poses = BaseMotion.between(start, end, 4)
    assert poses.shape == (1, 4, 7)
    np.testing.assert_allclose(poses[0, :, 0], [0.25, 0.5, 0.75, 1.0])
    angles = 2 * np.arctan2(poses[0, :, 4], poses[0, :, 3])
    np.testing.assert_allclose(angles, [0.05, 0.1, 0.15, 0.2], atol=1e-4)
