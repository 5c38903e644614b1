"""Training throughput: our learner against stock stable-baselines3 SAC, and where its time goes.

Both have the same environments behind the same adapter, the same networks, batches and number of
updates; stock SAC has its own replay buffer, Adam and loop. torch has one thread, as in `dexctl
train`; `--two-threads` measures stock with two as well, and compares with the faster. The sides
take turns of some steps each, so that all meet the same load; a ratio is one of two sides in the
same round. Beside the wall clock, which the machine's other work disturbs, the processor time of
all threads is measured.

Where the time goes is measured without the overlap of simulation and updates, by the clock at the
calls in between.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import stable_baselines3
import torch
from measuring.learner_profile import PARTS, profiled_ours, profiled_stock
from measuring.results import Figure, write
from measuring.settings import Settings, progress, settings
from measuring.stock import stock_sac
from measuring.timing import THREADS, ratio

from dexctl.settings import to_plain
from dexctl.sim.scene_config import SceneConfig
from learning.algorithms.config import SACConfig
from learning.config import TrainConfig
from learning.envs.config import EnvConfig
from learning.envs.vector import make_vector
from learning.exploration.config import GuidanceConfig, Method
from learning.training.run_folder import RunFolder
from learning.training.trainer import Trainer

STOCK = ("stock", "stock_two_threads")
# name: title, and the ratio to stock that is aimed at
OURS: dict[Method, tuple[str, float]] = {
    "rl": ("our learner, controllers off", 1.6),
    "vge": ("our learner, VGE with the coordinated gait", 1.6),
}
WITHOUT = "rl_without_overlap"
BUSY_ELSEWHERE = 0.25  # cores; rounds with more are not quiet


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    environments: int = 128
    """Environments stepped together."""
    steps: int = 20
    """Control steps of a side's turn."""
    rounds: int = 15
    """Rounds of all sides."""
    object: str = "cylinder"
    """Object in the hand."""
    two_threads: bool = False
    """Measure stock with two torch threads too; beside other work they spend it in waiting."""
    warm_up: int = 60
    """Control steps before; updates begin after a half of them."""


