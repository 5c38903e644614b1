"""``dexctl train``: trains a policy that explores with the controllers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Self

from dexctl.cli.checks import make_folder
from dexctl.cli.output import notes, print_json, results
from dexctl.cli.parsing import Switch, check_conditions, given, is_given, said
from dexctl.controllers import label
from dexctl.exceptions import InvalidInput, MissingExtra
from dexctl.settings import NESTED, difference, to_plain
from learning.config import TrainConfig, recipe

if TYPE_CHECKING:
    from rich.progress import TaskID

RECIPE = "fast"


@dataclass(kw_only=True)
class Train:
    """Train a policy that explores with the controllers; it can be killed and resumed.

    Prints where the policy is. `dexctl train --resume RUN` goes on with a run that was killed.
    The defaults below are those of the recipe; `--recipe thesis --help` shows the thesis's.
    """

    short: ClassVar[Mapping[str, str]] = {
        "--controller": "--controllers",
        "--hand": "--env.hand",
        "--object": "--env.object",
        "--gravity": "--env.gravity",
    }

    recipe: str = RECIPE
    """Where the defaults come from: fast, which learns to gait within 1 million steps, thesis, or
    distil, which makes one policy of controllers and other policies."""
    config: Annotated[TrainConfig, NESTED] = TrainConfig()
    conditions: tuple[str, ...] = ()
    """Named ranges and limits, as `dexctl evaluate` takes them, or a .toml of settings, such as the
    ranges that `dexctl hardware identify` writes. What is typed beside them counts."""
    out: Path | None = None
    """Folder of the run; by default runs/METHOD-CONTROLLERS-OBJECT-SEED."""
    resume: Path | None = None
    """Folder of a run to go on with; of the other options only --steps and --json count."""
    json: Switch = False
    """Print the last figures as JSON."""

    @classmethod
    def defaults(cls, argv: Sequence[str]) -> Self:
        """The recipe's settings under the conditions, or those of the run that is resumed."""
        name, run = given(argv, "--recipe") or RECIPE, given(argv, "--resume")
        if run is not None:
            return cls(recipe=name, config=_config_of(Path(run)))
        config = recipe(name, given(argv, "--method"))
        before = said(cls, argv) if is_given(argv, "--conditions") else None
        if before is not None:
            check_conditions(argv, before.conditions)
            from dexctl.sim.conditions import under

            scene = under(config.env.scene, *before.conditions)
            config = replace(config, env=replace(config.env, scene=scene))
        return cls(recipe=name, config=config)

    def run(self) -> int:
        if find_spec("torch") is None:
            raise MissingExtra("dexctl train", "learning")
        config = self.config
        if self.resume is None:
            config.env.scene.check_objects()
            folder = (self.out or self._folder()).expanduser()
        else:
            if self.conditions:
                raise InvalidInput(
                    f"with --resume, only --steps may be given: got --conditions "
                    f"{' '.join(self.conditions)}"
                )
            folder = self.resume.expanduser()
            before = to_plain(replace(_config_of(folder), steps=config.steps))
            other = difference(before, to_plain(config))
            if other is not None:
                raise InvalidInput(f"with --resume, only --steps may be given: {other}")
        from learning.training.trainer import resume, train  # slow to import, so after the checks

        with _Bar(config.steps) as bar:
            if self.resume is None:
                make_folder(folder)
                found = train(config, folder, report=bar.show, remark=bar.remark)
            else:
                bar.remark(f"the run is kept in {folder}")
                found = resume(folder, config.steps, report=bar.show, remark=bar.remark)
        if self.json:
            print_json({"command": "train", "folder": str(folder), **found})
        else:
            results().print(
                f"policy: {found['policy']}, after {found['steps']} steps", soft_wrap=True
            )
        return 0

    def _folder(self) -> Path:
        """Where the run goes, by what it does."""
        config = self.config
        guides = map(label, config.guides)
        words = (config.guidance.method, *guides, *config.env.scene.object, config.seed)
        return Path("runs") / "-".join(map(str, words))


def _config_of(folder: Path) -> TrainConfig:
    from learning.training.run_folder import RunFolder

    return RunFolder(folder.expanduser()).config()


class _Bar:
    """The progress bar: steps, the figures of the last row, and the time left."""

    def __init__(self, total: int) -> None:
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

        self._console = notes()
        self._progress = Progress(
            TextColumn("{task.percentage:>3.0f} %"),
            BarColumn(bar_width=8),
            TextColumn("{task.description}", markup=False),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=self._console,
            speed_estimate_period=120.0,
        )
        self._total = total
        self._task: TaskID | None = None

    def __enter__(self) -> _Bar:
        return self

    def __exit__(self, *_: object) -> None:
        if self._task is not None:  # an error before the first step is one line, nothing above it
            self._progress.stop()

    def show(self, step: int, row: Mapping[str, float]) -> None:
        """Called after each step of all environments."""
        if self._task is None:  # a resumed run does not start at 0
            self._task = self._progress.add_task("", total=self._total, completed=step)
            self._progress.start()
        self._progress.update(self._task, completed=step, description=_figures(row))

    def remark(self, text: str) -> None:
        """A line above the bar."""
        self._console.print(f"dexctl: {text}")


def _figures(row: Mapping[str, Any]) -> str:
    """The last row of the log in a few words."""
    words = []
    if "return" in row:
        words += [
            f"return {row['return']:.1f}",
            f"goals {row['goals']:.1f}" if "goals" in row else f"turned {row['rotation']:.2f} rad",
            f"drop {100 * row['dropped']:.0f} %",
        ]
    if "controller_share" in row:
        words.append(f"ctrl {100 * row['controller_share']:.0f} %")
    return "  ".join(words)
