"""A hand that dexctl does not ship: the Allegro from a folder of the MuJoCo menagerie."""

from __future__ import annotations

import sys
from pathlib import Path

import dexctl
from dexctl.sim import BatchSimulator, Scene, run


def main(folder: str, seconds: float = 5.0) -> None:
    hand = dexctl.HandModel.from_mjcf(
        Path(folder) / "wonik_allegro" / "right_hand.xml",
        # which bodies are fingertips, and where the tip is in each body's frame [m]
        fingertips={
            "ff_tip": (0, 0, 0.0267),
            "mf_tip": (0, 0, 0.0267),
            "rf_tip": (0, 0, 0.0267),
            "th_tip": (0, 0, 0.0423),
        },
    )
    print(f"{hand.n_fingers} fingers, {hand.nq} joints: {', '.join(hand.joint_names)}")
    # where it holds what, and from which posture; dexctl.hands.load("wonik_allegro") knows
    opened = {f"{finger}j{k}": 0.6 for finger in ("ff", "mf", "rf") for k in (1, 2, 3)}
    opened |= {"thj0": 1.3, "thj1": 0.2, "thj2": 0.35, "thj3": 0.35}
    place = (0.015, -0.018, 0.09)
    scene = Scene.build(hand, "sphere", grasp_centre=place, object_size=0.07, open_q=opened)
    controller, sim = dexctl.InGraspManipulation(hand), BatchSimulator(scene)
    sim.reset(seed=0)
    trace = run(controller, sim, seconds)
    print(f"turned a sphere by {trace.final_rotation:.2f} rad, held it for {trace.time_held:.1f} s")


if __name__ == "__main__":
    main(sys.argv[1], *map(float, sys.argv[2:]))
