"""`dexctl hands add FILE` as a process, and whether plain holding holds after it."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from resource import RUSAGE_CHILDREN, getrusage
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

import numpy as np

from dexctl.cli.hand_checks import HELD_SHARE
from measuring.results import Figure
from measuring.shares import share
from measuring.trials import PALMS

COMMANDS = ("dexctl hands add FILE", "dexctl hands check MY_HAND.toml")
"""The first one writes a grasp that holds; the second one shows that it does."""
GOAL = 10.0  # from the file to a grasp that holds, at most [min]
_IDLE = 0.75  # of a processor that a run has to have, or its wall time is of what ran beside it


def process(words: Sequence[str]) -> dict[str, Any]:
    """`dexctl` with these words and ``--json``, as a process: what it says, and what it takes."""
    before, start = getrusage(RUSAGE_CHILDREN), perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "dexctl", *words, "--json"],
        capture_output=True,
        text=True,
        check=False,
    )
    wall, after = perf_counter() - start, getrusage(RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    found = json.loads(done.stdout) if done.stdout.strip() else {}
    lines = done.stderr.strip().splitlines() or ["it said nothing"]
    return {
        "found": found,
        "error": (found.get("failure") or lines[-1]) if done.returncode else None,
        "wall_s": round(wall, 2),
        "cpu_s": round(cpu, 2),
    }


def added(name: str, file: Path, seed: int, told: str = "") -> dict[str, Any]:
    """One run of `dexctl hands add` into a folder of its own, and plain holding after it.

    Args:
        name: what the hand is called in the result.
        file: its MJCF or URDF.
        seed: of the search, and of the check.
        told: further options of `hands add`.

    Returns:
        A row: wall and processor seconds, ``error`` where there is no grasp, which object it is
        of, the share of the trials of `dexctl hands check` that hold by palm, and its checks that
        failed.
    """
    row: dict[str, Any] = {"hand": name, "seed": seed, "told": told}
    row["load"] = round(os.getloadavg()[0], 2)  # of others, whose work makes the wall time longer
    with TemporaryDirectory() as folder:
        toml, of_seed = str(Path(folder) / "my_hand.toml"), ("--seed", str(seed))
        add = process(["hands", "add", str(file), "--out", toml, *of_seed, *shlex.split(told)])
        row |= {"wall_s": add["wall_s"], "cpu_s": add["cpu_s"], "error": add["error"]}
        if add["error"] is not None:
            return row
        check = process(["hands", "check", toml, *of_seed])
    checks = check["found"].get("checks", [])
    said = {one["name"]: one["said"] for one in checks}
    row["grasp"] = add["found"]["grasp"]
    row["holds"] = {palm: counted(said.get(f"holds, palm {palm}", "")) for palm in PALMS}
    failed = [one["name"] for one in checks if one["good"] is False]
    row["failed_checks"] = failed if checks else [check["error"]]
    row["check_wall_s"] = check["wall_s"]
    return row


def counted(said: str) -> dict[str, Any] | None:
    """The share in what a check said, "15 of 16 disturbed grasps ..."; None where there is none."""
    found = re.match(r"(\d+) of (\d+) ", said)
    if found is None:
        return None
    k, n = int(found[1]), int(found[2])
    return share(np.arange(n) < k)


def in_order(runs: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The runs of each hand beside each other, by their seeds."""
    hands = list(dict.fromkeys(run["hand"] for run in runs))
    return sorted(runs, key=lambda run: (hands.index(run["hand"]), run.get("seed", 0)))


def table_of_adding(runs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """What people read."""
    return {
        "title": "From the file to a hold: `dexctl hands add FILE` as a process, and plain holding "
        "for 10 s after it (`dexctl hands check`)",
        "header": [
            "Hand", "Seed", "Minutes", "of processor", "Load before", "Grasp of", "Palm up",
            "Palm down",
        ],
        "rows": [line_of_adding(run) for run in runs],
    }  # fmt: skip


def line_of_adding(run: dict[str, Any]) -> list[str]:
    """A run for people."""
    if "missing" in run:
        return [run["hand"], run["missing"], *[""] * 6]
    took = [f"{run[key] / 60:.1f}" for key in ("wall_s", "cpu_s")]
    start = [run["hand"], str(run["seed"]), *took, f"{run['load']:.1f}"]
    if run["error"] is not None:
        return [*start, run["error"], "", ""]
    held = [run["holds"].get(palm) for palm in PALMS]
    said = ["not held" if one is None else f"{one['count']} of {one['of']}" for one in held]
    return [*start, run["grasp"], *said]


def minutes(run: dict[str, Any]) -> float:
    """What a run takes: its wall time, or the processor time where it had to wait for others.

    The second is not less than the first would be on a machine that nobody else uses, as a run
    waits for nothing but the processor.
    """
    waited = run["cpu_s"] < _IDLE * run["wall_s"]
    return (run["cpu_s"] if waited else run["wall_s"]) / 60


def holds(run: dict[str, Any], *palms: str) -> bool:
    """Whether plain holding holds as `dexctl hands check` wants it, these ways up."""
    shares = [run.get("holds", {}).get(palm) for palm in palms]
    return all(one is not None and one["share"] >= HELD_SHARE for one in shares)


def figures_of_adding(runs: Sequence[dict[str, Any]]) -> list[Figure]:
    """Two lines for each hand, over its seeds."""
    out = []
    for name in dict.fromkeys(run["hand"] for run in runs if "missing" not in run):
        mine = [run for run in runs if run["hand"] == name]
        longest = max(mine, key=minutes)
        wall, cpu = (longest[key] / 60 for key in ("wall_s", "cpu_s"))
        good = sum(holds(run, "up") for run in mine)
        out.append(
            Figure(
                f"{Path(name).stem}: from its file to a grasp that holds palm up, one command "
                "(`dexctl hands add FILE`), the longest run; runs after which it holds",
                f"{cpu:.1f} min of processor, {wall:.1f} by the clock at a load of "
                f"{longest['load']:.0f}; {good} of {len(mine)}",
                f"{GOAL:g} min; of processor, where it had to wait for others",
                minutes(longest) <= GOAL and good == len(mine),
            )
        )
        held = []
        for palm in PALMS:
            shares = [one for run in mine if (one := run.get("holds", {}).get(palm))]
            count, of = (sum(one[key] for one in shares) for key in ("count", "of"))
            held.append(f"palm {palm} {count} of {of}")
        out.append(
            Figure(
                f"{Path(name).stem}: plain holding for 10 s after that (`dexctl hands check`)",
                ", ".join(held),
                f"{100 * HELD_SHARE:g} % each way",
                all(holds(run, *PALMS) for run in mine),
            )
        )
    return out
