"""``dexctl hands add``: the toml of a hand, proposed from its file."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

from dexctl.cli.checks import make_folder
from dexctl.cli.hand_checks import unlimited
from dexctl.cli.hands_grasp import chosen, further, suggestions
from dexctl.cli.hands_trials import Turning
from dexctl.cli.output import facts, notes, print_json, results
from dexctl.cli.parsing import Switch
from dexctl.exceptions import DexctlError, InvalidInput, SimulationError
from dexctl.hand_config import HandConfig, HeldObject, ServoConfig
from dexctl.validation import check_name, check_seed

if TYPE_CHECKING:
    from dexctl.hand import HandModel
    from dexctl.sim import Scene

OBJECTS = ("cube", "sphere", "cylinder")
"""What a hand may be to hold where nobody says: the one that it turns furthest."""
_SOFT = 0.75  # share of the stiffness that a joint needs, below which it gets that


@dataclass(kw_only=True)
class Add:
    """Write the toml of a hand: fingertips, palm, gains and a grasp, guessed from its file.

    Every guess stands in the toml with its reason. Pictures of the hand, its fingertips and the
    grasp, and a page with all of it, are drawn beside the toml; look at them. Exits with 1 where
    no grasp was found; the toml is written all the same.
    """

    file: Annotated[Path, tyro.conf.Positional]
    """MJCF or URDF file of the hand."""
    out: Path | None = None
    """The toml; none: named after the file, in the current folder."""
    fingertips: tuple[str, ...] = ()
    """Bodies, links or sites that are the fingertips, in the order of the fingers; none: found."""
    base: str | None = None
    """Only what hangs on this body; for files of several hands, or of a hand on an arm."""
    object: str | None = None
    """Name of the object that it is to hold; none: of cube, sphere and cylinder the one that the
    coordinated gait turns furthest."""
    object_size: float | None = None
    """Width of that object [m]; none: found."""
    object_mass: float = HeldObject.mass
    """Mass of that object [kg]."""
    seed: int = 0
    """Seed of the search for the grasp."""
    grasp: bool = True
    """Whether to search a grasp."""
    turning: Turning = field(default_factory=Turning)
    """How the grasps that are found are tried with the coordinated gait."""
    replace: Switch = False
    """Replace a toml that is there already."""
    json: Switch = False
    """Print one JSON object instead of the table."""

    def run(self) -> int:
        from dexctl.hands.proposals import propose

        out = (self.out or Path(f"{self.file.stem}.toml")).expanduser()
        if out.suffix != ".toml":
            raise InvalidInput(f"--out is {str(out)!r}; expected the name of a .toml file")
        if out.exists() and not self.replace:
            raise InvalidInput(f"{out} is there already; give another --out, or --replace")
        check_seed(self.seed, 0)
        make_folder(out.parent)
        for option, value, unit in (
            ("size", self.object_size, "a width in metres"),
            ("mass", self.object_mass, "kilograms above 0"),
        ):
            if value is not None and not (np.isfinite(value) and value > 0):
                raise InvalidInput(f"--object-{option} is {value}; expected {unit}")
        if self.object is not None:
            from dexctl.sim import object_names

            # not a mesh: a toml names no file of an object's
            check_name("object", self.object, object_names())
        proposal = propose(self.file, self.fingertips, self.base)
        reasons = dict(proposal.reasons)
        reasons["object.mass"] = "Of the object that grasps were tried with [kg]."
        held = replace(proposal.config.object, mass=self.object_mass)
        config = replace(proposal.config, name=out.stem, object=held)
        hand = config.build()
        console = notes()
        say(f"{hand.n_fingers} fingers, {hand.nq} joints")
        asked = ""
        if missing := unlimited(hand):
            asked = (
                f"The file has {missing}. What motors can do is no guess of ours: write it as "
                "servos.effort [N m] and servos.velocity [rad/s]."
            )
            say(asked)
        reasons[""] = f"{self._head()} {asked}".strip()
        config, mended = with_gains(config, reasons)
        for note in mended:
            say(note)
        if others := [note for note in mended if not about_servos(note)]:
            reasons[""] += f" The simulator says: {'; '.join(others)}."
        failure, scene, hand = None, None, config.build()
        if self.grasp:
            try:
                config, scene = self._with_grasp(hand, config, reasons)
                scene.settled  # noqa: B018  as written, with its digits and its gains
            except SimulationError as error:
                failure = error
                say(f"no grasp: {error}")
                scene = getattr(error, "scene", None)
        config.write(out, reasons)  # whole: one that is interrupted before leaves none
        pictures = _draw(out, hand, scene, config, reasons, failure)
        rows = list(guesses(config, reasons))
        found = {
            "command": "hands add",
            "toml": str(out),
            "pictures": pictures,
            "fingertips": list(config.fingertips),
            "guesses": [{"setting": s, "value": v, "reason": r} for s, v, r in rows],
            "grasp": None if failure or not self.grasp else config.object.shape,
            "failure": None if failure is None else str(failure),
            "unlimited": asked,
            "notes": list(mended),
        }
        if self.json:
            print_json(found)
        else:
            results().print(facts((f"{s}: {v}", r) for s, v, r in rows))
            for picture in pictures:
                console.print(f"look at {picture}")
            word = shlex.quote(str(out))
            console.print(f"then: dexctl hands check {word}; dexctl rotate --hand {word}")
        return 0 if failure is None else 1

    def _head(self) -> str:
        return (
            f"Proposed by `dexctl hands add {self.file.name}`: everything here is a guess from the "
            "file; the comments say why. Look at the pictures, and mend what is wrong."
        )

    def _with_grasp(
        self, hand: HandModel, config: HandConfig, reasons: dict[str, str]
    ) -> tuple[HandConfig, Scene]:
        """The configuration with a grasp."""
        from dexctl.sim import Scene

        objects = (self.object,) if self.object else OBJECTS
        count = max(1, self.turning.grasps)
        grasps = suggestions(
            hand, objects, size=self.object_size, seed=self.seed, count=count, say=say
        )
        best, turned = chosen(hand, config, grasps, self.turning, self.seed, say, self.object_size)
        config = best.applied(config, hand.joint_names)
        if turned is not None:
            config, turned = further(config, best.object, turned, self.turning, self.seed)
            if config.object.travel is not None:
                say(f"fingers may go {config.object.travel:g} rad with the object: {turned.note}")
                reasons["object.travel"] = (
                    "Tried with the gait, beside what is usual for so many fingers: further."
                )
        held = best.note if turned is None else f"{best.note}; {turned.note}"
        reasons["object"] = f"Found by search and held in the simulator: {held}."
        reasons["postures.open"] = "From here the fingers close on the object."
        reasons["postures.grasp"] = "The fingertips about to touch the object."
        return config, Scene.build(config.build(), best.object)


def say(text: str) -> None:
    """A line for whoever waits."""
    notes().print(f"dexctl: {text}")


def with_gains(config: HandConfig, reasons: dict[str, str]) -> tuple[HandConfig, tuple[str, ...]]:
    """The configuration with the gains that its servos need, and what the simulator mended.

    A hand that cannot be simulated is left as it is; the search for a grasp says why.

    Args:
        config: as the file has it.
        reasons: of what is guessed, added to.
    """
    try:
        scene = _alone(config.build())
        if any("position servos added" in note for note in scene.notes):
            config = replace(config, servos=_servos(scene, config.servos))
            added = "; ".join(filter(about_servos, scene.notes))
            reasons["servos"] = f"The file has no position servos: {added}"
        for setting, needed, why in (
            (
                "stiffness",
                stiffened,
                "Too soft in the file to press with 2 N where the set-point is 0.1 rad ahead.",
            ),
            (
                "damping",  # of the stiffness that there is now
                damped,
                "Hardly damped in the file, so that these joints would ring for long: critical, "
                "where they swing at 8 Hz at most.",
            ),
        ):
            if mended := needed(config.build()):
                config = replace(config, servos=replace(config.servos, **{setting: mended}))
                reasons[f"servos.{setting}"] = why
                say(f"servos {needed.__name__}: {', '.join(mended)}")
    except DexctlError:
        return config, ()
    return config, scene.notes


def about_servos(note: str) -> bool:
    """Whether what a scene notes is told with the servos in the toml, and not at its head."""
    return "servo" in note


def _alone(hand: HandModel) -> Scene:
    """The hand with nothing in it."""
    from dexctl.sim import Scene

    return Scene.build(hand, object_size=0.05, grasp_centre=(0.0, 0.0, 10.0))


def stiffened(hand: HandModel) -> dict[str, float]:
    """Joints whose servos in the file are too soft for a grasp, and the stiffness they need."""
    from dexctl.sim.hand_spec import propose_servos

    need = propose_servos(hand).least
    found = _alone(hand).stiffness
    return {
        name: float(f"{wanted:.3g}")
        for name, wanted, there in zip(hand.joint_names, need, found, strict=True)
        if there < _SOFT * wanted
    }


def damped(hand: HandModel) -> dict[str, float]:
    """Joints that ring, or cannot be simulated, as they are; and the damping they need."""
    from dexctl.sim.servo_gains import proposed_gains, ringing

    scene = _alone(hand)
    found, unknown = scene.stiffness, np.full(hand.nq, np.nan)
    wanted = proposed_gains(scene.model, hand, found, unknown).damping
    return {
        name: float(f"{one:.3g}")
        for name, one, rings in zip(
            hand.joint_names, wanted, ringing(scene.model, hand, found, scene.damping), strict=True
        )
        if rings
    }


def _servos(scene: Scene, before: ServoConfig) -> ServoConfig:
    names = scene.hand.joint_names
    gear = scene.ctrl_per_radian
    damping = -scene.model.actuator_biasprm[scene.actuators, 2] * gear**2

    def table(values: np.ndarray) -> dict[str, float]:
        return {name: float(f"{one:.3g}") for name, one in zip(names, values, strict=True)}

    return replace(before, stiffness=table(scene.stiffness), damping=table(damping))


def guesses(config: HandConfig, reasons: dict[str, str]) -> Iterator[tuple[str, str, str]]:
    """Setting, value and reason of everything that was guessed."""
    from dexctl.settings import get, to_plain

    for path, reason in reasons.items():
        if path:
            value: Any = get(config, path)
            plain = to_plain(value) if hasattr(value, "__dataclass_fields__") else value
            yield path, _short(plain), reason.replace("\n", " ")


def _short(value: Any) -> str:
    if isinstance(value, dict):
        inner = {k: v for k, v in value.items() if v not in (None, {}, "")}
        text = ", ".join(
            str(k) if isinstance(v, dict | list | tuple) and len(inner) > 3 else f"{k} {_short(v)}"
            for k, v in inner.items()
        )
    elif isinstance(value, list | tuple):
        text = "(" + ", ".join(f"{one:.4g}" for one in value) + ")"
    else:
        text = f"{value:.4g}" if isinstance(value, float) else str(value)
    return text if len(text) < 160 else text[:157] + "..."


def _draw(
    out: Path,
    hand: HandModel,
    scene: Scene | None,
    config: HandConfig,
    reasons: dict[str, str],
    failure: DexctlError | None,
) -> list[str]:
    """Pictures and page beside the toml; what could not be drawn is said.

    Without a grasp, and without an attempt at one, hand and fingertips are drawn by themselves.
    """
    from dexctl.cli.hand_page import hand_page

    grasp = scene is not None
    try:
        if scene is None:
            from dexctl.sim import Scene

            amid = hand.fingertip_positions(hand.posture({})).mean(axis=0)  # it is not drawn
            scene = Scene.build(hand, object_size=0.05, grasp_centre=amid)
        return hand_page(
            out.with_suffix(""),
            scene,
            title=config.name,
            source=str(config.description),
            guesses=list(guesses(config, reasons)),
            failure=failure,
            grasp=grasp,
        )
    except DexctlError as error:
        say(f"no pictures: {error}")
        return []
