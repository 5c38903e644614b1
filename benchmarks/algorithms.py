"""Our SAC and PPO against stable-baselines3's: what they reach, and how fast.

Both sides have the same environments, networks, batches, updates for each step, discount and
learning rate. They train in one process of one thread, in turns of some steps each, so that both
meet the same load; ours does not let environments and updates overlap here. Beside the wall clock,
which the machine's other work disturbs, the processor time is measured. What PPO of either side
has beyond its settings stays as it is: see `measuring.stock.stock_ppo`.

The deterministic policies are evaluated with seeds other than those of training. The hand turns
the cylinder without any controller's guidance, so that these few steps show how soon something is
learned, and not how a hand gaits.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from measuring.results import Figure, write
from measuring.settings import Settings, settings
from measuring.trainings import measure_with_seeds

from dexctl.settings import to_plain
from dexctl.sim.scene_config import SceneConfig
from dexctl.statistics import bootstrap
from learning.algorithms.config import PPOConfig, SACConfig
from learning.config import TrainConfig
from learning.envs.config import EnvConfig
from learning.exploration.config import GuidanceConfig

HAND = "hand"
OTHER_SEEDS = 100_000  # from here on are those of the evaluation


@dataclass(frozen=True, kw_only=True)
class Case:
    """What both sides are compared in.

    Attributes:
        title: what people read.
        task: of gymnasium, or "hand".
        algorithm: which.
        settings: of the algorithm, on both sides.
        num_envs, steps: environments, and steps of all of them together.
        turn: steps of each environment in a turn; PPO's are whole rollouts.
    """

    title: str
    task: str
    algorithm: Literal["sac", "ppo"]
    settings: SACConfig | PPOConfig
    num_envs: int
    steps: int
    turn: int


CASES: Mapping[str, Case] = {
    "pendulum_sac": Case(
        title="SAC, Pendulum-v1",
        task="Pendulum-v1",
        algorithm="sac",
        settings=SACConfig(
            network=(64, 64), batch_size=256, gradient_steps=8, learning_rate=1e-3,
            learning_starts=1000, buffer_size=12_000, entropy_coefficient=0.1,
        ),
        num_envs=8,
        steps=12_000,
        turn=50,
    ),
    "pendulum_ppo": Case(
        title="PPO, Pendulum-v1",
        task="Pendulum-v1",
        algorithm="ppo",
        settings=PPOConfig(
            network=(64, 64), rollout_steps=128, epochs=10, minibatches=32, gamma=0.9,
            learning_rate=3e-4, target_kl=None,  # at 1e-3 neither side is stable
        ),
        num_envs=16,
        steps=100_000,
        turn=256,
    ),
    "hand_sac": Case(
        title="SAC, cylinder in the hand",
        task=HAND,
        algorithm="sac",
        settings=SACConfig(buffer_size=150_000),
        num_envs=128,
        steps=150_000,
        turn=24,
    ),
    "hand_ppo": Case(
        title="PPO, cylinder in the hand",
        task=HAND,
        algorithm="ppo",
        settings=PPOConfig(learning_rate=3e-4, target_kl=None),
        num_envs=128,
        steps=500_000,
        turn=48,
    ),
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    seeds: int = 3
    """Trainings of each side and case; the first has the seed given."""
    jobs: int = 2
    """Trainings at once, each with one thread."""
    only: tuple[str, ...] = tuple(CASES)
    """Which cases."""
    share: float = 1.0
    """Of the steps of each training, for a try."""
    episodes: int = 64
    """Of each policy alone."""


def config(name: str, seed: int, given: Options) -> TrainConfig:
    """Everything that both trainings of a case are."""
    case = CASES[name]
    own, turn = case.settings, case.turn * case.num_envs
    steps = max(round(case.steps * given.share / turn), 1) * turn
    if isinstance(own, SACConfig):
        own = replace(own, learning_starts=min(own.learning_starts, steps // 4))
    chosen: dict[str, Any] = {case.algorithm: own}
    return TrainConfig(
        env=EnvConfig(scene=SceneConfig(object=("cylinder",), threads=1), scaled=True),
        guidance=GuidanceConfig(method="rl"),
        algorithm=case.algorithm,
        **chosen,
        steps=steps,
        seed=seed,
        num_envs=case.num_envs,
        overlap=False,
        device="cpu",
    )


def measure(name: str, seed: int, given: Options) -> dict[str, Any]:
    """Train both sides in turns, and evaluate both."""
    import torch
    from measuring.sides import build, gymnasium_vector, returns

    from learning.envs.vector import make_vector

    torch.set_num_threads(1)
    case, of = CASES[name], config(name, seed, given)
    sides = build(of, case.task)
    found: dict[str, Any] = {}
    try:
        for turn in range(of.steps // (case.turn * case.num_envs)):
            for side in list(sides)[:: 1 if turn % 2 == 0 else -1]:
                sides[side].advance(case.turn)
        for side, one in sides.items():
            other = OTHER_SEEDS + 1000 * seed
            if case.task == HAND:
                env: Any = make_vector(of.env, given.episodes, other)
            else:
                env = gymnasium_vector(case.task, given.episodes, other)
            each = returns(one, env)
            found[side] = {
                "return_mean": round(float(each.mean()), 2),
                "returns": np.round(each, 2).tolist(),
                "steps": one.steps,
                "steps_per_second": round(one.steps / one.wall, 1),
                "steps_per_processor_second": round(one.steps / one.processor, 1),
            }
    except KeyboardInterrupt:  # the pool would give this process the next training
        os._exit(130)
    finally:
        for one in sides.values():
            one.close()
    return {
        "case": name,
        "training_seed": seed,
        "config": to_plain(of),
        "episodes": given.episodes,
        **found,
        "load": round(os.getloadavg()[0], 2),
    }


def compared(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Over the seeds of a case: returns of both sides, their speeds, and ratios of these.

    A ratio is one of two sides of the same seed, which trained in turns.
    """
    found: dict[str, Any] = {"seeds": [row["training_seed"] for row in rows]}
    for side in ("ours", "stock"):
        of_side = [row[side] for row in rows]
        mean = bootstrap([one["return_mean"] for one in of_side], "iqm")
        found[side] = {
            "return_iqm": round(mean.value, 2),
            "bootstrap95": [round(mean.low, 2), round(mean.high, 2)],
            "steps_per_second": round(float(np.median([o["steps_per_second"] for o in of_side]))),
        }
    for key in ("steps_per_second", "steps_per_processor_second"):
        each = [row["ours"][key] / row["stock"][key] for row in rows]
        found[f"{key}_ratio"] = round(float(np.median(each)), 3)
    return found


