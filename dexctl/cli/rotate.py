"""``dexctl rotate``: many trials of one controller turning one object."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dexctl import controllers
from dexctl.cli.output import notes, print_json, progress, results, to_json
from dexctl.cli.parsing import check_count, check_seconds, make_folder
from dexctl.cli.trials import CONTROL_PERIOD, SceneOptions, make_controller, run_trials

if TYPE_CHECKING:
    from dexctl.report.summary import BatchSummary, Share
    from dexctl.sim import Scene, Trace


@dataclass(kw_only=True)
class Rotate(SceneOptions):
    """Turn an object with one controller, many trials at once.

    Each trial starts from the settled grasp with set-points disturbed by N(0, 0.02 rad), at 20 Hz
    with 10 physics steps each. An object whose centre moves by more than 0.05 m is dropped; the
    rotation is the unwrapped angle about the hand's z axis up to the drop.
    """

    controller: str = "coordinated"
    """Name of the controller: igm, switch, gait, coordinated or hold."""
    seconds: float = 10.0
    """Simulated time of each trial [s]."""
    num_envs: int = 64
    """How many trials."""
    seed: int = 0
    """Seed of the first trial; trial i has seed + i."""
    out: Path | None = None
    """Folder for rotate.json and report.html (and rotate.mp4)."""
    json: bool = False
    """Print one JSON object instead of the table."""
    video: bool = False
    """Record the first trial to rotate.mp4 (wants --out and an OpenGL)."""
    viewer: bool = False
    """Show the first trial in MuJoCo's viewer (wants a display); closing it ends the run."""

    def run(self) -> int:
        check_seconds(self.seconds, CONTROL_PERIOD)
        check_count("--num-envs", self.num_envs)
        controllers.entry(self.controller)
        if self.video and self.out is None:
            from dexctl.exceptions import InvalidInput

            raise InvalidInput("--video is given without --out; expected a folder for rotate.mp4")
        folder = None if self.out is None else make_folder(self.out)
        scene = self.build_scene()
        trace, frames = self._simulate(scene)
        from dexctl.report.summary import summarise_batch

        summary = summarise_batch(trace)
        found = self._as_dict(scene, summary)
        if folder is not None:
            self._write(folder, scene, trace, found)
        if self.json:
            print_json(found)
        else:
            self._print(summary)
        return 0

    def _simulate(self, scene: Scene) -> tuple[Trace, list[Any]]:
        from dexctl.sim import BatchSimulator

        controller = make_controller(self.controller, scene)
        with (
            BatchSimulator(scene, self.num_envs, control_period=CONTROL_PERIOD) as sim,
            progress(notes()) as bar,
        ):
            task = bar.add_task(f"{self.controller}, {self.num_envs} trials", total=self.seconds)
            trace = run_trials(
                controller,
                sim,
                self.seconds,
                self.seed,
                progress=lambda now: bar.update(task, completed=now),
            )
        return trace, []

    def _as_dict(self, scene: Scene, summary: BatchSummary) -> dict[str, Any]:
        from dexctl.report.machine import machine

        return {
            "command": "rotate",
            "controller": self.controller,
            **self.describe(scene),
            "seconds": self.seconds,
            "control_period_s": CONTROL_PERIOD,
            "seeds": [self.seed, self.seed + self.num_envs - 1],
            **summary.as_dict(),
            "machine": machine(),
        }

    def _write(self, folder: Path, scene: Scene, trace: Trace, found: dict[str, Any]) -> None:
        from dexctl.report.files import write_text

        write_text(folder / "rotate.json", to_json(found) + "\n")

    def _print(self, summary: BatchSummary) -> None:
        from rich.table import Table

        from dexctl.report.summary import percentiles

        what = f"{self.controller} turns {self.object} with {self.hand}, palm {self.gravity}"
        table = Table(
            title=f"{what}: {self.num_envs} trials of {self.seconds:g} s, from seed {self.seed}",
            title_justify="left",
            title_style="bold",
        )
        for heading, justify in (("", "left"), ("median", "right"), ("10 % to 90 %", "right")):
            table.add_column(heading, justify=justify)  # type: ignore[arg-type]
        for name, values, unit in (
            ("rotation", summary.rotation, "rad"),
            ("time held", summary.time_held, "s"),
        ):
            spread = percentiles(values)
            table.add_row(
                f"{name} [{unit}]".replace("[", r"\["),
                f"{spread['median']:.2f}",
                f"{spread['p10']:.2f} to {spread['p90']:.2f}",
            )
        turns = percentiles(summary.rotation)["median"] / (2 * pi)
        table.add_row("rotation in turns", f"{turns:.2f}", "")
        console = results()
        console.print(table)
        shares = Table(box=None, show_header=False, pad_edge=False)
        shares.add_row("still holding", _share(summary.holding))
        shares.add_row("made a full turn", _share(summary.full_turn))
        shares.add_row("fingertips in touch", f"{summary.mean_contacts:.1f} on average")
        shares.add_row(
            "controller latency",
            f"{1e3 * summary.latency_median:.2f} ms median, {1e3 * summary.latency_p99:.2f} ms p99, "
            f"for {self.num_envs} hands",
        )
        if summary.diverged:
            shares.add_row("simulations broken down", str(summary.diverged))
        console.print(shares)


def _share(share: Share) -> str:
    return (
        f"{share.count} of {share.trials}, {100 * share.share:.0f} % "
        f"(95 % interval {100 * share.low:.0f} to {100 * share.high:.0f} %)"
    )
