"""What each part of the recipe "fast" brings: the same training with one part taken away."""

from __future__ import annotations

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from common import Settings, over_seeds, progress, settings, share, write

from learning.evaluate import Protocol, evaluate
from learning.policy import load_policy
from learning.train import read_config

VARIANTS: dict[str, tuple[str, tuple[str, ...]]] = {
    "fast": ("the recipe", ()),
    "acted": ("cloned only where the controller acted", ("--cloned", "acted")),
    "likelihood": ("cloned by likelihood, not squared distance", ("--cloning", "likelihood")),
    "one_step": ("one-step returns, not five", ("--n-step", "1")),
    "slow": ("learning rate 3e-4, tau 0.005", ("--learning-rate", "3e-4", "--tau", "0.005")),
    "blind_critic": ("critics that see no more than the policy", ("--critic-parts", "touch")),
    "no_norm": ("critics without layer normalisation", ("--layer-norm", "no")),
    "last_weights": ("the last weights, not their mean", ("--policy-average", "0")),
    "thesis": ("the thesis's version of everything", ()),
}
"""What people read, and what is added to the command line."""


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    steps: int = 160_000
    """Environment steps of each training."""
    hard_stop: int = 500_000
    """Of the guide: beyond the steps it measures how soon the policy does what the guide does."""
    episodes: int = 100
    """Of the policy alone."""
    seconds: float = 60.0
    """Of each."""
    variants: tuple[str, ...] = tuple(VARIANTS)
    """Which."""
    jobs: int = 2
    """Trainings at once."""
    runs: Path = Path("out/learning_ablation")
    """Folder of the trainings; those that are there are not done again."""


def command(name: str, given: Options) -> list[str]:
    """What trains a variant."""
    folder = given.runs / name
    start = [sys.executable, "-m", "dexctl", "train"]
    if (folder / "config.json").exists():
        return [*start, "--resume", str(folder)]
    recipe = "thesis" if name == "thesis" else "fast"
    fixed = (
        f"--method vge+bc --controller coordinated --object cylinder --recipe {recipe} --steps "
        f"{given.steps} --seed {given.seed} --hard-stop {given.hard_stop} --env.threads 1"
    ).split()
    return [*start, *fixed, *VARIANTS[name][1], "--out", str(folder)]


def measure(name: str, given: Options) -> dict[str, Any]:
    """Train a variant, evaluate its policy."""
    folder = given.runs / name
    made = subprocess.run(command(name, given), capture_output=True, text=True, check=False)
    if made.returncode:
        raise RuntimeError(f"{name}: {made.stderr.strip().splitlines()[-1:]}")
    policy = load_policy(folder / "policy.npz")
    found = evaluate(
        policy, "cylinder", Protocol(episodes=given.episodes, seconds=given.seconds, threads=1)
    )
    return {
        "variant": name,
        "config": read_config(folder).to_dict(),
        "steps": policy.card["steps"],
        "rotation_rad": over_seeds(found.rotation),
        "dropped": share(found.dropped),
        "full_turn": share(found.rotation >= 2 * np.pi),
        "return_mean": float(found.returns.mean()),
    }


def save(rows: list[dict[str, Any]], given: Options, *, say: bool) -> None:
    """Write the result with the rows so far."""
    order = list(VARIANTS)
    rows = sorted(rows, key=lambda row: order.index(row["variant"]))
    lines = [
        [
            VARIANTS[row["variant"]][0],
            f"{row['rotation_rad']['median']:.1f} "
            f"({row['rotation_rad']['p10']:.1f}-{row['rotation_rad']['p90']:.1f})",
            f"{100 * row['full_turn']['share']:.0f} %",
            f"{100 * row['dropped']['share']:.0f} %",
            f"{row['return_mean']:.0f}",
        ]
        for row in rows
    ]
    table = {
        "title": f"The recipe with one part taken away, cylinder, {given.steps:,} steps, seed "
        f"{given.seed}, {given.episodes} episodes of {given.seconds:g} s of the policy alone",
        "header": ["", "rotation [rad]", "full turn", "dropped", "return"],
        "rows": lines,
    }
    write("learning_ablation", given, [], [table], trials=rows, say=say)


def main() -> None:
    given = settings(Options, __doc__)
    rows: list[dict[str, Any]] = []
    with ThreadPoolExecutor(given.jobs) as pool:
        waiting = [pool.submit(measure, name, given) for name in given.variants]
        for one in waiting:
            rows.append(one.result())
            save(rows, given, say=False)
            turned = rows[-1]["rotation_rad"]["median"]
            progress(f"{rows[-1]['variant']}: {turned:.1f} rad")
    save(rows, given, say=True)


if __name__ == "__main__":
    main()
