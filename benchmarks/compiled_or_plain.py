"""What numba costs and brings: installed size, starting times, in-grasp steps, lines of code.

Processes are started with a fresh folder for numba's cache, then again with the one that they left.
"""

from __future__ import annotations

import ast
import json
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from igm_latency import states
from measuring.results import Figure, write
from measuring.settings import Settings, progress, settings
from measuring.timing import ENGINES, engines, in_turns, spread

import dexctl
from dexctl.grasp import solve_stability, solve_stability_batch

ROOT = Path(__file__).resolve().parents[1]
# what does the same sums twice, by the file and what of it (empty: all of it)
TWICE = {
    "the in-grasp step, compiled": {"igm/compiled.py": (), "igm/compiled_step.py": ()},
    "the in-grasp step in numpy": {
        "igm/plain.py": (),
        "igm/inverse.py": (),
        "igm/stability.py": ("stable_forces", "_single", "push_directions"),
    },
    "the stability QP for one hand, on lists": {
        "grasp/stability.py": ("_solve_one",),
        "grasp/stability_solver.py": ("solve_stability", "_objective"),
        "grasp/box_qp.py": ("solve_box", "_solve_free"),
    },
    "the stability QP for a batch, in numpy": {
        "grasp/stability_solver.py": (
            "solve_stability_batch", "_bracket", "_bounds", "_scaled_inverse",
        ),
    },
    "used by the QP without regulariser too": {
        "grasp/stability_solver.py": ("problems", "by_elimination", "held_at_one"),
        "grasp/box_qp.py": ("solve_box_batch",),
    },
}  # fmt: skip
START = """
import json, resource, sys
from time import perf_counter as now
import numpy as np
start = now()
import dexctl
imported = now()
hand = dexctl.hands.load("dex5")
loaded = now()
controller = dexctl.InGraspManipulation(hand, engine=sys.argv[1])
built = now()
tip = hand.fingertip_positions(np.zeros(15))
state = dexctl.GraspState(
    q=np.zeros(15), q_target=np.zeros(15), in_contact=np.ones(5, bool), contact_position=tip,
    contact_normal=np.tile([1.0, 0.0, 0.0], (5, 1)), contact_force=np.ones(5),
)
before = now()
controller.act(state)
acted = now()
print(json.dumps({
    "import_s": imported - start, "build_s": built - loaded, "first_act_s": acted - before,
    "memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
}))
"""


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    count: int = 300
    """Calls in a round."""
    rounds: int = 5
    """Rounds of each engine, taken in turns."""
    hands: tuple[int, ...] = (1, 128)
    """Sizes of batches."""
    starts: int = 3
    """Processes started for each engine and state of the cache."""


def installed(names: Iterable[str]) -> dict[str, float]:
    """Megabytes of these distributions and of all that they need, by name."""
    sizes: dict[str, float] = {}
    waiting = list(names)
    while waiting:
        name = re.split(r"[^\w.-]", waiting.pop(), maxsplit=1)[0].lower().replace("_", "-")
        if name in sizes:
            continue
        try:
            found = distribution(name)
        except PackageNotFoundError:
            continue
        paths = [Path(str(file.locate())) for file in found.files or ()]
        sizes[name] = round(sum(p.stat().st_size for p in paths if p.is_file()) / 1e6, 1)
        waiting += [one for one in found.requires or () if "extra ==" not in one]
    return sizes


def lines(file: str, names: tuple[str, ...]) -> int:
    """Lines of functions and classes of a file in dexctl, or of all of it."""
    text = (ROOT / "dexctl" / file).read_text()
    if not names:
        return len(text.splitlines())
    kinds = (ast.FunctionDef, ast.ClassDef)
    parts = [part for part in ast.parse(text).body if isinstance(part, kinds)]
    return sum(
        (part.end_lineno or part.lineno) - part.lineno + 1 for part in parts if part.name in names
    )


