"""For labs: a plant of your own. What a hand's driver has to offer, and its limits."""

from __future__ import annotations

import numpy as np

import dexctl


class LazyServos:
    """Servos that go halfway to their set-points in each period, and refuse to leap."""

    def __init__(self, hand: dexctl.HandModel, max_step: float = 0.05) -> None:
        self.hand, self.control_period, self.max_step = hand, 0.05, max_step
        self.q = self.q_target = hand.clip(np.zeros(hand.nq))

    def read(self) -> dexctl.GraspState:
        touch, vectors = np.zeros(self.hand.n_fingers), np.zeros((self.hand.n_fingers, 3))
        return dexctl.GraspState(
            q=self.q, q_target=self.q_target, in_contact=touch > 0, contact_force=touch,
            contact_position=vectors, contact_normal=vectors)  # fmt: skip

    def write(self, q_target: np.ndarray) -> np.ndarray:
        leap = self.hand.clip(q_target) - self.q
        self.q_target = self.q + np.clip(leap, -self.max_step, self.max_step)
        return self.q_target  # what was really sent

    def step(self) -> None:
        self.q = self.q + 0.5 * (self.q_target - self.q)


if __name__ == "__main__":
    plant: dexctl.Plant = LazyServos(dexctl.hands.load("dex5"))
    print(f"asked for 1 rad, sent {plant.write(np.ones(plant.hand.nq)).max():.2f} rad")
    controller = dexctl.InGraspManipulation(plant.hand)  # nothing is touched: fingers close in
    for _ in range(20):
        plant.write(plant.read().q_target + controller.act(plant.read()))
        plant.step()
    print("after a second of closing in:", plant.read().q[:3].round(2), "rad (finger 1)")
