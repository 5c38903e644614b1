"""Runs on the emulated servo hand, some side by side, as processes of the command line."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from itertools import product
from typing import Any

from measuring.poses import Pose, known
from measuring.results import earlier
from measuring.settings import progress


def emulated_run(*words: str) -> dict[str, Any]:
    """What `dexctl hardware run WORDS --emulate` says, 50 ms from a set-point to its effect.

    Raises:
        SystemExit: it said nothing but an error.
    """
    with tempfile.TemporaryDirectory() as folder:
        command = ["hardware", "run", *words, "--emulate", "--json", "--out", folder,
                   "--action-latency", "0.05", "--patience", "5"]  # fmt: skip
        done = subprocess.run(
            [sys.executable, "-m", "dexctl", *command], capture_output=True, text=True, check=False
        )
    if not done.stdout.strip():
        raise SystemExit(f"dexctl {' '.join(command)}: {done.stderr.strip()}")
    return json.loads(done.stdout)


def seen_or_felt(
    who: str, thing: str, palm: str, seed: int, given: Any, *told: str, pose: Pose = "touch"
) -> dict[str, Any]:
    """One `emulated_run` with an object whose pose is known so, and encoders that are off."""
    settled = known(pose).items()
    words = [word for name, one in settled for word in (f"--{name.replace('_', '-')}", str(one))]
    return emulated_run(
        who, "--object", thing, "--gravity", palm, *words, *told,
        "--seconds", f"{given.seconds:g}", "--seed", str(seed),
        "--joint-offset", f"{given.joint_offset:g}",
    )  # fmt: skip


def side_by_side(
    jobs: int, trial: Callable[..., dict[str, Any]], wanted: Sequence[tuple[Any, ...]]
) -> Iterator[tuple[tuple[Any, ...], dict[str, Any]]]:
    """Trials that wait for processes of their own, ``jobs`` at a time, with their rows as they end.

    After a Ctrl-C, which ends the trials under way, none begins.
    """
    pool = ThreadPoolExecutor(jobs)
    try:
        runs = {pool.submit(trial, *one): one for one in wanted}
        for run in as_completed(runs):
            yield runs[run], run.result()
    finally:
        pool.shutdown(cancel_futures=True)


def measure_by_palm(
    name: str,
    given: Any,
    fixed: Sequence[str],
    trial: Callable[..., dict[str, Any]],
    save: Callable[..., None],
) -> None:
    """Trials of each who with each palm on the emulated servo hand; written after every one.

    Args:
        name: of the script.
        given: its settings, with who, palms, trials, seed and jobs.
        fixed: settings that all rows have in common.
        trial: (who, palm, number, given) -> its row, whose seed is given.seed + number.
        save: (rows, given, say=) writes the result.
    """
    rows = earlier(name, given, fixed)
    pose = getattr(given, "pose", "touch")
    done = {
        (row["who"], row["palm"], row["seed"]) for row in rows if row.get("pose", "touch") == pose
    }
    wanted = [
        (who, palm, number, given)
        for who, palm, number in product(given.who, given.palms, range(given.trials))
        if (who, palm, given.seed + number) not in done
    ]
    for (*words, _), row in side_by_side(given.jobs, trial, wanted):
        rows.append(row)
        save(rows, given, say=False)
        progress(", ".join(map(str, words)))
    save(rows, given, say=True)
