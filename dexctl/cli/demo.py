"""``dexctl demo``: every controller turns the same object; table, video and report."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from dexctl import controllers
from dexctl.cli.checks import check_seconds, make_folder
from dexctl.cli.command_line import command_line
from dexctl.cli.output import notes, print_json, progress, results, table
from dexctl.cli.parsing import Switch
from dexctl.cli.trials import (
    captions,
    check_viz,
    describe,
    make_controller,
    run_trials,
    scene_of,
    simulation,
)
from dexctl.exceptions import RoomShadowed, SimulationError, UnknownName
from dexctl.settings import NESTED, Vector
from dexctl.sim import SceneConfig
from dexctl.validation import unit_axis

if TYPE_CHECKING:
    from rich.console import Console

    from dexctl.controller import Controller
    from dexctl.report.demo import Trial
    from dexctl.sim import Scene, Simulation
    from dexctl.sim.record import Recorder

CONTROLLERS = ("igm", "switch", "gait", "coordinated", controllers.POLICIES)
KEY_FRAMES, PICTURE_FRAMES = 4, 6
_NAMED = ("report.html", "picture.png", "demo.mp4")
FPS, VIDEO_SIZE, STILL_SIZE = 15.0, (640, 480), (800, 600)
DRAWING_BUDGET = 90.0  # a slower machine draws fewer pictures a second, to be done in this time [s]
AFTER_DROP = 1.5  # the film goes on for so long after a drop [s]


@dataclass(kw_only=True)
class Demo:
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
    axis: Vector = "z"
    """Of the hand, about which the object is turned: x, y, z, -x, -y, -z, or x,y,z."""
    seed: int = 0
    """Seed of the trials."""
    no_video: Switch = False
    """Make no video; key frames are drawn all the same."""
    json: Switch = False
    """Print one JSON object instead of the table."""
    scene: Annotated[SceneConfig, NESTED] = field(default_factory=SceneConfig)

    def run(self) -> int:
        check_seconds(self.seconds, self.scene.control_period)
        unit_axis(self.axis)
        check_viz("dexctl demo")
        folder = make_folder(self.out)
        with simulation(self.scene, 1, self.seed) as sim:
            return self._run(_Work(self, folder, scene_of(sim)), sim)

    def _run(self, work: _Work, sim: Simulation) -> int:
        try:
            work.simulate(sim)
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
            results().print(f"\nin {work.folder}: {', '.join(named)}{also}", soft_wrap=True)
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

    def simulate(self, sim: Simulation) -> None:
        from dexctl.report.demo import Trial
        from dexctl.report.film import Film
        from dexctl.report.summary import summarise

        demo = self.demo
        with progress(self.console) as bar:
            for name, controller in self._controllers(sim):
                task = bar.add_task(f"simulating {name}", total=demo.seconds)
                film = Film()
                trace = run_trials(
                    controller,
                    sim,
                    demo.seconds,
                    demo.seed,
                    axis=demo.axis,
                    observers=[film],
                    progress=lambda now, task=task: bar.update(task, completed=now),
                ).trial(0)
                self.trials[name] = Trial(name, trace, summarise(trace), film)

    def _controllers(self, sim: Simulation) -> Iterator[tuple[str, Controller]]:
        """Each controller by name; the learned one only where it knows this hand."""
        config, axis = self.demo.scene, self.demo.axis
        for name in CONTROLLERS:
            try:
                controller = make_controller(name, sim.hand, config, axis)
            except (SimulationError, UnknownName, RoomShadowed) as error:
                if name != controllers.POLICIES:
                    raise
                self.console.print(f"nothing learned: {error}")
                continue
            if np.isclose(controller.control_period, config.control_period):
                yield name, controller
            else:
                self.console.print(
                    f"nothing learned: the policy has a control period of "
                    f"{controller.control_period:g} s, not {config.control_period:g} s"
                )

    @property
    def best(self) -> Trial:
        """The trial that the picture shows: the last one."""
        return list(self.trials.values())[-1]

    def print_table(self) -> None:
        from dexctl.report import words
        from dexctl.report.demo import HEADINGS, row

        demo = self.demo
        console = results()
        console.print(
            f"{demo.scene.hand_name} turns a {self.scene.object} {words.about(demo.axis)}, "
            f"{demo.scene.palm}: one trial of {demo.seconds:g} s each, seed {demo.seed}",
            style="bold",
            soft_wrap=True,
        )
        first, *others = ("\n".join(lines) for lines in HEADINGS)
        shown = table(first, *others, right=others, gap=1, wrap=False)
        for trial in self.trials.values():
            shown.add_row(*row(trial))
        console.print(shown)

    def draw_key_frames(self) -> None:
        """Stills for the report; where there is no OpenGL, says how to get one and draws none."""
        from dexctl.files import write_bytes
        from dexctl.report.demo import key_times
        from dexctl.report.picture import png

        self.console.print("looking for an OpenGL to draw with", style="dim")
        try:
            recorder = self._recorder(None, STILL_SIZE)
        except SimulationError as error:
            self.console.print(f"no video and no pictures: {error}")
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
        document = build(
            self.trials,
            config=demo.scene,
            scene=self.scene,
            axis=demo.axis,
            seconds=demo.seconds,
            seed=demo.seed,
            command=command_line(demo, "demo"),
            machine=machine(),
            remarks=remarks,
        )
        write_text(path, document)
        self.document = document
        self.files.append(path)
        if self.stills:
            trial = self.best
            title = f"{demo.scene.hand_name} turning a {self.scene.object}: {title_of(trial.name)}"
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
            **describe(self.demo.scene, self.scene),
            "axis": unit_axis(self.demo.axis),
            "seconds": self.demo.seconds,
            "seed": self.demo.seed,
            "controllers": {name: t.summary.as_dict() for name, t in self.trials.items()},
            "files": [str(path) for path in self.files],
            "machine": machine(),
        }

    def _recorder(self, path: Path | None, size: tuple[int, int], fps: float = FPS) -> Recorder:
        from dexctl.sim.record import Recorder

        return Recorder(self.scene, path, fps=fps, width=size[0], height=size[1])
