"""Controllers and a policy against sampling-based predictive control on the same hand and object.

The peer is predictive sampling as judo-rai 0.1 has it for a cube in a LEAP hand (32 rollouts of
1 s, 4 knots, sigma 0.2), with a reward for turning. It plans in the very scene, exactly known,
which it is given as a file; ours know joints and touch. It needs another MuJoCo, so it has an
interpreter of its own: `python -m venv judo; judo/bin/pip install judo-rai==0.1.0`, and
`--peer judo/bin/python`. With `paused` the world waits while it plans; in `real time` a plan is
late by what it took.
"""

from __future__ import annotations

import json
import re
import subprocess
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from measuring.results import FIXED, Figure, earlier, write
from measuring.settings import Settings, check_chosen, progress, settings
from measuring.shares import over_seeds, share
from measuring.trials import FULL_TURN

from dexctl import controllers, hands
from dexctl.controller import Controller
from dexctl.exceptions import InvalidInput
from dexctl.sim import Scene, SceneConfig, Simulation, run
from dexctl.state import Floats, GraspState

SIDE = Path(__file__).resolve().parent / "measuring" / "judo_side.py"
SAMPLING = {
    "num_nodes": 4, "num_rollouts": 32, "use_noise_ramp": True, "noise_ramp": 4.0, "sigma": 0.2,
}  # fmt: skip
PLANNING = {"horizon": 1.0, "spline_order": "cubic", "max_num_traces": 1}
MODES = {"paused": False, "real time": True}
_DROP = 0.05  # of the object's centre, from where it was [m]
_PERIOD = 0.05  # of control [s]


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    seed: int = 100
    """First seed; trial i has the seed seed + i."""
    trials: int = 4
    """Trials each."""
    seconds: float = 30.0
    """Of each."""
    object: str = "cube"
    """Which."""
    who: tuple[str, ...] = ("coordinated", "dex5-easy")
    """Controllers and policies."""
    peer: Path | None = None
    """An interpreter that has judo-rai; none: it is left out."""
    turn_weight: float = 1.0
    """Of a radian in the peer's reward; ..."""
    place_weight: float = 5000.0
    """... of the squared distance [1/m^2]. With judo's own, 100, the object is thrown within 1.4 s;
    0.3 and 1000 turned it 4.3 rad in the four trials in which these turned it 14.6."""
    modes: tuple[str, ...] = tuple(MODES)
    """Whether the world waits for the peer; measure `real time` on a machine that is quiet."""


class Timed(Controller):
    """A controller whose processor time is counted."""

    def __init__(self, inside: Controller) -> None:
        super().__init__(inside.hand, control_period=inside.control_period)
        self.inside, self.seconds = inside, 0.0

    def act(self, state: GraspState) -> Floats:
        start = time.process_time()
        action = self.inside.act(state)
        self.seconds += time.process_time() - start
        return action

    def reset(self, seed: Any = None, mask: Any = None) -> None:
        self.inside.reset(seed, mask)

    def state_dict(self) -> dict[str, Any]:
        return self.inside.state_dict()

    def load_state_dict(self, saved: Any) -> None:
        self.inside.load_state_dict(saved)


def ours(who: str, given: Options) -> list[dict[str, Any]]:
    """The trials of one of ours, each alone, as it would be on a hand."""
    timed = Timed(controllers.resolve(who, hands.load("dex5"), control_period=None))
    config = SceneConfig(object=(given.object,), control_period=timed.control_period, threads=1)
    found = []
    for i in range(given.trials):
        with Simulation(config, 1, given.seed + i) as sim:
            timed.reset(given.seed + i)
            timed.seconds = 0.0
            trace = run(timed, sim, given.seconds, drop_distance=_DROP)
        held = trace.held[:, 0]
        found.append(
            {
                "who": who,
                "mode": "any",
                "seed": given.seed + i,
                "rotation_rad": float(trace.rotation[-1, 0]),
                "time_held_s": float(trace.time[held].max()),
                "dropped": not held[-1],
                "processor_s": timed.seconds * float(trace.time[held].max()) / given.seconds,
            }
        )
    return found


def scene_for_the_peer(given: Options, path: Path) -> dict[str, Any]:
    """The scene as a file that MuJoCo 3.6 reads, and where it begins."""
    scene = Scene.build("dex5", given.object, "up")
    # what older versions do not know says what is their default
    path.write_text(re.sub(r' input="pos"', "", scene.spec.to_xml()))
    ctrl = np.zeros(scene.model.nu)
    ctrl[scene.actuators] = scene.settled.q_target * scene.ctrl_per_radian
    return {
        "model": str(path),
        "qpos": scene.settled.qpos.tolist(),
        "ctrl": ctrl.tolist(),
        "object_qpos": scene.object_qpos.start,
    }


