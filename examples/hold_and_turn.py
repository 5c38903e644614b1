"""For robot programmers: a controller in a control loop of your own."""

from __future__ import annotations

import sys

import dexctl
from dexctl.sim import BatchSimulator, Scene


def main(seconds: float = 5.0) -> None:
    hand = dexctl.hands.load("dex5")
    controller = dexctl.InGraspManipulation(hand, twist=(0, 0, 0, 0, 0, 0.3))  # 0.3 rad/s about z

    # The simulated hand; a real one looks the same from here (`dexctl.Plant`).
    plant = BatchSimulator(Scene.build(hand, "cylinder", gravity="down"))
    controller.reset(seed=0)
    plant.reset(seed=0)

    for step in range(round(seconds / plant.control_period)):
        state = plant.read()
        change = controller.act(state)  # (15,) rad, for one control period of 0.05 s
        plant.write(state.q_target + change)
        plant.step()
        if step % 20 == 0:
            touching = int(state.in_contact.sum())
            residual = float(controller.diagnostics["residual"])
            print(f"{float(state.time):4.1f} s  {touching} fingers touch, residual {residual:.3f}")


if __name__ == "__main__":
    main(*map(float, sys.argv[1:]))
