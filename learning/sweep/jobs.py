"""What a sweep gives to its processes, and what it finds in their folders afterwards.

A job has a folder. It leaves ``result.json`` there when it is done and ``failure.json`` when it
failed, each whole or not at all; with neither, it has not been started or was killed half way, and
goes on where its last checkpoint is. The training itself leaves what a `RunFolder` holds.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from dexctl.files import write_text
from dexctl.settings import to_plain
from learning.sweep.config import PlannedRun, SweepConfig

RESULT, FAILURE, LOG = "result.json", "failure.json", "worker.log"
RUNS, CONTROLLERS = "runs", "controllers"
State = Literal["finished", "failed", "unfinished", "not started"]


@dataclass(frozen=True)
class Job:
    """Something to do: train and evaluate, or evaluate a controller.

    Attributes:
        name: of its folder.
        folder: an absolute path.
        protocol: of the evaluation, as `to_plain` has it.
        config: of the training, as `to_plain` has it; None: only evaluate.
        threads: that it wants.
    """

    name: str
    folder: Path
    protocol: Mapping[str, Any]
    config: Mapping[str, Any] | None = None
    threads: int = 1

    def to_json(self) -> str:
        """One line."""
        return json.dumps({**asdict(self), "folder": str(self.folder)})

    @classmethod
    def from_json(cls, text: str) -> Job:
        """What `to_json` wrote."""
        values = json.loads(text)
        return cls(**{**values, "folder": Path(values["folder"])})


@dataclass(frozen=True)
class Outcome:
    """What became of a job.

    Attributes:
        state: how far it is.
        result: what it left, where it is finished.
        error: one line, where it failed.
    """

    state: State
    result: Mapping[str, Any] | None = None
    error: str | None = None


def jobs(config: SweepConfig, out: Path) -> Iterator[Job]:
    """Everything that a sweep has to do, the controllers first: they take no training."""
    out = out.resolve()
    protocol, threads = to_plain(config.protocol), config.protocol.scene.threads or 1
    for name in config.compared:
        yield Job(name, controller_folder(out, name), protocol, threads=threads)
    for run in config.runs:
        yield Job(
            run.name,
            run_folder(out, run),
            protocol,
            to_plain(run.config),
            max(run.config.torch_threads, run.config.env.scene.threads or 1, threads),
        )


def run_folder(out: Path, run: PlannedRun) -> Path:
    """Where a run is, in the folder of the sweep."""
    return out / RUNS / run.name


def controller_folder(out: Path, name: str) -> Path:
    """Where the evaluation of a controller is."""
    return out / CONTROLLERS / name


def outcome(folder: Path) -> Outcome:
    """What became of the job with this folder."""
    result = _read(folder / RESULT)
    if result is not None:
        return Outcome("finished", result=result)
    failure = _read(folder / FAILURE)
    if failure is not None:
        return Outcome("failed", error=str(failure.get("error")))
    return Outcome("unfinished" if folder.exists() else "not started")


def write_result(folder: Path, result: Mapping[str, Any]) -> None:
    """Say that the job is done."""
    write_text(folder / RESULT, json.dumps(result, indent=2, allow_nan=False) + "\n")
    (folder / FAILURE).unlink(missing_ok=True)


def write_failure(folder: Path, error: str, traceback: str = "") -> None:
    """Say that it failed, and why; ``error`` becomes one line."""
    folder.mkdir(parents=True, exist_ok=True)
    content = {"error": " ".join(error.split()), "traceback": traceback}
    write_text(folder / FAILURE, json.dumps(content, indent=2) + "\n")


def _read(path: Path) -> dict[str, Any] | None:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):  # none, or not one of ours: it is made anew
        return None
    return found if isinstance(found, dict) else None
