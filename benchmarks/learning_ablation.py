"""What each part of the recipe "fast" brings: the same training with one part changed.

All trainings are guided to their end, where the weight of cloning has fallen to zero; then the
policy is evaluated alone. So the figures say how soon a policy has learned, not how good it gets.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from measuring.results import write
from measuring.settings import Settings, settings
from measuring.shares import over_seeds, share
from measuring.trainings import measure_with_seeds
from measuring.trials import FULL_TURN

from dexctl.settings import changed, get, to_plain
from learning.config import TrainConfig, recipe
from learning.evaluation import evaluate, open_subject
from learning.training.run_folder import RunFolder


@dataclass(frozen=True)
class Variant:
    """One training.

    Attributes:
        title: what people read.
        recipe: what it begins with.
        method: of exploration.
        changes: settings in place of the recipe's.
        usual: settings that are as the thesis has them, in place of the recipe's.
    """

    title: str
    recipe: str = "fast"
    method: str = "vge+bc"
    changes: Mapping[str, Any] = field(default_factory=dict)
    usual: tuple[str, ...] = ()


VARIANTS = {
    "fast": Variant("recipe `fast`"),
    "no_cloning": Variant("no cloning (VGE)", method="vge"),
    "acted": Variant("cloned only where the controller acted", usual=("guidance.cloned",)),
    "thesis_cloning": Variant(
        "cloning as in the thesis",
        usual=(
            "guidance.cloned", "guidance.cloning", "guidance.cloning_weight", "guidance.beta",
        ),
    ),
    "thesis_guide": Variant("guided by the thesis's gait", changes={"controllers": ("gait",)}),
    "one_step": Variant("one-step returns", usual=("sac.n_step",)),
    "slow": Variant("learning rate 3e-4, tau 0.005", usual=("sac.learning_rate", "sac.tau")),
    "blind_critics": Variant("critics see what the policy sees", usual=("env.critic_parts",)),
    "no_norm": Variant("no layer normalisation", usual=("sac.layer_norm",)),
    "unscaled": Variant("observations in SI units", usual=("env.scaled",)),
    "more_updates": Variant("twice the updates", changes={"sac.gradient_steps": 4}),
    "td3": Variant("TD3", changes={"algorithm": "td3"}),
    "thesis": Variant("recipe `thesis`, the same guide", recipe="thesis"),
    "last_weights": Variant("the last weights, no mean", usual=("sac.policy_average",)),
    "long_horizon": Variant("discount 0.995", changes={"sac.gamma": 0.995}),
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Settings of the measurement."""

    steps: int = 200_000
    """Environment steps of each training."""
    trials: int = 100
    """Episodes of each policy alone."""
    seconds: float = 60.0
    """Of each."""
    seeds: int = 1
    """Trainings of each variant."""
    variants: tuple[str, ...] = ()
    """Which; none: all."""
    jobs: int = 2
    """Trainings at once."""
    num_envs: int = 128
    """Environments of each training."""
    runs: Path = Path("out/ablation")
    """Folder of the trainings; those that are there are not done again, or go on."""


