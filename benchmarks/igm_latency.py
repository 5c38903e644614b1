"""One in-grasp step for one hand against mink's `solve_ik` with five frame tasks.

Both get a new configuration at every call; the contacts of the in-grasp step change too. The peer
is what mink's examples do in their loop: update the configuration, set the targets, solve. Tasks
and limits are built beforehand, and it gets the faster of the QP solvers that mink brings along.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mink
import mujoco
import numpy as np
from measuring.results import Figure, write
from measuring.settings import Settings, settings
from measuring.timing import ENGINES, engines, in_turns, ratio, spread
from qpsolvers import available_solvers

import dexctl
from dexctl.igm import push_directions, stable_forces


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    count: int = 2000
    """Calls in a round."""
    rounds: int = 7
    """Rounds of each side, taken in turns."""


def states(hand: dexctl.HandModel, count: int, seed: int) -> list[dexctl.GraspState]:
    """Five contacts on a cylinder of radius 0.05 m, other ones each time."""
    rng = np.random.default_rng(seed)
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


def quadratic_program(
    controller: dexctl.InGraspManipulation, samples: list[dexctl.GraspState]
) -> Callable[[int], object]:
    """The stability QP of an in-grasp step by itself."""
    config = controller.config
    cases = []
    for state in samples:
        lever = state.contact_position - np.asarray(state.object_position)
        push = push_directions(state.contact_normal, lever, config.friction)
        cases.append((lever, push, state.in_contact, state.in_contact.astype(float)))
    return lambda i: stable_forces(
        *cases[i],
        min_force=config.min_force,
        regulariser=config.regulariser,
        length=config.length,
    )


def peer(
    hand: dexctl.HandModel, samples: list[dexctl.GraspState], solver: str, limits: str
) -> Callable[[int], object]:
    """The five fingertips moved by mink.

    Joint limits are "built" once beforehand, as in mink's examples, by "default" built by
    `solve_ik` at every call, or there are "none".
    """
    model = mujoco.MjModel.from_xml_path(str(hand.path))
    configuration = mink.Configuration(model)
    tasks = [
        mink.FrameTask(name, "body", position_cost=1.0, orientation_cost=0.0)
        for name in hand.fingertip_bodies
    ]
    choices = {"built": [mink.ConfigurationLimit(model)], "default": None, "none": []}
    chosen = choices[limits]

    def solve(i: int) -> object:
        state = samples[i]
        configuration.update(state.q)
        for task, point in zip(tasks, state.contact_position, strict=True):
            task.set_target(mink.SE3.from_translation(point))
        return mink.solve_ik(configuration, tasks, 0.05, solver, limits=chosen)

    return solve


def figure(engine: str, ours: np.ndarray, theirs: np.ndarray) -> Figure:
    """The line of README for one engine."""
    against, step, other = ratio(ours, theirs)["median"], spread(ours), spread(theirs)
    return Figure(
        "in-grasp step for one hand, five changing contacts, against mink's `solve_ik` with five "
        f"frame tasks, {ENGINES[engine]}",
        f"{against:.2f} (median {step['median_us']:.0f} us, p99 {step['p99_us']:.0f} us; mink "
        f"{other['median_us']:.0f} us, p99 {other['p99_us']:.0f} us)",
        "at most 1/6 = 0.17",
        against <= 1 / 6,
    )


def main() -> None:
    given = settings(Options, __doc__)
    hand = dexctl.hands.load("dex5")
    samples = states(hand, given.count, given.seed)
    controller = {engine: dexctl.InGraspManipulation(hand, engine=engine) for engine in engines()}

    def step(engine: str) -> Callable[[int], object]:
        controller[engine].reset(seed=given.seed)
        return lambda i: controller[engine].act(samples[i])

    candidates = {name: peer(hand, samples, name, "built") for name in available_solvers}
    trial = in_turns(candidates, min(given.count, 200), 1)
    solver = min(candidates, key=lambda name: float(np.median(trial[name])))
    seconds = in_turns(
        {
            **{f"in_grasp_step_{engine}": step(engine) for engine in controller},
            "stability_qp_plain": quadratic_program(controller["plain"], samples),
            "mink_solve_ik": candidates[solver],
            "mink_solve_ik_default_limits": peer(hand, samples, solver, "default"),
            "mink_solve_ik_without_limits": peer(hand, samples, solver, "none"),
        },
        given.count,
        given.rounds,
    )
    peers = [name for name in seconds if name.startswith("mink")]
    ours = {engine: seconds[f"in_grasp_step_{engine}"] for engine in controller}
    write(
        "igm_latency",
        given,
        [figure(engine, ours[engine], seconds["mink_solve_ik"]) for engine in ours],
        timings={name: spread(value) for name, value in seconds.items()},
        ratios={
            engine: {name: ratio(value, seconds[name]) for name in peers}
            for engine, value in ours.items()
        },
        share_of_the_qp_plain=ratio(seconds["stability_qp_plain"], ours["plain"]),
        mink_solver=solver,
    )


if __name__ == "__main__":
    main()
