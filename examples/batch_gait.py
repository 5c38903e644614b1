"""For learning researchers: 64 hands gait at once, and each tells its own result."""

from __future__ import annotations

import sys

import numpy as np

import dexctl
from dexctl.gait import CoordinatedGait
from dexctl.sim import BatchSimulator, Scene, run


def main(num_envs: int = 64, seconds: float = 10.0) -> None:
    hand = dexctl.hands.load("dex5")
    gait = CoordinatedGait(hand)
    sim = BatchSimulator(Scene.build(hand, "cylinder"), num_envs)

    # Environment i has seed 7 + i in simulator and controller, and behaves as it would alone.
    sim.reset(seed=7)
    gait.reset(seed=7)
    trace = run(gait, sim, seconds)  # arrays of (steps + 1, num_envs, ...)

    print(f"turned by {np.median(trace.final_rotation):.2f} rad (median)")
    print(f"still holding: {np.mean(~trace.dropped):.0%}")
    best = int(trace.final_rotation.argmax())
    print(
        f"the best is {best}: {trace.final_rotation[best]:.2f} rad, {trace.time_held[best]:.1f} s"
    )


if __name__ == "__main__":
    if len(sys.argv) == 3:
        main(int(sys.argv[1]), float(sys.argv[2]))
    else:
        main()
