"""``dexctl hardware replay`` and ``report``: what can be done with a log."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from dexctl.cli.checks import make_folder
from dexctl.cli.output import notes, print_json, results
from dexctl.cli.parsing import Switch
from dexctl.exceptions import InvalidInput
from dexctl.files import make_parent
from dexctl.settings import only
from dexctl.sim.scene_config import SceneConfig
from dexctl.state import Floats
from hardware import report
from hardware.cli.options import HandOptions, busy, in_a_line, teller
from hardware.cli.run import LOG, about, finish, keep_earlier
from hardware.figures import figures_of_merit
from hardware.log import Log, LogWriter, check_joints, hand_of, read_log
from hardware.motions import Replay
from hardware.runner import Runner
from hardware.scene import ASKED, HELP


@dataclass(kw_only=True)
class ReplayLog(HandOptions):
    """Send the set-points of a log once more, to the emulator unless --port is given.

    Speed and torque are limited as they were. The object is not part of it: the emulated hand is
    empty.
    """

    log: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="LOG")]
    """The MCAP file of a run."""
    hand: str | None = None
    """Name or file of the hand; none: as the log has it."""
    out: Path = Path("out")
    """Folder for run.mcap and report.html of the replay."""
    json: Switch = False
    """Print one JSON object instead of the summary."""
    scene: Annotated[
        SceneConfig,
        only(ASKED, "stiffness", "damping", "limits.action_latency", texts=HELP),
    ] = ASKED

    def run(self) -> int:
        self.emulate = self.emulate or self.port is None
        self.check()
        log = read_log(self.log)
        period, q_target = rows_of(log)
        self.scene = replace(self.scene, hand=hand_of(log, self.hand))
        self.check()  # of that hand
        model, calibration = self.load()
        check_joints(log, model)
        limits = replace(self.limits(), **limits_of_run(log))
        folder = make_folder(self.out)
        target = folder / LOG
        if target.exists() and self.log.exists() and target.samefile(self.log):
            raise InvalidInput(f"--out is the folder of {self.log} itself; expected another one")
        keep_earlier(folder)
        replay = Replay(model, q_target, control_period=period)
        with self.open(limits, period) as session, LogWriter(target) as writer:
            name = f"replay of {self.log.name}"
            about_it = about(self, name, model, calibration, limits, self.scene)
            writer.write("/run", about_it | {"rate_hz": 1.0 / period})
            runner = Runner(
                session.hand,
                replay,
                needs_tactile=False,
                log=writer,
                on_event=teller(in_a_line),
            )
            found = runner.run(len(q_target) * period, approach=q_target[0])
        if hint := busy(self, found):
            notes().print(hint)
        code = finish(found, folder, as_json=self.json)
        if not self.json and target.exists() and "q" in (again := read_log(target)).ticks:
            results().print(f"joints against those of the log: {compare(log, again):.4g} rad RMS")
        return code


def rows_of(log: Log) -> tuple[float, Floats]:
    """Control period [s] and set-points ``(T, d)`` [rad] of the ticks in which it ran.

    Raises:
        InvalidInput: there are none.
    """
    ticks = log.ticks
    if "state" not in ticks or "limits" not in log.run:
        raise InvalidInput(f"{log.path} holds no run of a hand")
    running = ticks["state"] == "run"
    if running.sum() < 2:
        raise InvalidInput(f"{log.path} holds {int(running.sum())} ticks of a controller")
    period = float(np.median(np.diff(ticks["time"][running])))
    return round(period, 4), ticks["q_target"][running]


def limits_of_run(log: Log) -> dict[str, float]:
    """The speed and torque limit that the run was asked for, as settings of `Limits`.

    Raises:
        InvalidInput: the log does not say them.
    """
    said, names = log.run["limits"], ("speed_limit", "torque_limit")
    found = {
        name: said[name]
        for name in names
        if isinstance(said, Mapping) and isinstance(said.get(name), int | float)
    }
    for name in names:
        if name not in found:
            raise InvalidInput(f"{log.path} holds no {name} of its run; the log is damaged")
    return found


def compare(first: Log, second: Log) -> float:
    """RMS difference of the joints in the ticks in which both ran [rad]."""
    a, b = (log.ticks["q"][log.ticks["state"] == "run"] for log in (first, second))
    count = min(len(a), len(b))
    return float(np.sqrt(np.mean((a[:count] - b[:count]) ** 2))) if count else float("nan")


@dataclass(kw_only=True)
class Report:
    """Make the report of a log, one that was cut off included."""

    log: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="LOG")]
    """The MCAP file of a run."""
    out: Path | None = None
    """The HTML file; default report.html beside the log."""
    json: Switch = False
    """Print the figures as one JSON object as well."""

    def run(self) -> int:
        log = read_log(self.log)
        if not log.messages:
            cut = ", cut off before the first of them" if log.cut else ""
            raise InvalidInput(f"{self.log} holds no messages of a run{cut}")
        path = make_parent(self.out or self.log.parent / "report.html", "--out")
        report.write(log, path)
        if self.json:
            print_json(
                {
                    "command": "report",
                    "report": str(path),
                    "cut": log.cut,
                    "summary": log.summary,
                    "figures": figures_of_merit(log),
                }
            )
        else:
            cut = "; the log was cut off" if log.cut else ""
            results().print(f"written: {path} ({len(log.ticks.get('time', ()))} ticks{cut})")
        return 0
