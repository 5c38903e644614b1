"""``dexctl inspect``: how a policy or a controller gaits, why it drops, and how it was trained."""

from __future__ import annotations

import shlex
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from dexctl import controllers
from dexctl.cli.output import notes, print_json, progress, results, to_json
from dexctl.cli.parsing import check_count, check_seconds, make_folder, parse_gravity
from dexctl.cli.trials import check_viz
from dexctl.exceptions import InvalidInput, UnknownName

if TYPE_CHECKING:
    from rich.progress import TaskID

    from learning.inspection import Inspection, Subject


@dataclass(kw_only=True)
class Inspect:
    """Show how a policy gaits, why it drops, and who acted while it was trained.

    It is rolled out in the protocol of `dexctl evaluate`, with controllers in shadow: asked in
    every state what they would do. Writes report.html (one file, nothing to load) and inspect.json.
    """

    subject: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="RUN_OR_POLICY")]
    """A run folder, a policy file (.npz), or the name of a controller in the policy's place."""
    controller: tuple[str, ...] | None = None
    """Controllers to compare with; by default those that guided the training."""
    object: str | None = None
    """Name of the object; by default the first that it was trained with, or cube."""
    gravity: str | None = None
    """Which way the palm looks: up, down, or gravity as x,y,z in m/s^2; by default as trained."""
    hand: str | None = None
    """Name of the hand; by default the policy's own, and dex5 for a controller."""
    episodes: int = 16
    """How many."""
    seconds: float = 60.0
    """Simulated time of each [s]."""
    seed: int = 0
    """Seed of the first episode; episode i has seed + i."""
    out: Path = Path("out/inspect")
    """Folder for report.html and inspect.json."""
    json: bool = False
    """Print one JSON object instead of the summary."""

    def run(self) -> int:
        check_count("--episodes", self.episodes)
        if self.seed < 0:
            raise InvalidInput(f"--seed is {self.seed}; expected a whole number from 0 on")
        for name in self.controller or ():
            controllers.entry(name)
        check_viz("dexctl inspect")
        from dexctl.sim import object_names
        from learning.evaluate import Protocol
        from learning.inspection import inspect, open_subject

        if self.object is not None and self.object not in object_names():
            raise UnknownName("object", self.object, object_names())
        subject = open_subject(self.subject, self.hand)
        check_seconds(self.seconds, subject.controller.control_period)
        name, gravity = self._object(subject), self._gravity(subject)
        protocol = Protocol(
            episodes=self.episodes,
            seconds=self.seconds,
            seed=self.seed,
            gravity=parse_gravity(gravity) if isinstance(gravity, str) else gravity,
        )
        folder = make_folder(self.out)
        with _Bar() as bar:
            for remark in self._remarks(subject, name):
                bar.remark(remark)
            found = inspect(subject, name, protocol, self.controller, progress=bar.show)
            result = self._write(folder, found, gravity)
        if self.json:
            print_json(result)
        else:
            self._print(found, folder)
        return 0

    def _object(self, subject: Subject) -> str:
        return self.object or next(iter(subject.objects), "cube")

    def _gravity(self, subject: Subject) -> str | tuple[float, ...]:
        if self.gravity is not None:
            return self.gravity
        trained = subject.trained.get("env", {}).get("gravity", "up")
        return trained if isinstance(trained, str) else tuple(trained)

    def _remarks(self, subject: Subject, name: str) -> list[str]:
        remarks = list(subject.remarks)
        if subject.objects and name not in subject.objects:
            remarks.append(
                f"The policy was trained with {', '.join(subject.objects)}, not with {name}."
            )
        return remarks

    def _write(
        self, folder: Path, found: Inspection, gravity: str | tuple[float, ...]
    ) -> dict[str, Any]:
        from dexctl.files import write_text
        from dexctl.report.machine import machine
        from learning.inspection.report import build

        scene = found.rollouts.scene
        palm = f"palm {gravity}" if gravity in ("up", "down") else f"gravity {gravity}"
        setting = {
            "palm": palm,
            "hand": scene.hand.path.stem,
            "object": found.rollouts.evaluation.object,
            "gravity_m_s2": scene.gravity.tolist(),
            "object_width_m": scene.object_width,
            "object_mass_kg": scene.object_mass,
            "friction": found.grasps.friction,
            "seed": self.seed,
        }
        told = machine()
        report, figures = folder / "report.html", folder / "inspect.json"
        result = {
            "command": "inspect",
            "setting": setting,
            "episodes_count": self.episodes,
            "seconds": self.seconds,
            "control_period_s": found.period,
            **found.to_dict(),
            "files": {"report": str(report), "figures": str(figures)},
            "machine": told,
        }
        page = build(found, setting=setting, command=self._command_line(), machine=told)
        write_text(figures, to_json(result) + "\n")
        write_text(report, page)
        return result

    def _command_line(self) -> str:
        """What to type to get the same again."""
        words = ["dexctl", "inspect", self.subject]
        for option in fields(self):
            value = getattr(self, option.name)
            if option.default is MISSING or value == option.default or option.name == "json":
                continue
            values = value if isinstance(value, tuple) else (value,)
            words += [f"--{option.name}", *map(str, values)]
        return shlex.join(words)

    def _print(self, found: Inspection, folder: Path) -> None:
        from learning.inspection.report.story import story
        from learning.inspection.report.words import percent

        console = results()
        figures = found.rollouts.evaluation.figures()
        rotation = figures["rotation_median_rad"]
        console.print(
            f"[bold]{self.subject}: {found.rollouts.evaluation.object}[/bold]\n"
            f"rotation {rotation.value:.2f} rad ({rotation.low:.2f} to {rotation.high:.2f}), "
            f"dropped {percent(figures['share_dropped'].value)}, sound grasp "
            f"{percent(found.grip()['sound_share'])} of the time held",
            soft_wrap=True,
        )
        for line in story(found):
            console.print(line, soft_wrap=True)
        notes().print(f"written: {folder / 'report.html'} and {folder / 'inspect.json'}")


class _Bar:
    """One progress bar for each thing that takes time."""

    def __init__(self) -> None:
        self._console = notes()
        self._progress = progress(self._console)
        self._tasks: dict[str, TaskID] = {}

    def __enter__(self) -> _Bar:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def show(self, what: str, share: float) -> None:
        """``share`` of ``what`` is done."""
        if what not in self._tasks:
            self._tasks[what] = self._progress.add_task(what, total=1.0)
        self._progress.update(self._tasks[what], completed=share)

    def remark(self, text: str) -> None:
        """A line above the bars."""
        self._console.print(f"dexctl: {text}", markup=False)
