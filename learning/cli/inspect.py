"""``dexctl inspect``: how a policy or a controller gaits, why it drops, and how it was trained."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Self

import tyro

from dexctl import controllers
from dexctl.cli.checks import check_seconds, make_folder
from dexctl.cli.command_line import command_line
from dexctl.cli.output import notes, print_json, progress, results, to_json
from dexctl.cli.parsing import Switch, given, said
from dexctl.cli.trials import check_viz, describe
from dexctl.exceptions import InvalidInput
from dexctl.settings import NESTED
from learning.evaluation.protocol import Protocol

if TYPE_CHECKING:
    from rich.progress import TaskID

    from learning.inspection import Inspection

EPISODES = 16


@dataclass(kw_only=True)
class Inspect:
    """Show how a policy gaits, why it drops, and who acted while it was trained.

    It is rolled out as by `dexctl evaluate`, with controllers in shadow: asked in every state what
    they would do. Writes report.html (one file, nothing to load) and inspect.json. The defaults
    below are what the policy was trained in, but without noise, late sensors, pushes and given
    starts, and with the first of its objects.
    """

    subject: Annotated[
        str | None,
        tyro.conf.Positional,
        tyro.conf.arg(metavar="RUN_OR_POLICY", help_behavior_hint=""),
    ] = None
    """A run folder, a policy by name or file, or the name of a controller in the policy's place."""
    protocol: Annotated[Protocol, NESTED] = field(
        default_factory=lambda: Protocol(episodes=EPISODES)
    )
    controller: tuple[str, ...] = ()
    """Controllers to compare with; none: those that guided the training."""
    out: Path = Path("out/inspect")
    """Folder for report.html and inspect.json."""
    json: Switch = False
    """Print one JSON object instead of the summary."""

    deciding: ClassVar[tuple[str, ...]] = ("--subject", "--hand")

    @classmethod
    def defaults(cls, argv: Sequence[str]) -> Self:
        """The settings that the policy was trained in."""
        before = said(cls, argv)
        if before is None or before.subject is None:
            return cls()
        from learning.evaluation import open_subject

        subject = open_subject(before.subject, hand=given(argv, "--hand"))
        own = subject.objects[:1] or ("cube",)
        return cls(protocol=subject.protocol(episodes=EPISODES, object=own))

    def run(self) -> int:
        check_viz("dexctl inspect")
        from learning.evaluation import open_subject
        from learning.evaluation.rollout import one_object
        from learning.inspection import inspect

        if self.subject is None:
            raise InvalidInput("expected a run folder, a policy, or the name of a controller")
        protocol = self.protocol
        check_seconds(protocol.seconds, protocol.scene.control_period)
        one_object(protocol)
        protocol.scene.check_objects()
        subject = open_subject(self.subject, hand=protocol.scene.hand)
        for name in self.controller:
            controllers.resolve(name, subject.controller.hand)
        folder = make_folder(self.out)
        with _Bar() as bar:
            if remark := subject.remark(protocol):
                bar.remark(remark)
            found = inspect(subject, protocol, self.controller, progress=bar.show)
            for remark in found.remarks:
                bar.remark(remark)
        result = self._write(folder, found)
        if self.json:
            print_json(result)
        else:
            self._print(found, folder)
        return 0

    def _write(self, folder: Path, found: Inspection) -> dict[str, Any]:
        from dexctl.files import write_text
        from dexctl.report.machine import machine
        from learning.inspection.report import build

        setting = describe(self.protocol.scene, found.rollouts.scene)
        del setting["scene"]  # it is in the protocol
        told = machine()
        report, figures = folder / "report.html", folder / "inspect.json"
        result = {
            "command": "inspect",
            "setting": setting,
            **found.to_dict(),
            "files": {"report": str(report), "figures": str(figures)},
            "machine": told,
        }
        page = build(found, command=command_line(self, "inspect"), machine=told)
        write_text(figures, to_json(result) + "\n")
        write_text(report, page)
        return result

    def _print(self, found: Inspection, folder: Path) -> None:
        from dexctl.report.words import percent
        from learning.inspection.report.story import story

        console = results()
        figures = found.rollouts.evaluation.figures()
        rotation = figures["rotation_median_rad"]
        console.print(
            f"{self.subject}: {found.rollouts.evaluation.object}", style="bold", soft_wrap=True
        )
        console.print(
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
        self._console.print(f"dexctl: {text}")
