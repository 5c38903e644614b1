"""The coordinated gait for 128 hands against the physics of the same control steps.

In closed loop, at each control step: the controller's time, the time of a bare `mujoco.rollout`
from the very state with the very set-points, and the simulator's own step with its read-out. All
three meet the same load and the same contacts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import mujoco
import numpy as np
from measuring.results import Figure, write
from measuring.settings import Settings, progress, settings
from measuring.timing import ENGINES, THREADS, engines, spread, timed
from measuring.trials import controls
from mujoco.rollout import Rollout

from dexctl import controllers
from dexctl.controller import Controller
from dexctl.gait import CoordinatedGaitConfig
from dexctl.sim import BatchSimulator, Scene

# name: title and goal
CONTROLLERS = {
    "coordinated": ("coordinated gait", 0.3),
    "igm": ("in-grasp manipulation", None),
}


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    environments: int = 128
    """Hands controlled together."""
    steps: int = 400
    """Control steps."""
    warm_up: int = 20
    """Control steps before, not counted."""


def make(name: str, engine: str, scene: Scene) -> Controller:
    """The controller by name, with an engine."""
    if name == "igm":
        return controllers.make(name, scene.hand, engine=engine)
    in_grasp = replace(CoordinatedGaitConfig().in_grasp, engine=engine)
    return controllers.make(name, scene.hand, in_grasp=in_grasp)


def closed_loop(controller: Controller, scene: Scene, given: Options) -> dict[str, np.ndarray]:
    """Seconds per control step ``(steps,)`` of the controller, the physics and the simulator."""
    model, count = scene.model, given.environments
    data = [mujoco.MjData(model) for _ in range(THREADS)]
    models = [model] * count
    rows = []
    with (
        BatchSimulator(scene, count, threads=THREADS) as sim,
        Rollout(nthread=THREADS) as pool,
    ):
        sim.reset(given.seed)
        controller.reset(given.seed)
        states = np.zeros((count, sim.substeps, sim.save()["physics"].shape[1]))
        sensordata = np.zeros((count, sim.substeps, model.nsensordata))
        state = sim.read()
        change = np.zeros_like(state.q_target)

        def act() -> None:
            change[:] = controller.act(state)

        def step() -> None:
            nonlocal state
            sim.step()
            state = sim.read()

        for i in range(given.warm_up + given.steps):
            acting = timed(act)
            control = controls(scene, sim.write(state.q_target + change), sim.substeps)
            now = sim.save()["physics"]

            def physics(start: np.ndarray = now, control: np.ndarray = control) -> None:
                pool.rollout(
                    models,
                    data,
                    initial_state=start,
                    control=control,
                    skip_checks=True,
                    nstep=sim.substeps,
                    state=states,
                    sensordata=sensordata,
                )

            # first one, then the other: who comes second finds the caches warm
            if i % 2:
                bare, stepping = timed(physics), timed(step)
            else:
                stepping, bare = timed(step), timed(physics)
            rows.append((acting, bare, stepping))
    return dict(
        zip(
            ("controller", "physics", "step_and_read"),
            np.array(rows[given.warm_up :]).T,
            strict=True,
        )
    )


def main() -> None:
    given = settings(Options, __doc__)
    scene = Scene.build("dex5", "cube")
    numbers: dict[str, Any] = {}
    figures = []
    for (name, (title, goal)), engine in product(CONTROLLERS.items(), engines()):
        progress(f"{title}, {ENGINES[engine]}")
        seconds = closed_loop(make(name, engine, scene), scene, given)
        total = {part: float(value.sum()) for part, value in seconds.items()}
        against = total["controller"] / total["physics"]
        numbers[f"{name}_{engine}"] = {
            "per_control_step": {part: spread(value) for part, value in seconds.items()},
            "controller_over_physics": round(against, 4),
            "controller_over_step_and_read": round(total["controller"] / total["step_and_read"], 4),
        }
        each = 1e3 * float(np.median(seconds["controller"]))
        figures.append(
            Figure(
                f"{title} for {given.environments} hands, against the physics of the same control "
                f"steps on {THREADS} threads, {ENGINES[engine]}",
                f"{100 * against:.0f} % ({each:.1f} ms a step)",
                "at most 30 %" if goal else "",
                against <= goal if goal else None,
            )
        )
    write("gait_batch", given, figures, threads=THREADS, controllers=numbers)


if __name__ == "__main__":
    main()
