"""``dexctl train``: trains a policy that explores with the controllers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from dexctl.cli.output import notes, print_json, results
from dexctl.cli.parsing import make_folder, parse_gravity
from dexctl.exceptions import InvalidInput, MissingExtra, UnknownName
from learning.cli_env_options import EnvOptions

if TYPE_CHECKING:
    from rich.progress import TaskID

    from learning.settings import TrainConfig


@dataclass(kw_only=True)
class Train:
    """Train a policy that explores with the controllers; it can be killed and resumed.

    Prints where the policy is. `dexctl train --resume RUN` goes on with a run that was killed.
    """

    method: str = "vge"
    """rl, rl+bc, fge, vge or vge+bc."""
    controller: tuple[str, ...] = ("gait",)
    """Controllers that guide, one or several; not used by the method rl."""
    recipe: str = "fast"
    """Settings that belong together: fast, which learns to gait within 1 million steps, or thesis.
    Each setting given on the command line goes before the recipe's."""
    algorithm: str = "sac"
    """sac (entropy coefficient 0) or td3."""
    hand: str = "dex5"
    """Name of the hand (`dexctl hands` lists them)."""
    object: tuple[str, ...] = ("cube",)
    """Object, or several that share out the environments."""
    gravity: str = "up"
    """Which way the palm looks: up, down, or gravity as x,y,z in m/s^2."""
    steps: int | None = None
    """Environment steps, of all environments together; 1 million by default, or what the resumed
    run was made for."""
    seed: int = 0
    """Of everything; the same seed and settings give the same policy on the same machine."""
    num_envs: int = 128
    """Environments stepped together."""
    episode_steps: int = 1000
    """Control steps of an episode."""
    scaled: bool = False
    """Bring observations to about unit size; the thesis has them in SI units."""
    horizon: int | None = None
    """Steps that a choice of who acts holds for; by default as long as the controller's motion."""
    hard_stop: int | None = None
    """Environment steps after which the controllers are asked no more; by default the recipe's:
    4 million in the thesis."""
    temperature: float = 1.0
    """Of the choice by value; 1 is the thesis's."""
    fixed_start: float = 1.0
    """Share of the controllers that FGE starts with."""
    beta: float | None = None
    """Weight of behaviour cloning that the methods with bc start with; by default the recipe's."""
    beta_end: float = 0.0
    """What it falls to."""
    beta_stop: int | None = None
    """The step at which it is there; by default the hard stop."""
    cloned: str | None = None
    """acted: clone what controllers did; visited: what the first would do wherever the policy
    goes."""
    cloning: str | None = None
    """likelihood, the thesis's, or squared; TD3 knows squared only."""
    cloning_weight: str | None = None
    """value, the thesis's; equal; or better: only where the critics prefer the controller."""
    gamma: float = 0.99
    """Discount."""
    batch_size: int = 512
    """Transitions of an update."""
    gradient_steps: int = 2
    """Updates for each step of all environments together."""
    learning_rate: float | None = None
    """Of actor and critics; by default the recipe's."""
    learning_rate_end: float | None = None
    """What the learning rate falls to; by default the recipe's: it stays, in the thesis."""
    decay_start: float = 0.5
    """Share of the steps from which on it falls."""
    policy_average: float | None = None
    """How much less each update counts than the next in the policy that is kept, a mean of the
    actor's weights; by default the recipe's: 0, the last weights, in the thesis."""
    tau: float | None = None
    """How far the target critics follow at each update; by default the recipe's."""
    n_step: int | None = None
    """Steps of the critics' returns; 1 in the thesis."""
    layer_norm: Literal["yes", "no"] | None = None
    """Layer normalisation in the critics; none in the thesis."""
    critic_parts: tuple[str, ...] | None = None
    """Parts of the observation that only the critics see; none in the thesis."""
    policy_delay: int | None = None
    """Updates of the critics to one of the actor; by default the algorithm's."""
    network: tuple[int, ...] = (256, 256)
    """Widths of the hidden layers."""
    buffer_size: int = 500_000
    """Transitions that are remembered; each takes about 0.6 kB of memory and of checkpoint."""
    learning_starts: int = 5_000
    """Steps before the first update."""
    overlap: bool = True
    """Let the environments step while the updates run; a policy then acts that is gradient-steps
    updates older."""
    env: EnvOptions = field(default_factory=EnvOptions)
    device: str = "auto"
    """auto takes a GPU where there is one; else cpu or cuda."""
    torch_threads: int = 1
    """Threads of the updates."""
    log_every: int = 10_000
    """Steps between two rows of progress.csv and TensorBoard."""
    checkpoint_every: int = 100_000
    """Steps between two checkpoints."""
    out: Path | None = None
    """Folder of the run; by default runs/METHOD-CONTROLLER-OBJECT-SEED."""
    resume: Path | None = None
    """Folder of a run to go on with; of the other options only --steps and --json count."""
    json: bool = False
    """Print the last figures as JSON."""

    def run(self) -> int:
        if find_spec("torch") is None or find_spec("stable_baselines3") is None:
            raise MissingExtra("dexctl train", "learning")
        if self.resume is None:
            config = self.config()
            folder = make_folder(self.folder(config))
            total = config.steps
        else:
            from learning.train import read_config

            folder = self.resume.expanduser()
            total = self.steps or read_config(folder).steps
        from learning.train import resume, train

        with _Bar(total) as bar:
            if self.resume is None:
                found = train(config, folder, report=bar.show, remark=bar.remark)
            else:
                found = resume(folder, self.steps, report=bar.show, remark=bar.remark)
        if self.json:
            print_json({"command": "train", "folder": str(folder), **found})
        else:
            results().print(
                f"policy: {found['policy']}, after {found['steps']} steps", soft_wrap=True
            )
        return 0

    def folder(self, config: TrainConfig) -> Path:
        """Where the run goes."""
        if self.out is not None:
            return self.out
        who = "" if self.method == "rl" else f"-{'-'.join(config.controllers)}"
        return Path("runs") / f"{self.method}{who}-{'-'.join(self.object)}-{self.seed}"

    def config(self) -> TrainConfig:
        """The configuration that the options describe.

        Raises:
            UnknownName, InvalidInput: an option is wrong.
        """
        from dexctl.sim import object_names
        from learning.exploration import GuidanceConfig
        from learning.recipes import recipe
        from learning.settings import TrainConfig

        for name in self.object:
            if name not in object_names():
                raise UnknownName("object", name, object_names())
        if not self.object:
            raise InvalidInput("--object is empty; expected one or several names")
        chosen = recipe(self.recipe, self.method)
        env = dict(chosen.env) | _given(scaled=self.scaled or None)
        guidance = dict(chosen.guidance) | _given(
            hard_stop=self.hard_stop,
            beta=self.beta,
            beta_stop=self.beta_stop,
            cloned=self.cloned,
            cloning=self.cloning,
            cloning_weight=self.cloning_weight,
        )
        training = dict(chosen.training) | _given(
            steps=self.steps,
            learning_rate=self.learning_rate,
            learning_rate_end=self.learning_rate_end,
            policy_average=self.policy_average,
            tau=self.tau,
            n_step=self.n_step,
            layer_norm=None if self.layer_norm is None else self.layer_norm == "yes",
            critic_parts=self.critic_parts,
        )
        return TrainConfig(
            env=self.env.config(
                hand=self.hand,
                object=self.object[0] if len(self.object) == 1 else self.object,
                gravity=parse_gravity(self.gravity),
                episode_steps=self.episode_steps,
                **env,
            ),
            guidance=GuidanceConfig(
                method=self.method,
                horizon=self.horizon,
                temperature=self.temperature,
                fixed_start=self.fixed_start,
                beta_end=self.beta_end,
                **guidance,
            ),
            controllers=self.controller,
            algorithm=self.algorithm,
            seed=self.seed,
            num_envs=self.num_envs,
            gamma=self.gamma,
            decay_start=self.decay_start,
            batch_size=self.batch_size,
            gradient_steps=self.gradient_steps,
            network=self.network,
            buffer_size=self.buffer_size,
            learning_starts=self.learning_starts,
            policy_delay=self.policy_delay,
            overlap=self.overlap,
            device=self.device,
            torch_threads=self.torch_threads,
            log_every=self.log_every,
            checkpoint_every=self.checkpoint_every,
            **training,
        )


