"""One in-grasp step for one hand against mink's `solve_ik` with five frame tasks.

Both get a new configuration at every call; the contacts of the in-grasp step change too.
"""

from __future__ import annotations

import mink
import mujoco
import numpy as np
from common import spread, timings, write

import dexctl

SEED = 0
COUNT = 3000


def states(hand: dexctl.HandModel, count: int) -> list[dexctl.GraspState]:
    """Five contacts on a cylinder of radius 0.05 m, other ones each time."""
    rng = np.random.default_rng(SEED)
    out = []
    for _ in range(count):
        q = np.tile([0.0, 0.75, -1.5], 5) + rng.normal(0, 0.05, hand.nq)
        tip = hand.fingertip_positions(q)
        centre = np.array([0.0, 0.0, tip[:, 2].mean()]) + rng.normal(0, 0.003, 3)
        inward = centre - tip
        inward[:, 2] = 0
        inward += rng.normal(0, 0.1, inward.shape) * np.linalg.norm(inward, axis=1, keepdims=True)
        normal = inward / np.linalg.norm(inward, axis=1, keepdims=True)
        out.append(
            dexctl.GraspState(
                q=q,
                q_target=q + rng.normal(0, 0.02, hand.nq),
                in_contact=np.ones(5, bool),
                contact_position=tip + 0.014 * normal,
                contact_normal=normal,
                contact_force=rng.uniform(0.5, 3.0, 5),
                object_position=centre,
                object_quaternion=np.array([1.0, 0.0, 0.0, 0.0]),
            )
        )
    return out


def main() -> None:
    hand = dexctl.hands.load("dex5")
    samples = states(hand, COUNT)
    controller = dexctl.InGraspManipulation(hand)
    controller.reset(seed=SEED)

    model = mujoco.MjModel.from_xml_path(str(hand.path))
    configuration = mink.Configuration(model)
    tasks = []
    for name in hand.fingertip_bodies:
        task = mink.FrameTask(name, "body", position_cost=1.0, orientation_cost=0.0)
        tasks.append(task)
    limits = [mink.ConfigurationLimit(model)]

    def peer(i: int) -> None:
        state = samples[i]
        configuration.update(state.q)
        for task, point in zip(tasks, state.contact_position, strict=True):
            task.set_target(mink.SE3.from_translation(point))
        mink.solve_ik(configuration, tasks, 0.05, "daqp", limits=limits)

    # taken in turns, so that both meet the same load of the machine
    ours, theirs = [], []
    for _ in range(3):
        ours.append(timings(lambda i: controller.act(samples[i]), COUNT))
        theirs.append(timings(peer, COUNT))
    ours_us, theirs_us = spread(np.concatenate(ours)), spread(np.concatenate(theirs))
    write(
        "igm_latency",
        {
            "seed": SEED,
            "in_grasp_step": ours_us,
            "mink_solve_ik_five_frame_tasks": theirs_us,
            "ratio_of_medians": ours_us["median_us"] / theirs_us["median_us"],
            "goal": "at most 1/6",
        },
    )


if __name__ == "__main__":
    main()
