"""Jobs as processes of their own on this machine, several at once."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Self

from learning.sweep.jobs import FAILURE, LOG, Job, outcome, write_failure

ROOT = Path(__file__).resolve().parents[2]  # the processes run the same code as this one
SECONDS_TO_STOP = 60.0  # a checkpoint of a full replay buffer takes some
_STOPPED = 130


class Worker:
    """The process of one job. It ends when this process ends, or when it is stopped."""

    def __init__(self, job: Job) -> None:
        self.job = job
        job.folder.mkdir(parents=True, exist_ok=True)
        (job.folder / FAILURE).unlink(missing_ok=True)
        threads = str(job.threads)
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(
                filter(None, [str(ROOT), os.environ.get("PYTHONPATH", "")])
            ),
            "OMP_NUM_THREADS": threads,
            "OPENBLAS_NUM_THREADS": threads,
            "MKL_NUM_THREADS": threads,
            "NUMBA_NUM_THREADS": threads,
        }
        with (job.folder / LOG).open("ab") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "learning.sweep.worker"],
                stdin=subprocess.PIPE,  # stays open: its end tells the process that we are gone
                stdout=log,
                stderr=log,
                cwd=job.folder,
                env=environment,
                start_new_session=True,  # Ctrl-C comes to us; we stop them in order
            )
        assert self.process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # gone already: `done` says so
            self.process.stdin.write((job.to_json() + "\n").encode())
            self.process.stdin.flush()

    def done(self) -> bool:
        """Whether it has ended; then what became of it is in its folder."""
        code = self.process.poll()
        if code is None:
            return False
        self._close()
        if code != 0 and outcome(self.job.folder).state != "failed":
            write_failure(self.job.folder, _ending(code, self.job.folder / LOG))
        return True

    def terminate(self) -> None:
        """Ask it to save a checkpoint and end."""
        with contextlib.suppress(ProcessLookupError):
            self.process.terminate()

    def join(self, deadline: float) -> None:
        """Wait until it has ended; at ``deadline`` (`time.monotonic`) it is killed."""
        try:
            self.process.wait(max(deadline - time.monotonic(), 0.0))
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self._close()

    def _close(self) -> None:
        if self.process.stdin is not None:
            with contextlib.suppress(OSError):
                self.process.stdin.close()


class LocalPool:
    """Processes on this machine.

    Args:
        jobs: how many at once.
    """

    def __init__(self, jobs: int) -> None:
        self.places = jobs
        self._workers: list[Worker] = []

    @property
    def running(self) -> list[Job]:
        """What is being done."""
        return [worker.job for worker in self._workers]

    def start(self, job: Job) -> None:
        """Begin a job."""
        self._workers.append(Worker(job))

    def wait(self, seconds: float) -> list[Job]:
        """Jobs that have ended meanwhile; returns at the latest after ``seconds``."""
        deadline = time.monotonic() + seconds
        while True:
            ended = [worker for worker in self._workers if worker.done()]
            if ended or time.monotonic() >= deadline:
                self._workers = [worker for worker in self._workers if worker not in ended]
                return [worker.job for worker in ended]
            time.sleep(0.05)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Let those that still run save a checkpoint and end."""
        for worker in self._workers:
            worker.terminate()
        deadline = time.monotonic() + SECONDS_TO_STOP
        for worker in self._workers:
            worker.join(deadline)


def _ending(code: int, log: Path) -> str:
    """Why a process ended that could not say so itself, in one line."""
    if code == _STOPPED:
        return "its process was told to stop"
    if code > 0:
        return f"its process ended with exit code {code}: {_last_line(log)}"
    try:
        name = signal.Signals(-code).name
    except ValueError:
        name = f"signal {-code}"
    hint = " (out of memory?)" if -code == signal.SIGKILL else ""
    return f"its process was killed by {name}{hint}"


def _last_line(log: Path) -> str:
    lines = log.read_text(encoding="utf-8", errors="replace").split("\n") if log.exists() else []
    return next((line.strip() for line in reversed(lines) if line.strip()), "it said nothing")
