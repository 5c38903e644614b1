"""``dexctl demo``: every controller turns the same object; table, video and report."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from dexctl.cli.output import notes, print_json, progress, results
from dexctl.cli.parsing import check_seconds, make_folder
from dexctl.cli.trials import (
    CONTROL_PERIOD,
    SceneOptions,
    captions,
    check_viz,
    make_controller,
    run_trials,
)
from dexctl.exceptions import RoomShadowed, SimulationError, UnknownName

if TYPE_CHECKING:
    from rich.console import Console

    from dexctl.controller import Controller
    from dexctl.report.demo import Trial
    from dexctl.sim import Scene
    from dexctl.sim.record import Recorder

CONTROLLERS = ("igm", "switch", "gait", "coordinated", "learned")
KEY_FRAMES, PICTURE_FRAMES = 4, 6
_NAMED = ("report.html", "picture.png", "demo.mp4")
FPS, VIDEO_SIZE, STILL_SIZE = 15.0, (640, 480), (800, 600)
DRAWING_BUDGET = 90.0  # a slower machine draws fewer pictures a second, to be done in this time [s]
AFTER_DROP = 1.5  # the film goes on for so long after a drop [s]


@dataclass(kw_only=True)
class Demo(SceneOptions):
    """Turn a cube with each controller; table, video and report.

    In-grasp manipulation, contact switching, gaiting with a random finger, the coordinated gait
    and, where one comes with dexctl for the hand, the gait that a policy learned from it each get
    one trial from the same start. The folder then holds report.html (open it in a
    browser; it needs nothing beside it), demo.mp4, key frames and picture.png. Takes less than
    two minutes, most of it drawing the video; without OpenGL everything else is made.
    """

    out: Path = Path("out")
    """Folder for the files."""
    seconds: float = 10.0
    """Simulated time of each controller [s]."""
    seed: int = 0
    """Seed of the trials."""
    no_video: bool = False
    """Make no video; key frames are drawn all the same."""
    json: bool = False
    """Print one JSON object instead of the table."""

    def run(self) -> int:
        check_seconds(self.seconds, CONTROL_PERIOD)
        check_viz("dexctl demo")
        folder = make_folder(self.out)
        scene = self.build_scene()
        work = _Work(self, folder, scene)
        try:
            work.simulate()
            if not self.json:
                work.print_table()
            work.draw_key_frames()
        except KeyboardInterrupt:
            if work.trials:
                work.console.print("interrupted: writing the report of what is done")
                work.write_report("Interrupted: what follows is what was done until then.")
            raise
        work.write_report()
        if not self.no_video and work.can_draw:
            work.draw_video()
        if self.json:
            print_json(work.as_dict())
        else:
            named = [path.name for path in work.files if path.name in _NAMED]
            frames = len(work.files) - len(named)
            also = f" and {frames} key frames" if frames else ""
            results().print(f"\nin {folder}: {', '.join(named)}{also}", soft_wrap=True)
        return 0


@dataclass
class _Work:
    """What the demo has done so far."""

    demo: Demo
    folder: Path
    scene: Scene
    console: Console = field(default_factory=notes)
    trials: dict[str, Trial] = field(default_factory=dict)
    stills: dict[float, np.ndarray] = field(default_factory=dict)
    files: list[Path] = field(default_factory=list)
    can_draw: bool = False
    drawing_time: float = 0.1  # of one picture [s]
    document: str = ""

    def simulate(self) -> None:
        from dexctl.report.demo import Trial
        from dexctl.report.film import Film
        from dexctl.report.summary import summarise
        from dexctl.sim import BatchSimulator

        demo = self.demo
        with BatchSimulator(self.scene, None, CONTROL_PERIOD) as sim, progress(self.console) as bar:
            demo.set_friction(sim)
            for name, controller in self._controllers():
                task = bar.add_task(f"simulating {name}", total=demo.seconds)
                film = Film()
                trace = run_trials(
                    controller,
                    sim,
                    demo.seconds,
                    demo.seed,
                    observers=[film],
                    progress=lambda now, task=task: bar.update(task, completed=now),
                )
                self.trials[name] = Trial(name, trace, summarise(trace), film)

    def _controllers(self) -> Iterator[tuple[str, Controller]]:
        """Each controller by name; the learned one only where it knows this hand."""
        for name in CONTROLLERS:
            try:
                yield name, make_controller(name, self.scene)
            except (SimulationError, UnknownName, RoomShadowed) as error:
                if name != "learned":
                    raise
                self.console.print(f"nothing learned: {error}", markup=False)

    @property
    def best(self) -> Trial:
        """The trial that the picture shows: the last one."""
        return list(self.trials.values())[-1]

    def print_table(self) -> None:
        from rich.markup import escape
        from rich.table import Table

        from dexctl.report.demo import HEADINGS, row

        demo = self.demo
        console = results()
        console.print(
            f"[bold]{demo.hand} turns a {demo.object}, {demo.palm}: one trial of "
            f"{demo.seconds:g} s each, seed {demo.seed}[/bold]"
        )
        table = Table(box=None, padding=(0, 1, 0, 0), pad_edge=False)
        for i, lines in enumerate(HEADINGS):
            justify = "right" if i else "left"
            table.add_column(escape("\n".join(lines)), justify=justify, no_wrap=True)
        for trial in self.trials.values():
            table.add_row(*row(trial))
        console.print(table)

    def draw_key_frames(self) -> None:
        """Stills for the report; where there is no OpenGL, says how to get one and draws none."""
        from dexctl.files import write_bytes
        from dexctl.report.demo import key_times
        from dexctl.report.picture import png

        self.console.print("looking for an OpenGL to draw with", style="dim")
        try:
            recorder = self._recorder(None, STILL_SIZE)
        except SimulationError as error:
            self.console.print(f"no video and no pictures: {error}", markup=False)
            return
        self.can_draw = True
        total = KEY_FRAMES * len(self.trials) + PICTURE_FRAMES
        with recorder, progress(self.console) as bar:
            task = bar.add_task("drawing key frames", total=total)
            for trial in self.trials.values():
                for i, time in enumerate(key_times(trial.trace, KEY_FRAMES)):
                    path = self.folder / f"{trial.name}_{i}.png"
                    recorder(trial.film.at(time))
                    trial.pictures[time] = png(recorder.picture())
                    write_bytes(path, trial.pictures[time])
                    self.files.append(path)
                    bar.advance(task)
            best = self.best
            start = perf_counter()
            for time in key_times(best.trace, PICTURE_FRAMES):
                recorder(best.film.at(time))
                self.stills[time] = recorder.picture()
                bar.advance(task)
            self.drawing_time = (perf_counter() - start) / PICTURE_FRAMES

    def write_report(self, *remarks: str) -> None:
        from dexctl.files import write_bytes, write_text
        from dexctl.report.demo import build
        from dexctl.report.machine import machine
        from dexctl.report.picture import compose
        from dexctl.report.style import title_of

        self.console.print("writing the report", style="dim")
        demo, path = self.demo, self.folder / "report.html"
        setting = {**demo.describe(self.scene), "seconds": demo.seconds, "seed": demo.seed}
        document = build(
            self.trials,
            setting=setting,
            control_period=CONTROL_PERIOD,
            command=demo.command_line("demo"),
            machine=machine(),
            remarks=remarks,
        )
        write_text(path, document)
        self.document = document
        self.files.append(path)
        if self.stills:
            trial = self.best
            title = f"{demo.hand} turning a {demo.object}: {title_of(trial.name)}"
            path = self.folder / "picture.png"
            write_bytes(path, compose(trial.trace, self.stills, title))
            self.files.append(path)

    def draw_video(self) -> None:
        from dexctl.files import write_text
        from dexctl.report.html import with_video
        from dexctl.report.style import title_of

        path = self.folder / "demo.mp4"
        lengths = {
            name: min(self.demo.seconds, trial.summary.time_held + AFTER_DROP)
            for name, trial in self.trials.items()
        }
        pictures = DRAWING_BUDGET / self.drawing_time / sum(lengths.values())
        fps = float(np.clip(np.floor(pictures), 4.0, FPS))
        if fps < FPS:
            self.console.print(
                f"drawing takes {self.drawing_time:.2f} s a picture here: {fps:g} a second "
                f"instead of {FPS:g}"
            )
        recorder = self._recorder(path, VIDEO_SIZE, fps)
        with recorder, progress(self.console) as bar:
            for name, trial in self.trials.items():
                task = bar.add_task(f"drawing {name}", total=lengths[name])
                trial.film.play(
                    recorder,
                    captions(title_of(name), trial.trace),
                    until=lengths[name],
                    progress=lambda now, task=task: bar.update(task, completed=now),
                )
        self.files.append(path)
        title = "Each controller turning the object, one after the other"
        write_text(self.folder / "report.html", with_video(self.document, path.read_bytes(), title))

    def as_dict(self) -> dict[str, Any]:
        from dexctl.report.machine import machine

        return {
            "command": "demo",
            **self.demo.describe(self.scene),
            "seconds": self.demo.seconds,
            "control_period_s": CONTROL_PERIOD,
            "seed": self.demo.seed,
            "controllers": {name: t.summary.as_dict() for name, t in self.trials.items()},
            "files": [str(path) for path in self.files],
            "machine": machine(),
        }

    def _recorder(self, path: Path | None, size: tuple[int, int], fps: float = FPS) -> Recorder:
        from dexctl.sim.record import Recorder

        return Recorder(self.scene, path, fps=fps, width=size[0], height=size[1])
