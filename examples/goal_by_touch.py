"""For labs without a camera: a cube is laid on its side, tracked by what the fingers feel."""

from __future__ import annotations

import sys

import numpy as np

from dexctl.gait import GoalSequence, TrackedByTouch
from dexctl.rotations import angle_between, multiply
from dexctl.sim import BatchSimulator, Scene, Shape
from learning import load_policy


def main(seconds: float = 10.0) -> None:
    about, across = load_policy("dex5-cube-z-any"), load_policy("dex5-cube-x-any")
    sim = BatchSimulator(scene := Scene.build(about.hand, "cube", "down"), 1)
    state = sim.read()[0]  # where you put the cube in
    place, turn = np.asarray(state.object_position), np.asarray(state.object_quaternion)
    goal = multiply(np.array([0.7071, 0.7071, 0.0, 0.0]), turn)
    controller = TrackedByTouch(
        about.hand,
        GoalSequence(about.hand, about=about, across=across),
        Shape.of_body(scene.model),  # or Shape.of_object("mesh", 0.0, mesh="my_object.stl")
        position=place,
        quaternion=turn,
        goal=goal,
    )
    for _ in range(round(seconds / controller.control_period)):
        state = sim.read()
        sim.write(state.q_target + controller.act(state))  # which does not look at the true pose
        sim.step()
    turn = np.asarray(sim.read().object_quaternion)[0]
    print(f"left to the goal: {angle_between(turn, goal):.2f} rad")
    print(f"by touch: {angle_between(controller.tracking.quaternion[0], goal):.2f} rad")


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else 10.0)
