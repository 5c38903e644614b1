"""What `rotate`, `demo` and `check-grasp` share: one object, and trials of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np

from dexctl import controllers
from dexctl.cli.output import notes
from dexctl.exceptions import InvalidInput, MissingExtra, SimulationError
from dexctl.settings import to_plain
from dexctl.validation import unit_axis

if TYPE_CHECKING:
    from dexctl.controller import Controller
    from dexctl.hand import HandModel
    from dexctl.sim import Scene, SceneConfig, Simulation, Trace


def simulation(
    config: SceneConfig, num_envs: int, seed: int, hand: HandModel | None = None
) -> Simulation:
    """The hand with its one object, and the grasp settled.

    Raises:
        UnknownName, InvalidInput: an option is wrong.
        SettleFailure: the hand cannot hold the object.
    """
    if len(config.object) != 1:
        raise InvalidInput(f"--object is {' '.join(config.object)}; this command takes one object")
    from dexctl.sim import SettleFailure, Simulation

    try:
        found = Simulation(config, num_envs, seed, hand=hand)
    except SettleFailure as failure:
        failure.add_note("`dexctl check-grasp --out DIR` says what was tried, and draws it")
        raise
    for note in scene_of(found).notes:
        notes().print(note, style="dim")
    if found.starts is not None:
        from dexctl.planning.starts import begins_under_another

        if remark := begins_under_another(found):
            notes().print(f"dexctl: {remark}")
    return found


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
        "notes": list(scene.notes),
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
    """What `dexctl.controllers.resolve` finds for ``name``, with its default settings.

    Controllers take the control period of the scene; a policy has the one of its training, which
    is then the scene's: see `paced`.

    Raises:
        UnknownName: no such controller or policy, or axis.
        InvalidInput: a damaged policy, or one for another hand.
        SimulationError: the hand cannot be driven by that controller.
    """
    about = unit_axis(axis)
    known = controllers.is_named(name)
    period = None if controllers.keeps_period(name) else config.control_period
    try:
        made = controllers.resolve(name, hand, control_period=period, axis=about)
    except InvalidInput as error:
        if not known or ":" in name:  # what stands after it is wrong, not the hand
            raise
        raise SimulationError(f"{name} cannot drive {hand.name}: {error}") from error
    from dexctl.sim.checks import gravity_vector

    given = gravity_vector(config.gravity)
    if remark := controllers.made_for_another(name, made, config.object, given):
        notes().print(f"dexctl: {remark}")
    return made


def paced(config: SceneConfig, controller: Controller) -> SceneConfig:
    """The scene at the controller's own pace, with physics steps as long as before.

    Its tracker is as late as the one that a policy has learned by, if it is not later.
    """
    config = replace(config, sensing=config.sensing.aged(controller.pose_age or 0.0))
    period = controller.control_period
    if np.isclose(period, config.control_period):
        return config
    substeps = max(1, round(config.substeps * period / config.control_period))
    return replace(config, control_period=period, substeps=substeps)


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
