"""Identification end to end: the emulated servo hand with hidden values, its log, and the fit.

Each trial draws stiffness, damping, dry friction and rotor of each joint and the latency of all,
which nobody tells the fit, and is two commands: `dexctl hardware run ... --emulate` in real time,
and `dexctl hardware identify` of its log. A chirp of the empty hand tells all of a joint, a gait
what the servo's torque tells.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from measuring.results import Figure, earlier, write
from measuring.settings import Settings, progress, settings

from dexctl.settings import changed
from dexctl.sim import SceneConfig
from hardware.emulator.mujoco_hand import MujocoHand
from hardware.log import read_log

TOLD = {"chirp": ("friction", "armature", "damping", "stiffness", "latency")}
"""What a log tells; that of another motion stiffness and latency."""
UNITS = {"friction": "N m", "armature": "kg m^2", "damping": "N m s/rad", "latency": "s"}
NEAR = {"latency": 0.015}
"""How far off it may be in the median joint: the latency, to which the bus adds, this [s], ..."""
SHARE = 0.25
"""... of all else this share of it."""
DRAWN = ("stiffness", "damping", "gear_friction", "armature", "latency")
"""Settings whose ranges decide what is hidden."""


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    motions: tuple[str, ...] = ("chirp", "coordinated")
    """Whose logs."""
    trials: int = 4
    """Of each."""
    seconds: float = 26.0
    """Of each run; a chirp of all joints of a finger takes 26."""
    stiffness: tuple[float, float] = (0.7, 1.3)
    """Drawn from this range for each joint, as shares of what the servos are told."""
    damping: tuple[float, float] = (0.7, 1.3)
    """The same, of servo and joint."""
    gear_friction: tuple[float, float] = (0.02, 0.05)
    """Drawn from this range for each joint [N m]."""
    armature: tuple[float, float] = (0.001, 0.004)
    """As well [kg m^2]."""
    latency: tuple[float, float] = (0.02, 0.06)
    """Drawn from this range for a run [s]."""


def said(*words: str) -> dict[str, Any]:
    """The JSON object that a command prints."""
    command = [sys.executable, "-m", "dexctl", "hardware", *words, "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if not done.stdout.strip():
        raise SystemExit(f"dexctl hardware {' '.join(words)}: {done.stderr.strip()}")
    return json.loads(done.stdout)


def trial(motion: str, seed: int, given: Options) -> dict[str, Any]:
    """One run and the fit of its log."""
    latency = float(np.random.default_rng(seed).uniform(*given.latency))
    with tempfile.TemporaryDirectory() as folder:
        run = said(
            "run", motion, "--emulate", "--out", folder, "--seconds", f"{given.seconds:g}",
            "--seed", str(seed), "--action-latency", f"{latency}", "--patience", "5",
            "--stiffness-range", between(given.stiffness),
            "--damping-range", between(given.damping),
            "--gear-friction-range", between(given.gear_friction),
            "--armature-range", between(given.armature),
        )  # fmt: skip
        log = Path(folder) / "run.mcap"
        about = read_log(log).run
        found = said("identify", str(log))
    return {
        "motion": motion,
        "seed": seed,
        "outcome": run["outcome"],
        "hidden": hidden(about, seed) | {"latency": latency},
        "found": {name: found[name] for name in TOLD.get(motion, ("stiffness", "latency"))},
        "explained": int(np.sum(found["explained"])),
    }


def between(drawn: tuple[float, float]) -> str:
    """A range as commands take it."""
    return ",".join(f"{value:g}" for value in drawn)


def hidden(about: Mapping[str, Any], seed: int) -> dict[str, list[float]]:
    """What the emulated joints of a run were: the same scene and seed draw the same."""
    joints = MujocoHand(changed(SceneConfig(), about["scene"]), seed)
    drawn = joints.drawn
    truth = {
        "friction": drawn.gear_friction[0],
        "armature": drawn.armature[0],
        "damping": about["damping_nms_per_rad"] * joints.kv_share + drawn.damping[0],
        "stiffness": about["stiffness_nm_per_rad"] * joints.kp_share,
    }
    return {name: np.round(values, 6).tolist() for name, values in truth.items()}


def errors(rows: list[dict[str, Any]], name: str) -> np.ndarray:
    """Of all joints that tell it, as `NEAR` and `SHARE` count."""
    every = []
    for row in rows:
        true = np.array(row["hidden"][name])
        off = np.array(row["found"][name], float) - true
        every.append(np.abs(off) / (1.0 if name in NEAR else true))
    values = np.concatenate(every)
    return values[np.isfinite(values)]


def save(rows: list[dict[str, Any]], given: Options, *, say: bool) -> None:
    """Write the result with the rows so far."""
    figures, lines = [], []
    for motion in dict.fromkeys(row["motion"] for row in rows):
        mine = [row for row in rows if row["motion"] == motion]
        for name in mine[0]["found"]:
            off = errors(mine, name)
            if not len(off):
                continue
            true = np.concatenate([np.atleast_1d(row["hidden"][name]) for row in mine])
            middle, worst = float(np.median(off)), float(np.quantile(off, 0.9))
            unit = UNITS.get(name, "N m/rad")
            of = f"{true.min():.3g} to {true.max():.3g} {unit}"
            found = [f"{1000 * x:.0f} ms" if name in NEAR else f"{100 * x:.0f} %"
                     for x in (middle, worst)]  # fmt: skip
            near = NEAR.get(name, SHARE)
            most = f"{1000 * near:.0f} ms" if name in NEAR else f"{100 * near:.0f} %"
            lines.append([motion, name, of, *found, f"{len(off)}"])
            figures.append(
                Figure(
                    f"identify, log of {motion}, {len(mine)} runs: {name}, hidden, {of}",
                    f"off by {found[0]} in the median joint, {found[1]} in nine of ten",
                    f"off by {most} at most in the median joint",
                    middle <= near,
                )
            )
    table = {
        "title": f"Identification through the emulated bus, {given.seconds:g} s each, in real "
        "time: how far what is found is off, of all joints and runs that tell it",
        "header": ["Log of", "", "Hidden", "Median", "Nine of ten", "Joints"],
        "rows": lines,
    }
    write("identification", given, figures, [table], trials=rows, say=say)


def main() -> None:
    given = settings(Options, __doc__)
    rows = earlier("identification", given, ("seconds", *DRAWN))
    done = {(row["motion"], row["seed"]) for row in rows}
    seeds = range(given.seed, given.seed + given.trials)
    for motion, seed in product(given.motions, seeds):
        if (motion, seed) in done:
            continue
        rows.append(trial(motion, seed, given))
        save(rows, given, say=False)
        progress(json.dumps(rows[-1]))
    save(rows, given, say=True)


if __name__ == "__main__":
    main()
