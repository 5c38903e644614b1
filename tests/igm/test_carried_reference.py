"""References move with the wanted twist, so that regulation does not pull against it."""

from __future__ import annotations

import numpy as np

from dexctl import HandModel, InGraspManipulation
from dexctl.igm import Share
from dexctl.igm.regulation import Reference
from dexctl.rotations import multiply, rotate
from dexctl.sim import BatchSimulator, Scene


def turn(axis: int, angle: float) -> np.ndarray:
    quaternion = np.zeros((1, 4))
    quaternion[0, 0], quaternion[0, 1 + axis] = np.cos(angle / 2), np.sin(angle / 2)
    return quaternion


def test_it_goes_where_the_object_is_wanted() -> None:
    reference = Reference(np.array([0.0, 0.0, 1.0]))
    reference.meet(1)
    start = turn(2, 0.7)
    reference.learn(np.array([[0.0, 0.0, 0.1]]), start)
    for k in range(100):  # an object that follows exactly: 20 mm along x, 0.3 rad about x
        pose = multiply(turn(0, 0.003 * k), start)
        reference.carry(np.array([[2e-4, 0, 0, 0.003, 0, 0]]), pose)
    np.testing.assert_allclose(reference.position, [[0.02, 0.0, 0.1]])
    end = multiply(turn(0, 0.3), start)
    np.testing.assert_allclose(rotate(end, reference.carried_axis), [[0, 0, 1]], atol=2e-3)


def test_a_turn_about_the_axis_moves_nothing() -> None:
    reference = Reference(np.array([0.0, 0.0, 1.0]))
    reference.meet(1)
    reference.learn(np.array([[0.0, 0.0, 0.1]]), turn(0, 0.2))
    before = reference.state_dict()
    reference.carry(np.array([[0, 0, 0, 0, 0, 0.02]]), turn(0, 0.2))
    for name, value in before.items():
        np.testing.assert_allclose(reference.state_dict()[name], value, atol=1e-15)


def test_there_and_back(dex5: HandModel) -> None:
    with BatchSimulator(Scene.build(dex5, "cylinder", "up"), 1, seed=0) as sim:
        controller, state = InGraspManipulation(dex5), sim.read()
        start = there = np.asarray(state.object_position)
        for speed in (0.005, -0.005):
            for _ in range(40):
                share = Share(twist=np.array([[0, 0, speed, 0, 0, 0]]))
                sim.write(state.q_target + controller.command(state, share))
                sim.step()
                state = sim.read()
            if speed > 0:
                there = np.asarray(state.object_position) - start
    assert 0.008 < there[0, 2] < 0.012
    np.testing.assert_allclose(np.asarray(state.object_position), start, atol=2e-3)