def shown(side: Mapping[str, Any]) -> str:
    """A return for people, with its interval."""
    low, high = side["bootstrap95"]
    return f"{side['return_iqm']:.4g} ({low:.4g} to {high:.4g})"


def figures(found: Mapping[str, dict[str, Any]]) -> Iterator[Figure]:
    """Return and speed of each case."""
    for name, both in found.items():
        title, ours, stock = CASES[name].title, both["ours"], both["stock"]
        yield Figure(
            f"{title}: return of ours, and of stable-baselines3's with the same settings",
            f"{shown(ours)}, {shown(stock)}",
            "not below its interval",
            ours["bootstrap95"][1] >= stock["bootstrap95"][0],
        )
        speed = both["steps_per_second_ratio"]
        yield Figure(
            f"{title}: training steps per second, ours to stable-baselines3's, one thread",
            f"{speed:.2f} ({ours['steps_per_second']} and {stock['steps_per_second']} steps/s)",
            "at least 1",
            speed >= 1.0,
        )


def table(found: Mapping[str, dict[str, Any]], given: Options) -> dict[str, Any]:
    """The same for the docs, with the ratio of processor times."""
    names = list(found)
    steps = {name: config(name, given.seed, given).steps for name in names}
    return {
        "title": "Our algorithms (ours) and stable-baselines3's (stock): interquartile mean of "
        f"the deterministic policies' return over {given.seeds} seeds with its 95 % interval, each "
        f"the mean of {given.episodes} episodes; and training steps per second, in turns",
        "header": [
            "", "steps", "return, ours", "return, stock", "steps/s, ours", "steps/s, stock",
            "ratio", "ratio by processor time",
        ],
        "rows": [
            [
                CASES[name].title,
                f"{steps[name]:,}",
                shown(both["ours"]),
                shown(both["stock"]),
                str(both["ours"]["steps_per_second"]),
                str(both["stock"]["steps_per_second"]),
                f"{both['steps_per_second_ratio']:.2f}",
                f"{both['steps_per_processor_second_ratio']:.2f}",
            ]
            for name, both in found.items()
        ],
    }  # fmt: skip


def save(trials: list[dict[str, Any]], given: Options, *, say: bool) -> None:
    """Write the result with the rows so far."""
    import stable_baselines3
    import torch

    found = {
        name: compared([row for row in trials if row["case"] == name])
        for name in CASES
        if any(row["case"] == name for row in trials)
    }
    write(
        "algorithms",
        given,
        list(figures(found)),
        [table(found, given)],
        say=say,
        cases=found,
        versions={"torch": torch.__version__, "stable_baselines3": stable_baselines3.__version__},
        torch_threads=1,
        trials=trials,
    )


def line(row: Mapping[str, Any]) -> str:
    """A row for whoever waits."""
    ours, stock = row["ours"], row["stock"]
    return (
        f"return {ours['return_mean']}, stock {stock['return_mean']}; {ours['steps_per_second']} "
        f"and {stock['steps_per_second']} steps/s"
    )


def main() -> None:
    given = settings(Options, __doc__)
    measure_with_seeds(
        "algorithms", given, "case", list(CASES), given.only, config, measure, save, line,
        fixed=("seed", "episodes"),
    )  # fmt: skip


if __name__ == "__main__":
    main()