def peers(given: Options, rows: list[dict[str, Any]]) -> None:
    """Add the trials of the peer that are not there.

    Raises:
        InvalidInput: its interpreter does not run it.
    """
    done = {(row["mode"], row["seed"]) for row in rows}
    with tempfile.TemporaryDirectory() as folder:
        own = scene_for_the_peer(given, Path(folder) / "scene.xml")
        asked = Path(folder) / "settings.json"
        for mode in given.modes:
            for seed in range(given.seed, given.seed + given.trials):
                if (mode, seed) in done:
                    continue
                config = own | {
                    "seed": seed, "seconds": given.seconds, "real_time": MODES[mode],
                    "period": _PERIOD, "drop_distance": _DROP,
                    "weights": {"w_turn": given.turn_weight, "w_pos": given.place_weight},
                    "sampling": SAMPLING, "controller": PLANNING,
                }  # fmt: skip
                asked.write_text(json.dumps(config))
                ended = subprocess.run(
                    [str(given.peer), str(SIDE), str(asked)],
                    capture_output=True, text=True, check=False,
                )  # fmt: skip
                if ended.returncode:
                    why = ended.stderr.strip().splitlines()[-1:]
                    raise InvalidInput(f"{given.peer} does not run the peer: {' '.join(why)}")
                one = {"who": "judo-rai", "mode": mode, "seed": seed}
                rows.append(one | json.loads(ended.stdout))
                save(rows, given, say=False)
                progress(json.dumps(rows[-1]))


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Trials of one kind, together."""
    rotation = np.array([row["rotation_rad"] for row in rows])
    processor = sum(row["processor_s"] for row in rows)
    return {
        "rotation": over_seeds(rotation),
        "dropped": share(np.array([row["dropped"] for row in rows])),
        "held": float(np.median([row["time_held_s"] for row in rows])),
        # of all trials together: where nothing is turned, the time is spent all the same
        "processor_s_a_radian": processor / max(float(rotation.sum()), 1e-3),
    }


def save(rows: list[dict[str, Any]], given: Options, *, say: bool) -> None:
    """Write the result."""
    kinds = list(dict.fromkeys((row["who"], row["mode"]) for row in rows))
    by = {
        kind: summary([row for row in rows if (row["who"], row["mode"]) == kind]) for kind in kinds
    }
    figures = []
    for who in given.who:
        for mode in MODES:
            if ("judo-rai", mode) not in by:
                continue
            mine, theirs = by[who, "any"], by["judo-rai", mode]
            far = mine["rotation"]["median"] / max(theirs["rotation"]["median"], 1e-3)
            cost = mine["processor_s_a_radian"] / theirs["processor_s_a_radian"]
            figures.append(
                Figure(
                    f"{who} against predictive sampling (judo-rai, {mode}), {given.object}, "
                    f"{given.seconds:g} s: rotation before a drop, processor time a radian",
                    f"{far:.2g} times ({mine['rotation']['median']:.1f} and "
                    f"{theirs['rotation']['median']:.1f} rad), {cost:.2g} of the time",
                    "3 times, a tenth",
                    bool(far >= 3.0 and cost <= 0.1),
                )
            )
    lines = [
        [
            *kind,
            f"{one['rotation']['median']:.1f} ({one['rotation']['p10']:.1f} to "
            f"{one['rotation']['p90']:.1f})",
            f"{one['rotation']['median'] / FULL_TURN:.1f}",
            f"{one['dropped']['count']} of {one['dropped']['of']}",
            f"{one['held']:.0f}",
            f"{1e3 * one['processor_s_a_radian']:.3g}",
        ]
        for kind, one in by.items()
    ]
    table = {
        "title": f"Predictive sampling (judo-rai 0.1) and ours, {given.object}, palm up, "
        f"{given.trials} trials of {given.seconds:g} s: rotation before a drop, median "
        "(10 to 90 %)",
        "header": [
            "", "The world", "Rotation [rad]", "Turns", "Dropped", "Held: median [s]",
            "Processor time a radian [ms]",
        ],
        "rows": lines,
    }  # fmt: skip
    write("predictive_sampling", given, figures, [table], trials=rows, say=say)


def main() -> None:
    given = settings(Options, __doc__)
    check_chosen("mode", given.modes, MODES)
    kept = (*FIXED, "object", "turn_weight", "place_weight")
    rows = earlier("predictive_sampling", given, kept)
    done = {row["who"] for row in rows}
    rows += [row for who in given.who if who not in done for row in ours(who, given)]
    if given.peer is not None:
        peers(given, rows)
    else:
        progress("no --peer: ours alone")
    save(rows, given, say=True)


if __name__ == "__main__":
    main()
