"""What `rotate`, `demo` and `check-grasp` share: the scene's options, and running trials on it."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from dataclasses import MISSING, dataclass, fields
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dexctl import controllers, hands
from dexctl.cli.parsing import parse_gravity
from dexctl.exceptions import InvalidInput, MissingExtra, SimulationError, UnknownName

if TYPE_CHECKING:
    from dexctl.controller import Controller
    from dexctl.plant import Plant
    from dexctl.sim import BatchSimulator, Scene, Trace

CONTROL_PERIOD = 0.05  # [s], 10 physics steps


@dataclass(kw_only=True)
class SceneOptions:
    """Which hand holds which object, and how."""

    hand: str = "dex5"
    """Name of the hand (`dexctl hands` lists them)."""
    object: str = "cube"
    """Name of the object; an unknown one gets the list of names."""
    gravity: str = "up"
    """Which way the palm looks: up, down, or gravity as x,y,z in m/s^2."""
    object_size: float | None = None
    """Width of the object [m]; by default what suits the hand."""
    object_mass: float = 0.1
    """Mass of the object [kg]."""
    friction: float = 1.0
    """Sliding friction coefficient between object and hand."""
    mesh: Path | None = None
    """STL or OBJ file, with --object mesh; its convex hull is what collides."""

    @property
    def palm(self) -> str:
        """How the hand is held, for people."""
        return (
            f"palm {self.gravity}" if self.gravity in ("up", "down") else f"gravity {self.gravity}"
        )

    def build_scene(self) -> Scene:
        """The scene, with its grasp settled.

        Raises:
            UnknownName, InvalidInput: an option is wrong.
            SimulationError: the hand cannot hold the object.
        """
        gravity = parse_gravity(self.gravity)
        hands.entry(self.hand)  # names first: they cost nothing
        from dexctl.sim import Scene, object_names

        if self.object not in (*object_names(), "mesh"):
            raise UnknownName("object", self.object, (*object_names(), "mesh"))
        scene = Scene.build(
            self.hand,
            self.object,
            gravity,
            object_size=self.object_size,
            object_mass=self.object_mass,
            friction=self.friction,
            object_mesh=self.mesh,
        )
        scene.settled  # noqa: B018 (found once, and worth finding before anything else)
        return scene

    def set_friction(self, sim: BatchSimulator) -> None:
        """Give the object and the fingertips the friction asked for.

        MuJoCo takes the larger coefficient of two bodies, so the object's alone could only add.
        """
        if self.friction != 1.0:
            sim.set_parameters(friction=self.friction)

    def command_line(self, name: str) -> str:
        """What to type to get the same again."""
        words = ["dexctl", name]
        for option in fields(self):
            value, default = getattr(self, option.name), option.default
            if option.name == "json" or default is MISSING or value == default:
                continue
            flag = f"--{option.name.replace('_', '-')}"
            words += [flag] if value is True else [flag, str(value)]
        return shlex.join(words)

    def describe(self, scene: Scene) -> dict[str, Any]:
        """For JSON and reports."""
        return {
            "palm": self.palm,
            "hand": self.hand,
            "object": self.object,
            "gravity_m_s2": scene.gravity.tolist(),
            "object_width_m": scene.object_width,
            "object_mass_kg": scene.object_mass,
            "friction": self.friction,
        }


def check_viz(feature: str) -> None:
    """Raise MissingExtra where plots and pictures cannot be made, before anything is simulated."""
    if find_spec("matplotlib") is None or find_spec("imageio") is None:
        raise MissingExtra(feature, "viz")


def captions(title: str, trace: Trace, index: int = 0) -> Callable[[int], str]:
    """The text in a video at control step i of one trial."""
    rotation, held = trace.rotation, trace.held
    if held.ndim == 2:
        rotation, held = rotation[:, index], held[:, index]

    def caption(i: int) -> str:
        state = "" if held[i] else "   dropped"
        return f"{title}   {trace.time[i]:4.1f} s   {rotation[i]:5.2f} rad{state}"

    return caption


def make_controller(name: str, scene: Scene) -> Controller:
    """What `dexctl.controllers.resolve` finds for ``name``, with its default settings.

    Raises:
        UnknownName: no such controller or policy.
        InvalidInput: a damaged policy, or one for another hand.
        SimulationError: the hand cannot be driven by that controller.
    """
    try:
        return controllers.resolve(name, scene.hand, control_period=CONTROL_PERIOD)
    except InvalidInput as error:
        if name not in controllers.names():
            raise
        raise SimulationError(f"{name} cannot drive {scene.hand.path.stem}: {error}") from error


def run_trials(
    controller: Controller,
    sim: BatchSimulator,
    seconds: float,
    seed: int,
    *,
    behind: Callable[[BatchSimulator], Plant | None] | None = None,
    observers: Sequence[Callable[[Any], None]] = (),
    progress: Callable[[float], None] | None = None,
) -> Trace:
    """The standard protocol: the settled grasp, disturbed; environment i has the seed seed + i.

    ``behind`` makes what the controller sees of the simulator, once that is reset.

    Raises:
        SimulationError: the run failed; the arguments were checked before it.
    """
    from dexctl.sim import run

    sim.reset(seed)
    controller.reset(seed)
    try:
        plant = None if behind is None else behind(sim)
        return run(controller, sim, seconds, plant=plant, observers=observers, progress=progress)
    except InvalidInput as error:  # not the user's input any more
        raise SimulationError(f"the run failed: {error}") from error
