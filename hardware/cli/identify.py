"""``dexctl hardware identify``: what a log says of each joint, and ranges to train with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from dexctl import HandModel, hands
from dexctl.cli.checks import make_folder
from dexctl.cli.output import print_json, results, table, to_json
from dexctl.cli.parsing import Switch
from dexctl.files import aside, write_text
from dexctl.hands.identity import identity
from dexctl.settings import changed
from dexctl.state import Floats
from hardware.findings import joint_names
from hardware.identification import EXPLAINED, Fit, JointDynamics, identify
from hardware.log import check_joints, hand_of, read_log

RANGES, FIGURES, PICTURE = "ranges.toml", "identification.json", "identification.png"


@dataclass(kw_only=True)
class Identify:
    """Fit gains, friction, latency and inertia of each joint to a log.

    The log is best one of `dexctl hardware run chirp`, which moves the empty hand; of fingers that
    hold an object only stiffness and latency can be told. What is found is written as ranges too,
    and the gains that they are shares of, with which policies can be trained and tested: `dexctl
    train` and `dexctl evaluate` take --conditions ranges.toml.
    """

    log: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="LOG")]
    """The MCAP file of a run."""
    hand: str | None = None
    """Name or file of the hand, for the inertia of its links; none: as the log has it."""
    out: Path | None = None
    """Folder for ranges.toml, identification.json and identification.png; default the log's."""
    json: Switch = False
    """Print one JSON object instead of the table."""

    def run(self) -> int:
        log = read_log(self.log)
        fit = identify(log)
        hand = hands.load(hand_of(log, self.hand))
        check_joints(log, hand)
        armature = rotor_inertia(hand, fit)
        gains = gains_of(log.run)
        ranges = ranges_of(hand, fit.dynamics, armature, gains)
        folder = make_folder(self.out if self.out is not None else self.log.parent)
        names = joint_names(log)
        said = {
            "command": "identify",
            "log": str(self.log),
            "cut": log.cut,
            "hand": identity(hand),
            "joints": names,
            **{name: _listed(value) for name, value in fit.dynamics._asdict().items()},
            "armature": _listed(armature),
            "explained": fit.dynamics.explained.tolist(),
            "gains": gains,
            "ranges": {name: list(value) for name, value in ranges.items()},
        }
        write_text(folder / FIGURES, to_json(said) + "\n")
        write_text(folder / RANGES, toml_of(gains, ranges, self.log.name))
        draw(fit, names, folder / PICTURE)
        if self.json:
            print_json(said)
        else:
            _show(names, fit.dynamics, armature)
            if log.cut:
                results().print(f"the log was cut off, after {fit.time[-1]:.1f} s of the run")
            results().print(f"in {folder}: {RANGES}, {FIGURES} and {PICTURE}", soft_wrap=True)
        return 0


def rotor_inertia(hand: HandModel, fit: Fit) -> Floats:
    """What of each joint's inertia the hand's links do not explain, ``(d,)`` [kg m^2]."""
    from dexctl.sim.file_settings import lean_model
    from dexctl.sim.hand_spec import hand_spec
    from dexctl.sim.servo_gains import link_inertia

    model = lean_model(hand_spec(hand).spec, hand)
    links = link_inertia(model, hand, hand.clip(np.nanmedian(fit.q, axis=0)))
    return np.maximum(fit.dynamics.inertia - links, 0.0)


def gains_of(run: Mapping[str, Any]) -> dict[str, float]:
    """The gains that all servos of a log were told, as settings of a scene.

    Those told otherwise joint by joint are none: the hand's file has such, and a scene has them
    from there.

    Args:
        run: what the log says first.
    """
    every = {"stiffness": "stiffness_nm_per_rad", "damping": "damping_nms_per_rad"}
    return {name: float(run[key]) for name, key in every.items() if np.ndim(run[key]) == 0}


def ranges_of(
    hand: HandModel, found: JointDynamics, armature: Floats, gains: Mapping[str, float]
) -> dict[str, tuple[float, float]]:
    """Ranges of `dexctl.sim.Randomisation` that hold what was found.

    Each goes from the least joint to the greatest and, beyond, half of that spread each way, at
    least a fifth of the middle: one log of one hand is not all that there is. Joints that the model
    does not explain count for stiffness and latency only, where the measured torque tells those;
    what no joint tells is left out.

    Args:
        hand: which.
        found: of the joints.
        armature: ``(d,)`` [kg m^2].
        gains: settings of the scene whose stiffness and damping the shares are of.
    """
    from dexctl.sim.scene_config import SceneConfig

    (scene,) = changed(SceneConfig(), gains).scenes(hand)
    explained = found.explained
    told = explained | found.measured_torque
    every = {
        "stiffness_range": (found.stiffness / scene.stiffness, told),
        "damping_range": (found.damping / scene.damping, explained),
        "gear_friction_range": (found.friction, explained),
        "armature_range": (armature, explained),
        "action_latency_range": (found.latency, told),
    }
    return {name: _range(values[good]) for name, (values, good) in every.items() if good.any()}


