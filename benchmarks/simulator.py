"""`BatchSimulator`, with tactile sensing and state read-out, against bare `mujoco.rollout`.

Both sides simulate the same control steps from the same states: held cubes whose set-points
wander. One side writes set-points, steps and reads; the other does nothing but call a `Rollout`
with arrays allocated and filled beforehand. A third has a model of its own for every hand, with the
same numbers in it: what randomisation costs beside what it draws.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from measuring.results import Figure, write
from measuring.settings import Settings, progress, settings
from measuring.timing import THREADS, ratio, timed
from measuring.trials import controls
from mujoco.rollout import Rollout

from dexctl.sim import BatchSimulator, Scene, SimulatorState


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    environments: int = 128
    """Hands simulated together."""
    steps: int = 40
    """Control steps of a round."""
    rounds: int = 21
    """Rounds of each side, taken in turns."""


def bare(model: mujoco.MjModel, start: np.ndarray, steps: list[np.ndarray]) -> Callable[[], Any]:
    """The control steps ``steps``, ``(N, substeps, nu)`` each, from ``start``."""
    pool = Rollout(nthread=THREADS)
    data = [mujoco.MjData(model) for _ in range(THREADS)]
    count, substeps, _ = steps[0].shape
    state = np.zeros((count, substeps, start.shape[1]))
    sensordata = np.zeros((count, substeps, model.nsensordata))
    models = [model] * count

    def simulate() -> None:
        now = start
        for control in steps:
            pool.rollout(
                models,
                data,
                initial_state=now,
                control=control,
                skip_checks=True,
                nstep=substeps,
                state=state,
                sensordata=sensordata,
            )
            now = state[:, -1].copy()

    return simulate


def main() -> None:
    given = settings(Options, __doc__)
    scene = Scene.build("dex5", "cube")
    untouched = scene.spec
    untouched.compiler.discardvisual = True
    for sensor in list(untouched.sensors):
        untouched.delete(sensor)
    rng = np.random.default_rng(given.seed)
    with ExitStack() as stack:
        sim = stack.enter_context(
            BatchSimulator(scene, given.environments, threads=THREADS, seed=given.seed)
        )
        for _ in range(20):  # the disturbed grasps come to rest
            sim.step()
        start = sim.save()
        wander = rng.normal(0, 0.003, (given.steps, *start["q_target"].shape)).cumsum(axis=0)
        targets, held = [], []
        for change in wander:
            targets.append(sim.write(start["q_target"] + change))
            held.append(controls(scene, targets[-1], sim.substeps))

        def ours(simulator: BatchSimulator) -> None:
            for target in targets:
                simulator.write(target)
                simulator.step()
                simulator.read()

        each = given.environments
        own = stack.enter_context(BatchSimulator(scene, each, threads=THREADS, seed=given.seed))
        own.set_parameters(
            friction=np.full(each, scene.friction()),
            object_mass=np.full(each, scene.object_mass),
            kp=np.tile(scene.stiffness, (each, 1)),
        )
        start_of_own: SimulatorState = {**start, "parameters": own.save()["parameters"]}
        sides = {
            "simulator": lambda: ours(sim),
            "own_models": lambda: ours(own),
            "bare_rollout": bare(scene.model, start["physics"], held),
            "bare_rollout_without_sensors": bare(untouched.compile(), start["physics"], held),
        }
        rows = []
        for i in range(given.rounds + 1):
            order = list(sides) if i % 2 == 0 else list(sides)[::-1]
            row = {}
            for name in order:
                sim.restore(start)
                own.restore(start_of_own)
                row[name] = timed(sides[name])
            if i:  # the first round warms up
                rows.append([row[name] for name in sides])
            progress(f"round {i} of {given.rounds}")
    seconds = dict(zip(sides, np.array(rows).T, strict=True))
    drawn = ratio(seconds["simulator"][:, None], seconds["own_models"][:, None])
    speed = ratio(seconds["bare_rollout"][:, None], seconds["simulator"][:, None])
    physics_steps = given.environments * given.steps * 10
    rate = {name: round(physics_steps / float(np.median(t))) for name, t in seconds.items()}
    write(
        "simulator",
        given,
        [
            Figure(
                f"speed of `BatchSimulator` with tactile sensing and read-out, "
                f"{given.environments} hands, {THREADS} threads, against bare `mujoco.rollout`",
                f"{100 * speed['median']:.0f} % ({rate['simulator'] / 1000:.0f} k steps/s)",
                "at least 85 %",
                speed["median"] >= 0.85,
            ),
            Figure(
                "speed with a model for every hand, as randomisation has them, against one model "
                "for all",
                f"{100 * drawn['median']:.0f} %",
                "no cost",
                drawn["median"] >= 0.97,
            ),
        ],
        speed_with_own_models=drawn,
        physics_steps_per_second=rate,
        speed_against_bare_rollout=speed,
        speed_against_bare_rollout_without_sensors=ratio(
            seconds["bare_rollout_without_sensors"][:, None], seconds["simulator"][:, None]
        ),
        threads=THREADS,
    )


if __name__ == "__main__":
    main()
