"""The process of one job: ``python -m learning.sweep.worker``, with the job on its standard input.

The input stays open as long as whoever started the process is alive. When it ends, however that
came about, the process saves a checkpoint and ends too: a sweep that is killed leaves no orphans.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
import traceback
from typing import Any

import numpy as np

from dexctl.exceptions import DexctlError, InvalidInput
from dexctl.settings import from_plain
from learning.config import TrainConfig
from learning.evaluation import Evaluation, Protocol, evaluate, open_subject
from learning.sweep.jobs import FAILURE, Job, write_failure, write_result
from learning.training.run_folder import RunFolder

SECONDS_TO_SAVE = 20.0


class TrainingFailed(DexctlError, RuntimeError):
    """A run ended without a policy that can be used."""


def do(job: Job) -> None:
    """Do a job, from wherever it was left; its result is in its folder afterwards.

    Raises:
        Exception: whatever went wrong.
    """
    folder = RunFolder(job.folder)
    # of a sweep that was killed, a process may still be saving here; training locks it for itself
    with folder.lock(wait=2 * SECONDS_TO_SAVE):
        folder.clean()
        (job.folder / FAILURE).unlink(missing_ok=True)
    found: dict[str, Any] = {"name": job.name, "evaluation": job.protocol}
    if job.config is not None:
        found |= _train(from_plain(TrainConfig, job.config), folder)
    protocol = from_plain(Protocol, job.protocol)
    who = open_subject(
        job.name if job.config is None else str(job.folder), hand=protocol.scene.hand
    )
    start = time.monotonic()
    evaluations = [
        evaluate(who, protocol, object=name) for name in dict.fromkeys(protocol.scene.object)
    ]
    found["evaluation_seconds"] = time.monotonic() - start
    found["objects"] = {one.object: one.to_dict() for one in evaluations}
    found["episodes"] = {one.object: _episodes(one) for one in evaluations}
    found["versions"] = (who.card or {}).get("versions")
    write_result(job.folder, found)


def _train(config: TrainConfig, folder: RunFolder) -> dict[str, Any]:
    """Train, or go on training; what is known of the run."""
    from learning.training.trainer import resume, train

    if RunFolder.is_run(folder.path):
        if folder.config() != config.with_mass():
            raise InvalidInput(f"{folder.path} holds a run with another configuration")
        begun = folder.checkpoint_path.exists()
        _remark(f"the run goes on from {'its checkpoint' if begun else 'the beginning'}")
        found = resume(folder.path, remark=_remark)
    else:
        found = train(config, folder.path, remark=_remark)
    last = {name: float(value) for name, value in found["last"].items()}
    bad = [name for name, value in last.items() if not np.isfinite(value)]
    if bad:
        raise TrainingFailed(
            f"training diverged: {', '.join(bad)} not finite after {found['steps']} steps"
        )
    return {"steps": found["steps"], "training_seconds": last.get("seconds"), "last": last}


def _episodes(one: Evaluation) -> dict[str, list[Any]]:
    return {
        "rotation_rad": one.rotation.tolist(),
        "time_held_s": one.time_held.tolist(),
        "dropped": one.dropped.tolist(),
        "return": one.returns.tolist(),
    }


def _remark(text: str) -> None:
    print(f"{time.strftime('%Y-%m-%d %H:%M:%S')} {text}", file=sys.stderr, flush=True)


def _end_with_the_sweep() -> None:
    """Wait for the end of the input; then save and stop, or stop."""
    while os.read(0, 4096):  # not sys.stdin, whose lock an interpreter that ends would want
        pass
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(SECONDS_TO_SAVE)
    os._exit(1)


def _read_job() -> Job:
    line = b""
    while not line.endswith(b"\n"):
        piece = os.read(0, 1 << 16)
        if not piece:
            raise InvalidInput("no job on the standard input")
        line += piece
    return Job.from_json(line.decode())


def main() -> int:
    """Do the job on the standard input; 0 it is done, 1 it failed, 130 it was stopped."""
    job = _read_job()
    threading.Thread(target=_end_with_the_sweep, daemon=True).start()
    try:
        do(job)
    except KeyboardInterrupt:  # a checkpoint has been saved
        return 130
    except Exception as error:  # noqa: BLE001 (whatever it is, it is written down)
        what = str(error) or repr(error)
        name = "" if isinstance(error, DexctlError) else f"{type(error).__name__}: "
        traceback.print_exc()
        write_failure(job.folder, name + what, traceback.format_exc())
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
