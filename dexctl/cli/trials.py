"""What `rotate`, `demo` and `check-grasp` share: one object, and trials of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from dexctl import controllers
from dexctl.exceptions import InvalidInput, MissingExtra, SimulationError
from dexctl.rotations import unit_axis
from dexctl.settings import to_plain

if TYPE_CHECKING:
    from dexctl.controller import Controller
    from dexctl.hand import HandModel
    from dexctl.sim import Scene, SceneConfig, Simulation, Trace

LEARNED = "learned"
"""The controller that is a policy, which has a control period of its own."""


def simulation(config: SceneConfig, num_envs: int, seed: int) -> Simulation:
    """The hand with its one object, and the grasp settled.

    Raises:
        UnknownName, InvalidInput: an option is wrong.
        SimulationError: the hand cannot hold the object.
    """
    if len(config.object) != 1:
        raise InvalidInput(f"--object is {' '.join(config.object)}; this command takes one object")
    from dexctl.sim import Simulation

    return Simulation(config, num_envs, seed)


def scene_of(sim: Simulation) -> Scene:
    """The scene that is simulated."""
    return sim.sim.groups[0].scene


def describe(config: SceneConfig, scene: Scene) -> dict[str, Any]:
    """For JSON: what is simulated, and the settings that it was asked for with."""
    return {
        "palm": config.palm,
        "hand": config.hand,
        "object": scene.object,
        "gravity_m_s2": scene.gravity.tolist(),
        "object_width_m": scene.object_width,
        "object_mass_kg": scene.object_mass,
        "friction": scene.friction(),
        "control_period_s": config.control_period,
        "scene": to_plain(config),
    }


def check_viz(feature: str) -> None:
    """Raise MissingExtra where plots and pictures cannot be made, before anything is simulated."""
    if find_spec("matplotlib") is None or find_spec("imageio") is None:
        raise MissingExtra(feature, "viz")


def captions(title: str, trace: Trace) -> Callable[[int], str]:
    """The text in a video at control step i of one trial."""

    def caption(i: int) -> str:
        state = "" if trace.held[i] else "   dropped"
        return f"{title}   {trace.time[i]:4.1f} s   {trace.rotation[i]:5.2f} rad{state}"

    return caption


def make_controller(
    name: str, hand: HandModel, config: SceneConfig, axis: str | tuple[float, ...] = "z"
) -> Controller:
    """The controller ``name`` with its default settings.

    A policy has the control period that it was trained with; `dexctl.sim.run` says where that is
    not the simulator's.

    Raises:
        UnknownName: no such controller, or axis.
        SimulationError: the hand cannot be driven by it.
    """
    controllers.entry(name)
    x, y, z = unit_axis(axis)
    try:
        return controllers.make(
            name,
            hand,
            control_period=None if name == LEARNED else config.control_period,
            axis=(float(x), float(y), float(z)),
        )
    except InvalidInput as error:
        raise SimulationError(f"{name} cannot drive {hand.path.stem}: {error}") from error


def run_trials(
    controller: Controller,
    sim: Simulation,
    seconds: float,
    seed: int,
    *,
    axis: str | tuple[float, ...] = "z",
    observers: Sequence[Callable[[Any], None]] = (),
    progress: Callable[[float], None] | None = None,
) -> Trace:
    """The standard protocol: environment i has the seed seed + i.

    Raises:
        SimulationError: the run failed; the arguments were checked before it.
    """
    from dexctl.sim import run

    sim.reset(seed)
    controller.reset(seed)
    try:
        return run(controller, sim, seconds, axis=axis, observers=observers, progress=progress)
    except InvalidInput as error:  # not the user's input any more
        raise SimulationError(f"the run failed: {error}") from error