def _range(values: Floats) -> tuple[float, float]:
    low, high = values.min(), values.max()
    room = max(0.5 * (high - low), 0.1 * (high + low))
    # half of the least is above zero where that is: a servo without stiffness is none
    return float(max(low - room, 0.5 * low)), float(high + room)


def toml_of(
    gains: Mapping[str, float], ranges: Mapping[str, tuple[float, float]], source: str
) -> str:
    """Conditions as a file: the gains that the shares are of, and the ranges."""
    lines = [f"# What {source} tells of the hand's joints."]
    lines += [f"{name} = {value!r}" for name, value in gains.items()]
    lines += [f"{name} = [{low:.4g}, {high:.4g}]" for name, (low, high) in ranges.items()]
    return "\n".join(lines) + "\n"


def draw(fit: Fit, names: list[str], path: Path) -> None:
    """Each joint that moved, as measured and as computed."""
    from dexctl.report.style import FAINT, INK, drawing, new_figure

    moved = [j for j in range(len(names)) if fit.moving[:, j].any()]
    with drawing(), aside(path) as file:
        columns = min(len(moved), 3)
        rows = -(-len(moved) // columns)
        figure = new_figure(3.2 * columns, 1.5 * rows)
        for place, j in enumerate(moved):
            axes = figure.add_subplot(rows, columns, place + 1)
            seen = fit.moving[:, j]
            axes.plot(fit.time[seen], fit.q[seen, j], color=FAINT, lw=2.0, label="measured")
            axes.plot(fit.time[seen], fit.computed[seen, j], color=INK, lw=0.8, label="computed")
            axes.set_title(names[j])
            axes.set_ylabel("rad" if place % columns == 0 else "")
            axes.set_xlabel("s" if place >= len(moved) - columns else "")
            if place == 0:
                axes.legend(loc="upper right", ncols=2)
        figure.savefig(file, format="png", dpi=110)


def _show(names: list[str], found: JointDynamics, armature: Floats) -> None:
    columns = {
        "stiffness": ("N m/rad", found.stiffness),
        "damping": ("N m s/rad", found.damping),
        "friction": ("N m", found.friction),
        "inertia": ("kg m²", found.inertia),
        "rotor": ("kg m²", armature),
        "latency": ("ms", 1e3 * found.latency),
        "residual": ("mrad", 1e3 * found.residual),
    }
    shown = table("joint", *columns, right=columns, gap=1)
    shown.add_row("", *(unit for unit, _ in columns.values()))
    torque_tells = ("stiffness", "latency", "residual")
    for j, name in enumerate(names):
        if np.isnan(found.stiffness[j]):
            shown.add_row(name, "did not", "move")
            continue
        known = [found.explained[j] or what in torque_tells for what in columns]
        pairs = zip(columns.values(), known, strict=True)
        shown.add_row(name, *(f"{value[j]:.3g}" if ok else "-" for (_, value), ok in pairs))
    results().print(shown)
    moved = np.isfinite(found.stiffness)
    if not found.measured_torque[moved].all():
        results().print(
            "where the measured torque tells nothing, the stiffness is what the servos were told"
        )
    if found.cut_short.any():
        shorter = ", ".join(name for name, cut in zip(names, found.cut_short, strict=True) if cut)
        results().print(
            f"of {shorter} only a part of the chirp was seen: only stiffness and latency are told",
            soft_wrap=True,
        )
    pushing = moved & ~found.explained & ~found.cut_short
    if pushing.any():
        results().print(
            f"{int(pushing.sum())} joints moved otherwise than a mass behind a "
            f"servo does (residual above {1e3 * EXPLAINED:g} mrad), as where fingers hold an "
            "object: only stiffness and latency are told of them; a chirp of the empty hand tells "
            "the rest",
            soft_wrap=True,
        )


def _listed(value: np.ndarray) -> list[Any]:
    if value.dtype == bool:
        return value.tolist()
    return [None if np.isnan(number) else float(number) for number in value]
