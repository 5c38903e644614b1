"""Jobs as tasks of an existing Ray cluster.

Each task starts the same process as `LocalPool` does, on whichever machine Ray chooses, so a run is
the same wherever it runs. The folder of the sweep must be on a file system that all machines share.
"""

from __future__ import annotations

import time
from typing import Any, Self

from dexctl.cluster import ClusterError, connect, cores, reason
from learning.sweep.jobs import Job, outcome, write_failure
from learning.sweep.process import SECONDS_TO_STOP, Worker

_MARKER = ".sweep"


def run_here(text: str, marker: str) -> None:
    """What a task does: a job in a process of its own, until that ends.

    Args:
        text: the job, `Job.to_json`.
        marker: content of the file that shows that this machine sees the folder of the sweep.
    """
    job = Job.from_json(text)
    seen = job.folder.parent / _MARKER
    if not seen.exists() or seen.read_text(encoding="utf-8") != marker:
        raise ClusterError(
            f"{job.folder.parent} is not the same folder on this machine; --out must be on a file "
            "system that all machines of the cluster share"
        )
    worker = Worker(job)
    try:
        while not worker.done():
            time.sleep(0.2)
    except BaseException:  # the task was cancelled: let the run save a checkpoint
        worker.terminate()
        raise
    finally:
        worker.join(time.monotonic() + SECONDS_TO_STOP)


class RayPool:
    """Tasks of a Ray cluster that is there already.

    Args:
        address: of its head, "HOST:PORT", "ray://HOST:PORT", or "auto" for the one on this machine.
        jobs: how many tasks at once; None: as many as the cluster has cores.

    Raises:
        MissingExtra: Ray is not installed.
        ClusterError: there is no cluster at that address.
    """

    def __init__(self, address: str, jobs: int | None = None) -> None:
        self._ray = connect(address)
        self.places = jobs or cores(self._ray)
        self._tasks: dict[Any, Job] = {}

    @property
    def running(self) -> list[Job]:
        """What has been given to the cluster."""
        return list(self._tasks.values())

    def start(self, job: Job) -> None:
        """Give a job to the cluster."""
        job.folder.parent.mkdir(parents=True, exist_ok=True)
        marker = f"{time.time_ns()}"
        seen = job.folder.parent / _MARKER
        if seen.exists():
            marker = seen.read_text(encoding="utf-8")
        else:
            seen.write_text(marker, encoding="utf-8")
        task = self._ray.remote(run_here).options(
            num_cpus=job.threads, max_retries=0, name=f"dexctl {job.name}"
        )
        self._tasks[task.remote(job.to_json(), marker)] = job

    def wait(self, seconds: float) -> list[Job]:
        """Jobs that have ended meanwhile; returns at the latest after ``seconds``."""
        if not self._tasks:
            return []
        ended, _ = self._ray.wait(list(self._tasks), timeout=seconds)
        found = []
        for reference in ended:
            job = self._tasks.pop(reference)
            try:
                self._ray.get(reference)
            except self._ray.exceptions.RayError as error:
                # what the job itself has to say is in its folder
                if outcome(job.folder).state not in ("finished", "failed"):
                    write_failure(job.folder, reason(error))
            found.append(job)
        return found

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Cancel what still runs, wait until it has saved, and leave the cluster."""
        left = list(self._tasks)
        for reference in left:
            self._ray.cancel(reference)
        if left:
            self._ray.wait(left, num_returns=len(left), timeout=SECONDS_TO_STOP)
        self._ray.shutdown()
