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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from common import THREADS, Figure, Settings, progress, ratio, settings, write
from learner_profile import PARTS, profiled
from stable_baselines3 import SAC

from learning.agents import StableBaselinesVecEnv
from learning.envs import EnvConfig, make_vector
from learning.exploration import GuidanceConfig
from learning.settings import TrainConfig
from learning.train import build

STOCK = ("stock", "stock_two_threads")
# name: title, and the least ratio to stock that was asked for
OURS = {
    "rl": ("our learner, controllers off", 1.15),
    "vge": ("our learner, VGE with the coordinated gait", 0.9),
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


def config(given: Options, method: str, **changes: Any) -> TrainConfig:
    """The configuration of our sides; stock has the same numbers."""
    n = given.environments
    return TrainConfig(
        env=EnvConfig(object=given.object, threads=THREADS),
        guidance=GuidanceConfig(method=method),
        controllers=("coordinated",),
        seed=given.seed,
        num_envs=n,
        buffer_size=max(1600 * n, 1024),
        learning_starts=given.warm_up // 2 * n,
        device="cpu",
        **changes,
    )


def stock(of: TrainConfig) -> SAC:
    """stable-baselines3's SAC, with entropy coefficient 0 like ours."""
    return SAC(
        "MlpPolicy",
        StableBaselinesVecEnv(make_vector(of.env, of.num_envs, of.seed)),
        ent_coef=0.0,
        learning_rate=of.learning_rate,
        buffer_size=of.buffer_size,
        learning_starts=of.learning_starts,
        batch_size=of.batch_size,
        tau=of.tau,
        gamma=of.gamma,
        train_freq=1,
        gradient_steps=of.gradient_steps,
        policy_kwargs={"net_arch": list(of.network)},
        seed=of.seed,
        device="cpu",
    )


def sides(given: Options) -> dict[str, tuple[Any, int]]:
    """Agents, each with its number of torch threads."""
    of_stock = STOCK if given.two_threads else STOCK[:1]
    agents: dict[str, Any] = {name: stock(config(given, "rl")) for name in of_stock}
    agents |= {name: build(config(given, name)) for name in OURS}
    agents[WITHOUT] = build(config(given, "rl", overlap=False))
    return {name: (agent, 1 + (name == STOCK[1])) for name, agent in agents.items()}


def advance(agent: Any, steps: int) -> None:
    """Train for ``steps`` steps of all environments."""
    agent.learn(steps * agent.n_envs, reset_num_timesteps=agent.num_timesteps == 0)


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


def compare(given: Options, agents: dict[str, tuple[Any, int]]) -> np.ndarray:
    """What `measured` gives for each round and side, ``(rounds, sides, 3)``."""
    rows = []
    for i in range(given.rounds):
        order = list(agents) if i % 2 == 0 else list(agents)[::-1]
        row = {}
        for name in order:
            agent, threads = agents[name]
            torch.set_num_threads(threads)
            row[name] = measured(lambda agent=agent: advance(agent, given.steps))
        rows.append([row[name] for name in agents])
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
    agents = sides(given)
    for name, (agent, threads) in agents.items():
        torch.set_num_threads(threads)
        advance(agent, given.warm_up)
        progress(f"{name} is warm")
    names = list(agents)
    found = compare(given, agents)
    quiet = found[..., 2].max(axis=1) <= BUSY_ELSEWHERE
    torch.set_num_threads(1)
    profile = {
        name: profiled(lambda agent=agents[side][0]: advance(agent, given.steps), agents[side][0])
        for name, side in {"stock": "stock", "rl": WITHOUT}.items()
    }
    guided = agents["vge"][0]
    guided.overlap = False
    profile["vge"] = profiled(lambda: advance(guided, given.steps), guided)
    for agent, _ in agents.values():
        agent.env.close()

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
        configuration=config(given, "vge").to_dict(),
        versions={"torch": torch.__version__, "stable_baselines3": _version()},
        torch_threads={name: threads for name, (_, threads) in agents.items()},
    )


def _version() -> str:
    import stable_baselines3

    return stable_baselines3.__version__


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