@dataclass(frozen=True)
class Ablation:
    """Trainings of several variants, side by side.

    Attributes:
        name: of the script.
        title: of the table.
        variants: by name.
        task: settings of all of them: what is turned, and who guides.
        about: the same for people.
        guided: share of the steps that are guided.
    """

    name: str
    title: str
    variants: Mapping[str, Variant]
    task: Mapping[str, Any] = field(
        default_factory=lambda: {"object": "cylinder", "controllers": ("coordinated",)}
    )
    about: str = "cylinder"
    guided: float = 1.0
    columns: ClassVar[tuple[str, ...]] = ("rotation [rad]", "full turn", "dropped", "return")

    def alone(self, given: Options) -> str:
        """How the policies are evaluated, for people."""
        return f"the policy alone in {given.trials} episodes of {given.seconds:g} s"

    def config(self, name: str, seed: int, given: Options) -> TrainConfig:
        """Everything that the training of a variant is."""
        variant, thesis = self.variants[name], TrainConfig()
        return changed(
            recipe(variant.recipe, variant.method),
            {
                **self.task,
                "threads": 1,
                "hard_stop": max(round(self.guided * given.steps), 1),
                "steps": given.steps,
                "num_envs": given.num_envs,
                "seed": seed,
                "log_every": 20_000,
                **{path: get(thesis, path) for path in variant.usual},
                **variant.changes,
            },
        ).with_mass()  # as a run keeps it

    def trained(self, name: str, seed: int, given: Options) -> tuple[str, dict[str, Any]]:
        """Train a variant, or go on: its folder, and what a row says of the training."""
        from learning.training.trainer import resume, train

        folder = given.runs / f"{name}-{seed}"
        wanted = self.config(name, seed, given)
        try:
            if RunFolder.is_run(folder) and RunFolder(folder).config() == wanted:
                found = resume(folder)
            else:
                found = train(wanted, folder)
        except KeyboardInterrupt:  # its checkpoint is saved; the pool would give it the next one
            os._exit(130)
        return str(folder), {
            "variant": name,
            "training_seed": seed,
            "config": to_plain(wanted),
            "steps": found["steps"],
            "training_seconds": round(float(found["last"]["seconds"]), 1),
        }

    def measure(self, name: str, seed: int, given: Options) -> dict[str, Any]:
        """Train a variant, or go on; evaluate its policy."""
        folder, row = self.trained(name, seed, given)
        who = open_subject(folder)
        alone = evaluate(who, who.protocol(episodes=given.trials, seconds=given.seconds, threads=1))
        return {
            **row,
            "rotation_rad": over_seeds(alone.rotation),
            "full_turn": share(alone.rotation >= FULL_TURN),
            "dropped": share(alone.dropped),
            "return_mean": round(float(alone.returns.mean()), 2),
        }

    def lines(self, rows: list[dict[str, Any]]) -> Iterator[list[str]]:
        """Of the table; seeds stand beside each other."""
        for name, variant in self.variants.items():
            each = [row for row in rows if row["variant"] == name]
            if each:
                cells = zip(*map(self.cells, each), strict=True)
                yield [variant.title, *map(", ".join, cells)]

    @staticmethod
    def cells(row: Mapping[str, Any]) -> list[str]:
        """What a training came to, under the `columns`."""
        return [
            f"{row['rotation_rad']['median']:.1f}",
            f"{100 * row['full_turn']['share']:.0f} %",
            f"{100 * row['dropped']['share']:.0f} %",
            f"{row['return_mean']:.0f}",
        ]

    def save(self, trials: list[dict[str, Any]], given: Options, *, say: bool) -> None:
        """Write the result with the rows so far."""
        seeds = ", ".join(map(str, sorted({row["training_seed"] for row in trials})))
        guided = "all" if self.guided == 1.0 else f"{100 * self.guided:g} %"
        table = {
            "title": f"{self.title}: {self.about}, {given.steps:,} steps, {guided} guided, "
            f"seed {seeds}; {self.alone(given)}",
            "header": ["", *self.columns],
            "rows": list(self.lines(trials)),
        }
        write(self.name, given, [], [table], trials=trials, say=say)

    def run(self, given: Options) -> None:
        """Train and evaluate those that are chosen."""
        chosen = given.variants or tuple(self.variants)
        measure_with_seeds(
            self.name, given, "variant", list(self.variants), chosen, self.config, self.measure,
            self.save, self.line,
        )  # fmt: skip

    @staticmethod
    def line(row: Mapping[str, Any]) -> str:
        """A row for whoever waits."""
        return f"{row['rotation_rad']['median']:.1f} rad"


def main() -> None:
    given = settings(Options, __doc__)
    Ablation("learning_ablation", "The recipe `fast` with one part changed", VARIANTS).run(given)


if __name__ == "__main__":
    main()