def config(given: Options, method: Method, **changes: Any) -> TrainConfig:
    """The configuration of our sides; stock has the same numbers."""
    n = given.environments
    return TrainConfig(
        env=EnvConfig(scene=SceneConfig(object=(given.object,), threads=THREADS)),
        guidance=GuidanceConfig(method=method),
        controllers=("coordinated",),
        seed=given.seed,
        num_envs=n,
        sac=SACConfig(buffer_size=max(1600 * n, 1024), learning_starts=given.warm_up // 2 * n),
        device="cpu",
        **changes,
    )


class Stock:
    """stable-baselines3's side."""

    def __init__(self, of: TrainConfig, threads: int) -> None:
        env = make_vector(of.env, of.num_envs, of.seed)
        self.agent, self.threads = stock_sac(of.sac, env, of.seed), threads

    def advance(self, steps: int) -> None:
        """Train for ``steps`` steps of all environments."""
        agent = self.agent
        agent.learn(steps * agent.n_envs, reset_num_timesteps=agent.num_timesteps == 0)

    def profile(self, steps: int) -> dict[str, float]:
        """See `learner_profile`."""
        return profiled_stock(self.agent, lambda: self.advance(steps), steps)

    def close(self) -> None:
        """Close the environments."""
        assert self.agent.env is not None
        self.agent.env.close()


class Ours:
    """A side of ours: the trainer's turns, without a log."""

    threads = 1

    def __init__(self, of: TrainConfig) -> None:
        self.trainer = Trainer(of, RunFolder(Path("nowhere")))  # nothing is written between turns
        self._pool = ThreadPoolExecutor(1)

    def advance(self, steps: int) -> None:
        """Train for ``steps`` steps of all environments."""
        for _ in range(steps):
            self.trainer.turn(self._pool)

    def profile(self, steps: int) -> dict[str, float]:
        """See `learner_profile`; without overlap from here on."""
        self.trainer.config = replace(self.trainer.config, overlap=False)
        return profiled_ours(self.trainer, lambda: self.advance(steps), steps)

    def close(self) -> None:
        """Close the environments."""
        self._pool.shutdown()
        self.trainer.close()


def sides(given: Options) -> dict[str, Stock | Ours]:
    """All that are compared, by name."""
    of_stock = STOCK if given.two_threads else STOCK[:1]
    found: dict[str, Stock | Ours] = {
        name: Stock(config(given, "rl"), threads) for threads, name in enumerate(of_stock, start=1)
    }
    found |= {name: Ours(config(given, name)) for name in OURS}
    return {**found, WITHOUT: Ours(config(given, "rl", overlap=False))}


def measured(call: Callable[[], Any]) -> tuple[float, float, float]:
    """Wall-clock and processor seconds of a call, and cores busy elsewhere meanwhile."""
    busy, own, start = _busy(), time.process_time(), time.perf_counter()
    call()
    wall, own = time.perf_counter() - start, time.process_time() - own
    return wall, own, max(_busy() - busy - own, 0.0) / wall


def _busy() -> float:
    """Seconds that all cores have been busy; 0 where the system does not say."""
    path = Path("/proc/stat")
    if not path.is_file():
        return 0.0
    user, nice, system, _, _, irq, soft, *_ = map(int, path.read_text().split("\n")[0].split()[1:])
    return (user + nice + system + irq + soft) / os.sysconf("SC_CLK_TCK")


def compare(given: Options, learners: dict[str, Stock | Ours]) -> np.ndarray:
    """What `measured` gives for each round and side, ``(rounds, sides, 3)``."""
    rows = []
    for i in range(given.rounds):
        order = list(learners) if i % 2 == 0 else list(learners)[::-1]
        row = {}
        for name in order:
            side = learners[name]
            torch.set_num_threads(side.threads)
            row[name] = measured(lambda side=side: side.advance(given.steps))
        rows.append([row[name] for name in learners])
        progress(f"round {i + 1} of {given.rounds}: {np.round(rows[-1], 2)[:, 0]} s")
    return np.array(rows)


def ratios(found: np.ndarray, names: list[str], column: int) -> dict[str, Any]:
    """Of speeds, for each of our sides against each of stock's."""
    seconds = {name: found[:, i, column][:, None] for i, name in enumerate(names)}
    return {
        name: {side: ratio(seconds[side], seconds[name]) for side in STOCK if side in seconds}
        for name in (*OURS, WITHOUT)
    }


def main() -> None:
    given = settings(Options, __doc__)
    learners = sides(given)
    for name, side in learners.items():
        torch.set_num_threads(side.threads)
        side.advance(given.warm_up)
        progress(f"{name} is warm")
    names = list(learners)
    found = compare(given, learners)
    quiet = found[..., 2].max(axis=1) <= BUSY_ELSEWHERE
    torch.set_num_threads(1)
    profile = {
        name: learners[side].profile(given.steps)
        for name, side in {"stock": "stock", "rl": WITHOUT, "vge": "vge"}.items()
    }
    for side in learners.values():
        side.close()

    per_step = {name: float(np.median(found[:, i, 0])) for i, name in enumerate(names)}
    rate = {n: round(given.environments * given.steps / t) for n, t in per_step.items()}
    speed, processor = ratios(found, names, 0), ratios(found, names, 1)
    best = max((name for name in STOCK if name in rate), key=rate.__getitem__)
    figures = [
        Figure(
            f"training, {title}, against stock stable-baselines3 SAC, {given.environments} "
            "environments",
            f"{speed[name][best]['median']:.2f} ({rate[name]} and {rate[best]} steps/s)",
            f"at least {goal}",
            speed[name][best]["median"] >= goal,
        )
        for name, (title, goal) in OURS.items()
    ]
    write(
        "learner",
        given,
        figures,
        [table(given, profile)],
        environment_steps_per_second=rate,
        speed_against_stock=speed,
        speed_against_stock_in_quiet_rounds=ratios(found[quiet], names, 0) if quiet.any() else {},
        processor_time_of_stock_over_ours=processor,
        rounds=[
            {
                name: dict(zip(("wall_s", "processor_s", "busy_elsewhere"), row, strict=True))
                for name, row in zip(names, np.round(rows, 4).tolist(), strict=True)
            }
            for rows in found
        ],
        quiet_rounds=int(quiet.sum()),
        profile_ms_per_step=profile,
        configuration=to_plain(config(given, "vge")),
        versions={"torch": torch.__version__, "stable_baselines3": stable_baselines3.__version__},
        torch_threads={name: side.threads for name, side in learners.items()},
    )


def table(given: Options, profile: dict[str, dict[str, float]]) -> dict[str, Any]:
    """Where the time goes, for README and the docs."""
    names = {"stock": "stock SAC", "rl": "ours, controllers off", "vge": "ours, VGE"}
    return {
        "title": f"Where a training step of {given.environments} environments spends its time, "
        "one thing after the other, ms",
        "header": ["", *names.values()],
        "rows": [
            [title, *(f"{profile[name].get(part, 0.0):.1f}" for name in names)]
            for part, title in {**PARTS, "total": "together"}.items()
        ],
    }


if __name__ == "__main__":
    main()
