"""``dexctl rotate``: many trials of one controller turning one object."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dexctl.cli.output import notes, print_json, progress, results, to_json
from dexctl.cli.parsing import check_count, check_seconds, make_folder
from dexctl.cli.trials import (
    CONTROL_PERIOD,
    SceneOptions,
    captions,
    check_viz,
    make_controller,
    run_trials,
)
from dexctl.exceptions import InvalidInput

if TYPE_CHECKING:
    from dexctl.controller import Controller
    from dexctl.plant import Plant
    from dexctl.report.film import Film
    from dexctl.report.summary import BatchSummary
    from dexctl.sim import BatchSimulator, Scene, Trace


@dataclass(kw_only=True)
class Rotate(SceneOptions):
    """Turn an object with one controller, many trials at once.

    Each trial starts from the settled grasp with set-points disturbed by N(0, 0.02 rad), at 20 Hz
    with 10 physics steps each. An object whose centre moves by more than 0.05 m is dropped; the
    rotation is the unwrapped angle about the hand's z axis up to the drop.
    """

    controller: str = "coordinated"
    """Name of the controller (igm, switch, gait, coordinated, hold), or a policy: learned, its name
    (dex5-cylinder), its file (.npz), its run folder; or module:function."""
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
    """Show the first trial in MuJoCo's viewer, in real time (wants a display)."""
    as_real: bool = False
    """Latency, speed and torque limits of the servo hand: 0.05 s, 0.6 rad/s, 0.5 N m."""
    latency: float | None = None
    """From a set-point to its effect [s], in whole control periods."""
    speed_limit: float | None = None
    """Fastest set-point [rad/s]."""
    torque_limit: float | None = None
    """Largest joint torque [N m]."""

    @property
    def limits(self) -> dict[str, Any]:
        """What `dexctl.sim.AsReal` is given; {} for the bare simulator."""
        from dexctl.limits import REAL_LATENCY, REAL_SPEED, REAL_TORQUE

        given = {"latency": self.latency, "speed": self.speed_limit, "torque": self.torque_limit}
        if not self.as_real:
            nothing = all(value is None for value in given.values())
            return {} if nothing else {**given, "latency": self.latency or 0.0}
        usual = {"latency": REAL_LATENCY, "speed": REAL_SPEED, "torque": REAL_TORQUE}
        return {name: usual[name] if given[name] is None else given[name] for name in usual}

    def run(self) -> int:
        check_seconds(self.seconds, CONTROL_PERIOD)
        check_count("--num-envs", self.num_envs)
        for name in ("latency", "speed_limit", "torque_limit"):
            value, least = getattr(self, name), 0.0 if name == "latency" else 1e-6
            if value is not None and not least <= value <= 10:
                flag = f"--{name.replace('_', '-')}"
                raise InvalidInput(f"{flag} is {value}; expected a number above 0, up to 10")
        if self.video and self.out is None:
            raise InvalidInput("--video is given without --out; expected a folder for rotate.mp4")
        if self.out is not None:
            check_viz("dexctl rotate --out")
        scene = self.build_scene()
        controller = make_controller(self.controller, scene)
        folder = None if self.out is None else make_folder(self.out)
        from dexctl.report.film import Film
        from dexctl.report.summary import summarise_batch

        film = Film()
        trace = self._simulate(scene, controller, film)
        summary = summarise_batch(trace)
        found = self._as_dict(scene, summary)
        if folder is not None:
            self._write(folder, scene, trace, summary, found)
        if self.json:
            print_json(found)
        else:
            self._print(summary)
        if folder is not None and self.video:
            self._draw(folder, scene, trace, film)
        return 0

    def _simulate(self, scene: Scene, controller: Controller, film: Film) -> Trace:
        from dexctl.sim import AsReal, BatchSimulator

        limits = self.limits
        console = notes()
        with ExitStack() as stack:
            watch: list[Callable[[Any], None]] = []
            if self.video:
                watch.append(film)
            if self.viewer:
                from dexctl.sim.viewer import Viewer

                watch.append(stack.enter_context(Viewer(scene)))
            sim = stack.enter_context(BatchSimulator(scene, self.num_envs, CONTROL_PERIOD))
            self.set_friction(sim)

            def behind(sim: BatchSimulator) -> Plant | None:
                return AsReal(sim, stiffness=scene.stiffness, **limits) if limits else None

            def look(now: Any) -> None:
                for watcher in watch:
                    watcher(now)

            bar = stack.enter_context(progress(console))
            task = bar.add_task(f"{self.controller}, {self.num_envs} trials", total=self.seconds)
            return run_trials(
                controller,
                sim,
                self.seconds,
                self.seed,
                behind=behind,
                observers=[look] if watch else [],
                progress=lambda now: bar.update(task, completed=now),
            )

    def _as_dict(self, scene: Scene, summary: BatchSummary) -> dict[str, Any]:
        from dexctl.report.machine import machine

        return {
            "command": "rotate",
            "controller": self.controller,
            **self.describe(scene),
            "seconds": self.seconds,
            "control_period_s": CONTROL_PERIOD,
            "limits": self.limits,
            "seeds": [self.seed, self.seed + self.num_envs - 1],
            **summary.as_dict(),
            "machine": machine(),
        }

    def _write(
        self,
        folder: Path,
        scene: Scene,
        trace: Trace,
        summary: BatchSummary,
        found: dict[str, Any],
    ) -> None:
        from dexctl.files import write_text
        from dexctl.report import batch

        write_text(folder / "rotate.json", to_json(found) + "\n")
        document = batch.build(
            self.controller,
            trace,
            summary,
            setting={
                **self.describe(scene),
                **{f"limit_{name}": value for name, value in self.limits.items()},
                "seconds": self.seconds,
                "seed": self.seed,
            },
            control_period=CONTROL_PERIOD,
            command=self.command_line("rotate"),
            machine=found["machine"],
        )
        write_text(folder / "report.html", document)
        notes().print(f"written: {folder / 'rotate.json'} and {folder / 'report.html'}")

    def _draw(self, folder: Path, scene: Scene, trace: Trace, film: Film) -> None:
        from dexctl.report.style import title_of
        from dexctl.sim.record import Recorder

        console, path = notes(), folder / "rotate.mp4"
        caption = captions(title_of(self.controller), trace)
        with (
            Recorder(scene, path, width=640, height=480) as recorder,
            progress(console) as bar,
        ):
            task = bar.add_task("drawing the first trial", total=self.seconds)
            film.play(recorder, caption, progress=lambda now: bar.update(task, completed=now))
        console.print(f"written: {path}")

    def _print(self, summary: BatchSummary) -> None:
        from rich.table import Table

        from dexctl.report.batch import figures_of_merit
        from dexctl.report.style import title_of

        title = title_of(self.controller)
        console = results()
        console.print(
            f"[bold]{title}: {self.hand} turns a {self.object}, {self.palm}[/bold]\n"
            f"{self.num_envs} trials of {self.seconds:g} s, seeds {self.seed} to "
            f"{self.seed + self.num_envs - 1}; median (10 % to 90 %), share (95 % interval)\n",
            soft_wrap=True,
        )
        table = Table(box=None, show_header=False, pad_edge=False, padding=(0, 3, 0, 0))
        for what, value in figures_of_merit(summary):
            table.add_row(what, value)
        console.print(table)
