"""``dexctl hardware latency``: how much later a joint does what its set-point did."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dexctl.cli.checks import make_folder
from dexctl.cli.output import notes, print_json, results, to_json
from dexctl.cli.parsing import Switch
from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.files import write_text
from dexctl.state import Floats
from hardware.cli.options import HandOptions, busy, in_a_line, teller
from hardware.motions import StepAndChirp, lag
from hardware.runner import Runner
from hardware.state_machine import State

_MOVED = 0.003  # two ticks of the servo: a joint that is this far has begun to move [rad]


@dataclass(kw_only=True)
class Latency(HandOptions):
    """Measure the delay between set-points and joints with a step and a chirp.

    The delay of the chirp is where the cross-correlation of the two motions is greatest; it holds
    the servo's own lag too, which a faster loop does not take away. The delay of the step is the
    time until the joint has begun to move.
    """

    joint: str | None = None
    """Which joint moves, by 0.09 rad; default the first."""
    rate: float = 100.0
    """Control rate [Hz]."""
    out: Path | None = None
    """Folder for latency.json, with every sample of set-point and joint."""
    json: Switch = False
    """Print one JSON object instead of the summary."""

    def run(self) -> int:
        self.check()
        if not (np.isfinite(self.rate) and 10.0 <= self.rate <= 500.0):
            raise InvalidInput(f"--rate is {self.rate}; expected 10 to 500 Hz")
        model, _ = self.load()
        names = list(model.joint_names)
        if self.joint is not None and self.joint not in names:
            raise UnknownName("joint", self.joint, names)
        joint = 0 if self.joint is None else names.index(self.joint)
        folder = None if self.out is None else make_folder(self.out)
        period = 1.0 / self.rate
        motion = StepAndChirp(model, joint, control_period=period)
        samples: list[tuple[float, float, float]] = []
        with self.open(self.limits(), period) as session:

            def keep(time: float, q: Floats, q_target: Floats) -> None:
                samples.append((time, float(q_target[joint]), float(q[joint])))

            runner = Runner(
                session.hand,
                motion,
                needs_tactile=False,
                on_tick=keep,
                on_event=teller(in_a_line),
            )
            found = runner.run(motion.seconds)
        if found.outcome is not State.IDLE or len(samples) < 100:
            why = found.cause.value if found.cause else "interrupted"
            notes().print(f"no measurement: {why}; {found.torque_message}")
            if hint := busy(self, found):
                notes().print(hint)
            return 1
        step, chirp = delays(np.array(samples), motion.STEP_SECONDS, period)
        said = {
            "command": "latency",
            "joint": names[joint],
            "rate_hz": self.rate,
            "step_delay_s": step,
            "chirp_delay_s": chirp,
            "figures_s": found.figures,
            "torque": found.torque_message,
        }
        if folder is not None:
            rows = {"columns": ["time_s", "q_target_rad", "q_rad"], "samples": samples}
            write_text(folder / "latency.json", to_json(said | rows) + "\n")
        if self.json:
            print_json(said)
        else:
            results().print(
                f"{names[joint]}: step {1e3 * step:.0f} ms until it moves, chirp "
                f"{1e3 * chirp:.0f} ms behind; {found.torque_message}"
            )
        return 0


def delays(samples: Floats, step_seconds: float, period: float) -> tuple[float, float]:
    """Delay of step and chirp [s] from rows of (time, set-point, joint); NaN: it did not move."""
    time, sent, came = samples.T
    early = time < time[0] + step_seconds
    asked = np.flatnonzero(np.abs(sent - sent[0]) > _MOVED)
    moved = np.flatnonzero(np.abs(came - came[0]) > _MOVED)
    step = float(time[moved[0]] - time[asked[0]]) if len(asked) and len(moved) else float("nan")
    # ticks may have been left out: put the chirp on an even grid first
    grid = np.arange(time[~early][0], time[-1], period)
    chirp = lag(np.interp(grid, time, sent), np.interp(grid, time, came), period)
    return step, chirp
