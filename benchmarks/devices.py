"""Training with the updates on processor or GPU: steps a second, the same settings on both.

For each algorithm, number of environments and device a training of its own: the environments on all
cores, the updates on the device, one torch thread. Environments and updates overlap, but for PPO's.
"""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from measuring.results import Figure, write
from measuring.settings import Settings, check_chosen, progress, settings

from dexctl.exceptions import InvalidInput
from dexctl.report.machine import usable_cores
from dexctl.settings import changed
from dexctl.validation import check_numbers
from learning.config import TrainConfig, recipe
from learning.training.run_folder import RunFolder
from learning.training.trainer import Trainer

# name: recipe, and what else is set
TRAINED: dict[str, tuple[str, dict[str, Any]]] = {
    "sac": ("fast", {"controllers": ("coordinated",)}),
    "dagger": ("distil", {"controllers": ("dex5-cylinder",)}),
    "ppo": ("fast", {"algorithm": "ppo", "method": "rl"}),
}
DEVICES = {"cpu": "one core", "cuda": "a GPU"}


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    algorithms: tuple[str, ...] = tuple(TRAINED)
    """Which are measured."""
    environments: tuple[int, ...] = (128, 1024)
    """Environments stepped together; updates grow with them."""
    devices: tuple[str, ...] = tuple(DEVICES)
    """Where the updates run."""
    seconds: float = 15.0
    """How long each is measured, after its first updates [s]."""


def training(name: str, environments: int, device: str, given: Options) -> TrainConfig:
    """What is measured: the recipe with more environments, and as many more updates."""
    which, settings = TRAINED[name]
    usual = changed(recipe(which), {"object": "cylinder", "seed": given.seed, **settings})
    config = changed(usual, {"num_envs": environments, "device": device, "steps": 10**9})
    updates = getattr(getattr(usual, name), "gradient_steps", None)
    if updates is None:  # PPO's grow with what it has gathered
        return config
    updates = max(1, round(updates * environments / usual.num_envs))
    return changed(config, {f"{name}.gradient_steps": updates})


def measure(config: TrainConfig, seconds: float) -> dict[str, float]:
    """Environment steps and updates a second."""
    with TemporaryDirectory() as folder, ThreadPoolExecutor(1) as pool:
        trainer = Trainer(config, RunFolder(Path(folder) / "run"))
        try:
            while trainer.algorithm.updates < 40:
                trainer.turn(pool)
            steps, updates = trainer.algorithm.steps, trainer.algorithm.updates
            begun = time.perf_counter()
            while time.perf_counter() < begun + seconds:
                trainer.turn(pool)
            took = time.perf_counter() - begun
            return {
                "steps_per_second": round((trainer.algorithm.steps - steps) / took, 1),
                "updates_per_second": round((trainer.algorithm.updates - updates) / took, 1),
            }
        finally:
            trainer.close()


def main() -> None:
    given = settings(Options, __doc__)
    check_numbers(given, positive=("seconds",))
    check_chosen("algorithm", given.algorithms, TRAINED)
    check_chosen("device", given.devices, DEVICES)
    if "cuda" in given.devices and not torch.cuda.is_available():
        raise InvalidInput("devices has 'cuda', and torch finds no GPU here; expected cpu alone")
    rows: list[dict[str, Any]] = []
    for name, count, device in product(given.algorithms, given.environments, given.devices):
        found = measure(training(name, count, device, given), given.seconds)
        rows.append({"algorithm": name, "environments": count, "device": device, **found})
        progress(f"{name}, {count} environments, {device}: {found['steps_per_second']:.0f} steps/s")
    figures, lines = [], []
    for name, count in product(given.algorithms, given.environments):
        what = f"{name}, {count} environments"
        rates = {
            row["device"]: row["steps_per_second"]
            for row in rows
            if (row["algorithm"], row["environments"]) == (name, count)
        }
        lines.append([what, *(f"{rates[device]:.0f}" for device in given.devices)])
        if len(rates) == len(DEVICES):
            figures.append(
                Figure(
                    f"training steps a second with the updates on a GPU, against one core: {what}",
                    f"{rates['cuda'] / rates['cpu']:.1f} ({rates['cuda']:.0f} steps/s)",
                )
            )
    gpu = torch.cuda.get_device_name() if "cuda" in given.devices else None
    table = {
        "title": "Training steps a second by where the updates run, environments on "
        f"{usable_cores()} cores" + (f"; the GPU is one {gpu}" if gpu else ""),
        "header": ["", *(DEVICES[device] for device in given.devices)],
        "rows": lines,
    }
    write("devices", given, figures, [table], gpu=gpu, torch=torch.__version__, measurements=rows)


if __name__ == "__main__":
    main()
