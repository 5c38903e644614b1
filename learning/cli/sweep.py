"""``dexctl sweep``: methods x controllers x seeds from one file, and their table."""

from __future__ import annotations

import os
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from dexctl.cli.checks import check_count, make_folder
from dexctl.cli.interrupts import terminated_like_interrupted
from dexctl.cli.output import notes, print_json, results, to_json
from dexctl.cli.output import table as without_lines
from dexctl.cli.parsing import Switch
from dexctl.exceptions import InvalidInput, MissingExtra
from dexctl.locking import locked

if TYPE_CHECKING:
    from learning.sweep.cluster import RayPool
    from learning.sweep.config import SweepConfig
    from learning.sweep.process import LocalPool


@dataclass(kw_only=True)
class Sweep:
    """Train methods with controllers over seeds, side by side, and make the table of them.

    Each run is a folder as `dexctl train` makes it, in a process of its own. A sweep that was
    killed goes on when it is started again: what is finished stays, what was begun is resumed, what
    failed is tried again. The exit code is 1 where a run failed.
    """

    config: Annotated[Path, tyro.conf.Positional]
    """The sweep, a TOML file (see `docs/learning.md`); or the folder of one that was begun."""
    out: Path | None = None
    """Folder of the sweep; by default runs/NAME, with the file's name."""
    jobs: int | None = None
    """Runs at once; by default as many as there are cores."""
    ray: str | None = None
    """Give the runs to the Ray cluster at this address ("auto": one on this machine)."""
    steps: int | None = None
    """Environment steps of each run, in place of the file's."""
    seed: int = 0
    """Added to every seed in the file."""
    report_only: Switch = False
    """Run nothing; make the table and the figure of what is there."""
    json: Switch = False
    """Print the results as one JSON object instead of the table."""

    def run(self) -> int:
        if self.jobs is not None:
            check_count("--jobs", self.jobs)
        if not self.report_only and not find_spec("torch"):
            raise MissingExtra("dexctl sweep", "learning")
        from learning.sweep.run import check, prepare, reopen, run_all

        given = self.config.expanduser()
        if given.is_dir():
            if self.out is not None or self.steps is not None or self.seed:
                raise InvalidInput(
                    f"{given} is a folder, which has its sweep; --out, --steps and --seed go with "
                    "a file"
                )
            config, folder = reopen(given), make_folder(given)
        else:
            from learning.sweep.reading import load_sweep

            config = load_sweep(given, seed=self.seed, steps=self.steps)
            folder = make_folder(self.out or Path("runs") / given.stem)
        if self.report_only:  # at any time, while the sweep is at work too
            check(config, folder)
            return self._report(config, folder)
        with locked(folder):
            prepare(config, folder)
            from learning.cli.sweep_display import Display

            total = len(config.runs) + len(config.compared)
            try:
                with self._pool() as pool, Display(total) as lines, terminated_like_interrupted():
                    run_all(config, folder, pool, watch=lines.show)
            except KeyboardInterrupt:
                raise KeyboardInterrupt(
                    f"interrupted: what was begun is saved; `dexctl sweep {folder}` goes on"
                ) from None
            return self._report(config, folder)

    def _pool(self) -> LocalPool | RayPool:
        if self.ray is not None:
            from learning.sweep.cluster import RayPool

            return RayPool(self.ray, self.jobs)
        from learning.sweep.process import LocalPool

        usable = getattr(os, "sched_getaffinity", None)
        return LocalPool(self.jobs or (len(usable(0)) if usable else os.cpu_count() or 1))

    def _report(self, config: SweepConfig, folder: Path) -> int:
        """Write and print what there is; 1 where something failed."""
        from dexctl.files import write_text
        from dexctl.report.machine import machine
        from learning.cli.sweep_figure import draw
        from learning.sweep.results import collect, write_csv
        from learning.sweep.table import caption, markdown_table

        found = {**collect(config, folder), "machine": machine()}
        write_text(folder / "results.json", to_json(found) + "\n")
        write_csv(folder / "results.csv", found)
        text = f"{markdown_table(found)}\n\n{caption(found)}\n"
        write_text(folder / "table.md", text)
        files = [folder / name for name in ("results.json", "results.csv", "table.md")]
        try:
            files += draw(config, folder)
        except MissingExtra as error:
            notes().print(f"dexctl: no figure: {error}")
        if self.json:
            print_json(found)
        else:
            _print(found)
        notes().print(f"written: {', '.join(map(str, files))}")
        return _failures(found, folder)


def _print(found: dict[str, Any]) -> None:
    from learning.sweep.table import caption, table

    console = results()
    header, rows = table(found, titles=False)
    shown = without_lines(*header, gap=2)
    for row in rows:
        shown.add_row(*row)
    console.print(f"{found['name']}\n", style="bold")
    console.print(shown)
    console.print(f"\n{caption(found)}")


def _failures(found: dict[str, Any], folder: Path) -> int:
    """Say what failed, each in a line."""
    named = [(f"runs/{run['name']}", run) for run in found["runs"]]
    named += [(f"controllers/{name}", one) for name, one in found["controllers"].items()]
    failed = [(name, one["error"]) for name, one in named if one["state"] == "failed"]
    console = notes()
    for name, error in failed:
        console.print(f"dexctl: {name} failed: {error}")
    if failed:
        console.print(
            f"dexctl: {len(failed)} failed; `dexctl sweep {folder}` tries again, from the last "
            "checkpoint, or from the beginning where the run's folder has been removed",
        )
    return 1 if failed else 0