def starting(given: Options) -> dict[str, dict[str, float]]:
    """Medians of how processes start, by engine and state of the cache."""
    found: dict[str, list[dict[str, float]]] = {}
    for i in range(given.starts):
        with TemporaryDirectory() as cache:
            for name in ("plain", *(["cold", "warm"] if "compiled" in engines() else ())):
                progress(f"start {i + 1} of {given.starts}: {name}")
                engine = "plain" if name == "plain" else "compiled"
                done = subprocess.run(
                    [sys.executable, "-c", START, engine],
                    env={**os.environ, "NUMBA_CACHE_DIR": cache, "PYTHONPATH": str(ROOT)},
                    capture_output=True,
                    text=True,
                    check=True,
                )
                found.setdefault(name, []).append(json.loads(done.stdout))
    return {
        name: {key: round(float(np.median([row[key] for row in rows])), 4) for key in rows[0]}
        for name, rows in found.items()
    }


def stepping(given: Options, count: int) -> dict[str, dict[str, float]]:
    """Timings of one in-grasp step for ``count`` hands, by engine."""
    hand = dexctl.hands.load("dex5")
    pool = states(hand, max(count, 64), given.seed)
    fields = [name for name in pool[0].__dataclass_fields__ if getattr(pool[0], name) is not None]
    whole = {name: np.stack([getattr(state, name) for state in pool]) for name in fields}

    def batch(i: int) -> dexctl.GraspState:
        rows = (np.arange(count) + i) % len(pool)
        return dexctl.GraspState(
            **{n: v[rows[0] if count == 1 else rows] for n, v in whole.items()}
        )

    samples = [batch(i) for i in range(32)]
    controller = {engine: dexctl.InGraspManipulation(hand, engine=engine) for engine in engines()}
    calls: dict[str, Any] = {
        engine: (lambda i, one=one: one.act(samples[i % len(samples)]))
        for engine, one in controller.items()
    }
    return {name: spread(row) for name, row in in_turns(calls, given.count, given.rounds).items()}


def solving(given: Options) -> dict[str, dict[str, float]]:
    """Timings of the stability QP for one hand: on lists, and as a batch of one."""
    rho, lower, upper = 1e-3, np.full(5, 0.15), np.ones(5)
    grams = []
    for state in states(dexctl.hands.load("dex5"), 64, given.seed):
        lever = state.contact_position - np.asarray(state.object_position)
        torque = np.cross(lever, state.contact_normal) / np.linalg.norm(lever, axis=1).mean()
        wrench = np.concatenate([state.contact_normal, torque], axis=1)
        grams.append(wrench @ wrench.T)
    hessians = [gram + rho * np.eye(5) for gram in grams]
    bounds = lower.tolist(), upper.tolist()
    columns = lower[:, None], upper[:, None]
    touch = np.ones((5, 1), bool)
    calls: dict[str, Any] = {
        "lists": lambda i: solve_stability(hessians[i % 64], *bounds, rho),
        "batch_of_one": lambda i: solve_stability_batch(
            grams[i % 64][:, :, None], *columns, rho, touch
        ),
    }
    return {name: spread(row) for name, row in in_turns(calls, given.count, given.rounds).items()}


def main() -> None:
    given = settings(Options, __doc__)
    core = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    sizes, extra = installed(core), installed(["numba"])
    more = {name: size for name, size in extra.items() if name not in sizes}
    counted = {
        what: sum(lines(file, names) for file, names in files.items())
        for what, files in TWICE.items()
    }
    starts = starting(given)
    steps = {str(count): stepping(given, count) for count in given.hands}
    figures = [
        Figure(
            f"in-grasp step for {count} hand{'s' if count != '1' else ''}, {ENGINES[engine]}",
            f"median {row['median_us']:.0f} us, p99 {row['p99_us']:.0f} us",
        )
        for count, rows in steps.items()
        for engine, row in rows.items()
    ]
    figures += [
        Figure(
            f"first in-grasp controller of a process, {name}",
            f"import {row['import_s']:.2f} s, built {row['build_s']:.2f} s, first call "
            f"{1e3 * row['first_act_s']:.1f} ms, memory {row['memory_mb']:.0f} MB",
        )
        for name, row in starts.items()
    ]
    figures.append(
        Figure(
            "installed size that numba adds to the core",
            f"{sum(more.values()):.0f} MB to {sum(sizes.values()):.0f} MB",
        )
    )
    write(
        "compiled_or_plain",
        given,
        figures,
        installed_mb={"core": sizes, "numba_adds": more},
        starts=starts,
        steps=steps,
        stability_qp=solving(given),
        lines=counted,
    )


if __name__ == "__main__":
    main()
