"""``dexctl rotate``: many trials of one controller turning one object."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from dexctl import hands
from dexctl.cli.checks import check_count, check_seconds, make_folder
from dexctl.cli.command_line import command_line
from dexctl.cli.output import notes, print_json, progress, results, table, to_json
from dexctl.cli.parsing import Switch
from dexctl.cli.trials import (
    captions,
    check_viz,
    describe,
    make_controller,
    paced,
    run_trials,
    scene_of,
    simulation,
)
from dexctl.exceptions import InvalidInput
from dexctl.limits import HandLimits
from dexctl.settings import NESTED, Vector
from dexctl.sim import SceneConfig
from dexctl.validation import unit_axis

if TYPE_CHECKING:
    from dexctl.controller import Controller
    from dexctl.report.film import Film
    from dexctl.report.summary import BatchSummary
    from dexctl.sim import Scene, Simulation, Trace


@dataclass(kw_only=True)
class Rotate:
    """Turn an object with one controller, many trials at once.

    An object whose centre moves by more than 0.05 m is dropped; the rotation is the unwrapped
    angle about the axis up to the drop.
    """

    controller: str = "coordinated"
    """Name of the controller (igm, switch, gait, coordinated, hold; planned:FILE follows a tree of
    dexctl plan), or a policy: learned, its name (dex5-cylinder), its file (.npz), its run folder;
    or module:function."""
    axis: Vector = "z"
    """Of the hand, about which the object is turned: x, y, z, -x, -y, -z, or x,y,z."""
    seconds: float = 10.0
    """Simulated time of each trial [s]."""
    num_envs: int = 64
    """How many trials."""
    seed: int = 0
    """Seed of the first trial; trial i has seed + i."""
    out: Path | None = None
    """Folder for rotate.json and report.html (and rotate.mp4)."""
    json: Switch = False
    """Print one JSON object instead of the table."""
    video: Switch = False
    """Record the first trial to rotate.mp4 (wants --out and an OpenGL)."""
    viewer: Switch = False
    """Show the first trial in MuJoCo's viewer, in real time (wants a display)."""
    as_real: Switch = False
    """Limits of the thesis's hand where no other is given: 0.6 rad/s, 0.5 N m, 0.05 s."""
    scene: Annotated[SceneConfig, NESTED] = field(default_factory=SceneConfig)

    deciding: ClassVar[tuple[str, ...]] = ("--as-real",)

    @classmethod
    def defaults(cls, arguments: Sequence[str]) -> Rotate:
        """With the limits of the real hand where they are asked for."""
        limits = HandLimits.real() if "--as-real" in arguments else HandLimits()
        return cls(scene=SceneConfig(limits=limits))

    def run(self) -> int:
        check_seconds(self.seconds, self.scene.control_period)
        check_count("--num-envs", self.num_envs)
        if self.video and self.out is None:
            raise InvalidInput("--video is given without --out; expected a folder for rotate.mp4")
        if self.out is not None:
            check_viz("dexctl rotate --out")
        folder = None if self.out is None else make_folder(self.out)
        hand = hands.load(self.scene.hand)
        controller = make_controller(self.controller, hand, self.scene, self.axis)
        if controller.goes_to_goals:
            raise InvalidInput(
                f"{self.controller} acts only where it has a goal; expected a controller that "
                f"turns about an axis (`dexctl evaluate {self.controller}` gives goals)"
            )
        config = paced(self.scene, controller)
        with simulation(config, self.num_envs, self.seed, hand) as sim:
            from dexctl.report.film import Film
            from dexctl.report.summary import summarise_batch

            film, scene = Film(), scene_of(sim)
            trace = self._simulate(sim, controller, film)
        summary = summarise_batch(trace)
        found = self._as_dict(config, scene, summary)
        if folder is not None:
            self._write(folder, config, scene, trace, summary, found)
        if self.json:
            print_json(found)
        else:
            self._print(summary)
        if folder is not None and self.video:
            self._draw(folder, scene, trace, film)
        return 0

    def _simulate(self, sim: Simulation, controller: Controller, film: Film) -> Trace:
        with ExitStack() as stack:
            watch: list[Callable[[Any], None]] = []
            if self.video:
                watch.append(film)
            if self.viewer:
                from dexctl.sim.viewer import Viewer

                watch.append(stack.enter_context(Viewer(scene_of(sim))))
            bar = stack.enter_context(progress(notes()))
            task = bar.add_task(f"{self.controller}, {self.num_envs} trials", total=self.seconds)
            return run_trials(
                controller,
                sim,
                self.seconds,
                self.seed,
                axis=self.axis,
                observers=watch,
                progress=lambda now: bar.update(task, completed=now),
            )

    def _as_dict(self, config: SceneConfig, scene: Scene, summary: BatchSummary) -> dict[str, Any]:
        from dexctl.report.machine import machine

        return {
            "command": "rotate",
            "controller": self.controller,
            **describe(config, scene),
            "axis": unit_axis(self.axis),
            "seconds": self.seconds,
            "seeds": [self.seed, self.seed + self.num_envs - 1],
            **summary.as_dict(),
            "machine": machine(),
        }

    def _write(
        self,
        folder: Path,
        config: SceneConfig,
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
            config=config,
            scene=scene,
            axis=self.axis,
            seconds=self.seconds,
            seed=self.seed,
            command=command_line(self, "rotate"),
            machine=found["machine"],
        )
        write_text(folder / "report.html", document)
        notes().print(f"written: {folder / 'rotate.json'} and {folder / 'report.html'}")

    def _draw(self, folder: Path, scene: Scene, trace: Trace, film: Film) -> None:
        from dexctl.report.style import title_of
        from dexctl.sim.record import Recorder

        console, path = notes(), folder / "rotate.mp4"
        caption = captions(title_of(self.controller), trace.trial(0))
        with (
            Recorder(scene, path, width=640, height=480) as recorder,
            progress(console) as bar,
        ):
            task = bar.add_task("drawing the first trial", total=self.seconds)
            film.play(recorder, caption, progress=lambda now: bar.update(task, completed=now))
        console.print(f"written: {path}")

    def _print(self, summary: BatchSummary) -> None:
        from dexctl.report import words
        from dexctl.report.batch import figures_of_merit
        from dexctl.report.style import title_of

        title, scene = title_of(self.controller), self.scene
        console, shown = results(), table()
        console.print(
            f"{title}: {scene.hand_name} turns a {scene.object[0]} {words.about(self.axis)}, "
            f"{scene.palm}",
            style="bold",
            soft_wrap=True,
        )
        console.print(
            f"{self.num_envs} trials of {self.seconds:g} s, seeds {self.seed} to "
            f"{self.seed + self.num_envs - 1}; median (10 % to 90 %), share (95 % interval)\n",
            soft_wrap=True,
        )
        for what, value in figures_of_merit(summary):
            shown.add_row(what, value)
        console.print(shown)
