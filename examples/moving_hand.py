"""For robot programmers: a hand on an arm; the controller sees everything in the hand's frame."""

from __future__ import annotations

import sys

import numpy as np

import dexctl
from dexctl.sim import BatchSimulator, Scene


def main(seconds: float = 6.0) -> None:
    hand = dexctl.hands.load("dex5")
    controller = dexctl.InGraspManipulation(hand, twist=(0, 0, 0, 0, 0, 0.2))  # of the hand's z
    plant = BatchSimulator(Scene.build(hand, "cube", moving_base=True))
    controller.reset(seed=0)
    plant.reset(seed=0)

    for step in range(round(seconds / plant.control_period)):
        state = plant.read()  # from trackers in the world: state.in_frame(*pose_of_the_hand)
        plant.write(state.q_target + controller.act(state))
        half = 0.25 * (step + 1) * plant.control_period  # 0.5 rad/s about the world's x
        plant.move_base((0.0, 0.0, 0.0), (np.cos(half), np.sin(half), 0.0, 0.0))
        plant.step()
        if step % 20 == 0:
            down = np.asarray(state.gravity).round(1)
            print(f"gravity in the hand's frame {down} m/s^2, ", end="")
            print(f"object at {state.object_centre().round(3)} m in the hand")


if __name__ == "__main__":
    main(*map(float, sys.argv[1:]))
