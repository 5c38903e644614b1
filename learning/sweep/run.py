"""A sweep in its folder: jobs go to a pool, and none that fails stops the others."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from dexctl.exceptions import DexctlError, InvalidInput
from dexctl.files import write_text
from learning.sweep.config import SweepConfig, difference
from learning.sweep.jobs import RUNS, Job, Outcome, jobs, outcome
from learning.training.run_folder import RunFolder

CONFIG = "sweep.json"
FORMAT = 2


class Pool(Protocol):
    """Where jobs are done, several at once."""

    places: int

    @property
    def running(self) -> list[Job]:
        """What is being done."""
        ...

    def start(self, job: Job) -> None:
        """Begin a job."""
        ...

    def wait(self, seconds: float) -> list[Job]:
        """Jobs that have ended meanwhile; returns at the latest after ``seconds``."""
        ...


def prepare(config: SweepConfig, out: Path) -> None:
    """Write down what the folder is for, or see that it is for the same.

    Raises:
        InvalidInput: it holds something else, or a sweep with other settings.
    """
    if (out / CONFIG).exists():
        check(config, out)
    elif (out / RUNS).exists() or RunFolder.is_run(out):
        raise InvalidInput(f"{out} holds something else; take another --out")
    content = {"format": FORMAT, **config.to_dict()}
    write_text(out / CONFIG, json.dumps(content, indent=2) + "\n")


def check(config: SweepConfig, out: Path) -> None:
    """See that the folder holds this sweep; ``config`` may have more runs.

    Raises:
        InvalidInput: it holds none, or one with other settings.
    """
    found = difference(_read(out / CONFIG), config.to_dict())
    if found is not None:
        raise InvalidInput(f"{out} holds a sweep with other settings: {found}; take another --out")


def reopen(out: Path) -> SweepConfig:
    """The sweep that a folder is for.

    Raises:
        InvalidInput: it holds none, or one that this version understands otherwise.
    """
    before = _read(out / CONFIG)
    try:
        config = SweepConfig.from_dict(before)
        found = difference(before, config.to_dict())
    except DexctlError as error:
        found = str(error)
    except (KeyError, TypeError, AttributeError) as error:
        raise InvalidInput(f"{out / CONFIG} is damaged: {error!r}") from None
    if found is not None:
        raise InvalidInput(f"{out} was begun by another version of dexctl: {found}")
    return config


def run_all(
    config: SweepConfig,
    out: Path,
    pool: Pool,
    *,
    watch: Callable[[list[Job], dict[str, Outcome]], None] | None = None,
    every: float = 1.0,
) -> dict[str, Outcome]:
    """Do what is not done yet; those that failed before are tried again.

    Args:
        config: the sweep.
        out: its folder, `prepare`d.
        pool: where jobs are done.
        watch: called with what is being done and what became of the rest, at least this often:
        every: [s].

    Returns:
        What became of each job, by the name of its folder in ``out``.
    """
    everything = list(jobs(config, out))
    ended = {key(job): outcome(job.folder) for job in everything}
    ended = {name: found for name, found in ended.items() if found.state == "finished"}
    waiting = [job for job in everything if key(job) not in ended]
    while waiting or pool.running:
        while waiting and len(pool.running) < pool.places:
            pool.start(waiting.pop(0))
        for job in pool.wait(every):
            ended[key(job)] = outcome(job.folder)
        if watch is not None:
            watch(pool.running, ended)
    return ended


def key(job: Job) -> str:
    """A job's name, within the folder of the sweep."""
    return f"{job.folder.parent.name}/{job.name}"


def _read(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InvalidInput(f"there is no sweep in {path.parent}: no {path.name}") from None
    except ValueError as error:
        raise InvalidInput(f"{path} is not JSON: {error}") from None
    found = content.get("format") if isinstance(content, dict) else None
    if found != FORMAT:
        raise InvalidInput(f"{path} has format {found}; this version reads format {FORMAT}")
    return content