def _given(**options: Any) -> dict[str, Any]:
    """Those that are not None."""
    return {name: value for name, value in options.items() if value is not None}


class _Bar:
    """The progress bar: steps, the figures of the last row, and the time left."""

    def __init__(self, total: int) -> None:
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

        self._console = notes()
        self._progress = Progress(
            TextColumn("{task.percentage:>3.0f} %"),
            BarColumn(bar_width=8),
            TextColumn("{task.description}"),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=self._console,
            speed_estimate_period=120.0,
        )
        self._total = total
        self._task: TaskID | None = None

    def __enter__(self) -> _Bar:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def show(self, step: int, row: Mapping[str, float]) -> None:
        """Called after each step of all environments."""
        if self._task is None:  # a resumed run does not start at 0
            self._task = self._progress.add_task("", total=self._total, completed=step)
        self._progress.update(self._task, completed=step, description=_figures(row))

    def remark(self, text: str) -> None:
        """A line above the bar."""
        self._console.print(f"dexctl: {text}", markup=False)


def _figures(row: Mapping[str, Any]) -> str:
    """The last row of the log in a few words."""
    words = []
    if "return" in row:
        words += [
            f"return {row['return']:.1f}",
            f"turned {row['rotation']:.2f} rad",
            f"drop {100 * row['dropped']:.0f} %",
        ]
    if "controller_share" in row:
        words.append(f"ctrl {100 * row['controller_share']:.0f} %")
    return "  ".join(words)
