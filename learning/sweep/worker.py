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

from dexctl import controllers, hands
from dexctl.controller import Controller
from dexctl.exceptions import DexctlError, InvalidInput
from learning.evaluate import Evaluation, Protocol, evaluate
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
    run = RunFolder(job.folder)
    with run.lock(wait=2 * SECONDS_TO_SAVE):
        run.clean()
        (job.folder / FAILURE).unlink(missing_ok=True)
        found: dict[str, Any] = {"name": job.name, "evaluation": job.evaluation}
        hand = None
        if job.config is None:
            hand = hands.load(job.evaluation["hand"])
            period = job.evaluation["control_period"]
            actor = controllers.make(job.name, hand, control_period=period)
        else:
            actor, trained = _train(job)
            found |= trained
        start = time.monotonic()
        evaluations = [_evaluate(actor, name, job) for name in job.evaluation["objects"]]
        found["evaluation_seconds"] = time.monotonic() - start
        found["objects"] = {one.object: one.to_dict() for one in evaluations}
        found["episodes"] = {one.object: _episodes(one) for one in evaluations}
        write_result(job.folder, found)


def _train(job: Job) -> tuple[Controller, dict[str, Any]]:
    """Train, or go on training; the policy and what is known of it."""
    from learning.policies import load as load_policy
    from learning.settings import TrainConfig
    from learning.train import read_config, resume, train

    config = TrainConfig.from_dict(job.config or {})
    if RunFolder.is_run(job.folder):
        if read_config(job.folder) != config:
            raise InvalidInput(f"{job.folder} holds a run with another configuration")
        begun = RunFolder(job.folder).checkpoint_path.exists()
        _remark(f"{job.name} goes on from {'its checkpoint' if begun else 'the beginning'}")
        found = resume(job.folder, remark=_remark)
    else:
        found = train(config, job.folder, remark=_remark)
    last = {name: float(value) for name, value in found["last"].items()}
    policy = policies.load(found["policy"])
    bad = [name for name, value in last.items() if not np.isfinite(value)]
    if bad or not all(np.isfinite(array).all() for layer in policy.layers for array in layer):
        raise TrainingFailed(
            f"training diverged: {', '.join(bad) or 'the weights'} not finite after "
            f"{found['steps']} steps"
        )
    return policy, {
        "config": config.to_dict(),
        "steps": found["steps"],
        "training_seconds": last.get("seconds"),
        "last": last,
        "versions": policy.card.get("versions"),
    }


def _evaluate(actor: Controller, name: str, job: Job) -> Evaluation:
    plan = job.evaluation
    gravity = plan["gravity"]
    return evaluate(
        actor,
        name,
        Protocol(
            episodes=plan["episodes"],
            seconds=plan["seconds"],
            seed=plan["seed"],
            gravity=gravity if isinstance(gravity, str) else tuple(gravity),
            threads=job.threads,
        ),
    )


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
