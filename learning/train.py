"""Training: a configuration and a folder become a policy, with logs and checkpoints on the way.

What the folder of a run holds is in `learning.training.run_folder`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from stable_baselines3.common.callbacks import BaseCallback

from dexctl import controllers
from dexctl.exceptions import DexctlError, InvalidInput
from learning.agents import GuidedReplayBuffer, GuidedSAC, GuidedTD3, StableBaselinesVecEnv, state
from learning.agents.networks import GuidedSACPolicy, GuidedTD3Policy
from learning.envs import make_vector
from learning.exploration import POLICY, Guide
from learning.export import Agent, actor_observation, export_policy
from learning.settings import TrainConfig
from learning.training.checkpoint import CheckpointError
from learning.training.interruption import interruptible
from learning.training.log import RunLog, Tally, who_acted
from learning.training.run_folder import RunFolder

Report = Callable[[int, Mapping[str, float]], None]


class TrainingDiverged(DexctlError, RuntimeError):
    """The weights are no longer finite; the last checkpoint has those from before."""


def train(
    config: TrainConfig,
    folder: Path,
    *,
    report: Report | None = None,
    remark: Callable[[str], None] | None = None,
) -> dict[str, Any]:
    """Train from the beginning; what `resume` returns.

    Raises:
        InvalidInput: the folder holds a run already.
    """
    run = RunFolder(folder)
    agent = build(config)  # what is wrong with the configuration shows before a file is written
    run.create(config.to_dict())
    return _run(agent, config, run, None, report, remark)


def resume(
    folder: Path,
    steps: int | None = None,
    *,
    report: Report | None = None,
    remark: Callable[[str], None] | None = None,
) -> dict[str, Any]:
    """Continue a run from its last checkpoint, or from the beginning where it has none.

    What was done after the checkpoint is done again, to the same bits.

    Args:
        folder: of the run.
        steps: train up to this many environment steps; None: as many as the run was made for.
        report: called with the steps so far and the last row of the log, after each step.
        remark: called with what people should know, a checkpoint that could not be written.

    Returns:
        Where the policy is, the steps, and the figures of the last row.

    Raises:
        InvalidInput, CheckpointError: there is no run in the folder, or it cannot be continued.
    """
    config = read_config(folder)
    if steps is not None:
        config = replace(config, steps=steps)
    run = RunFolder(folder)
    return _run(build(config), config, run, run.read_checkpoint(), report, remark)


def read_config(folder: Path) -> TrainConfig:
    """The configuration of the run in ``folder``.

    Raises:
        InvalidInput: there is none.
    """
    return TrainConfig.from_dict(RunFolder(folder).config_values())


def build(config: TrainConfig) -> Agent:
    """The agent, with its environments and controllers, as it is before the first step."""
    device = _device(config.device)
    torch.set_num_threads(config.torch_threads)
    seen = replace(config.env, parts=(*config.env.parts, *config.critic_parts))
    env = make_vector(seen, config.num_envs, config.seed)
    names = () if config.guidance.method == "rl" else config.controllers
    period = config.env.control_period
    guide = Guide(
        env,
        [
            controllers.make(name, env.hand, control_period=period, axis=config.env.direction)
            for name in names
        ],
        config.guidance,
        config.seed,
    )
    options: dict[str, Any] = {
        "guide": guide,
        "overlap": config.overlap,
        "learning_rate": _learning_rate(config),
        "buffer_size": config.buffer_size,
        "learning_starts": config.learning_starts,
        "batch_size": config.batch_size,
        "tau": config.tau,
        "gamma": config.gamma,
        "train_freq": 1,
        "gradient_steps": config.gradient_steps,
        "replay_buffer_class": GuidedReplayBuffer,
        "replay_buffer_kwargs": {
            "labels": config.guidance.labels_all,
            "n_step": config.n_step,
            "gamma": config.gamma,
            "seed": config.seed,
        },
        "policy_kwargs": {
            "net_arch": list(config.network),
            "optimizer_kwargs": {"fused": True},
            "actor_size": actor_observation(config, env).size if config.critic_parts else None,
            "layer_norm": config.layer_norm,
        },
        "policy_delay": config.policy_delay,
        "average": config.policy_average,
        "seed": config.seed,
        "device": device,
    }
    vec_env = StableBaselinesVecEnv(env)
    if config.algorithm == "td3":
        return GuidedTD3(
            GuidedTD3Policy, vec_env, exploration_noise=config.exploration_noise, **options
        )
    return GuidedSAC(GuidedSACPolicy, vec_env, **options)


def _learning_rate(config: TrainConfig) -> float | Callable[[float], float]:
    """The learning rate, or what it is when this share of the training is left."""
    first, last, start = config.learning_rate, config.learning_rate_end, config.decay_start
    if last is None or start >= 1:
        return first

    def rate(left: float) -> float:
        return first + (last - first) * max(0.0, (1.0 - left - start) / (1.0 - start))

    return rate


def _device(name: str) -> str:
    available = torch.cuda.is_available()
    if name == "cuda" and not available:
        raise InvalidInput("device is 'cuda', and torch finds no GPU here; expected cpu or auto")
    return ("cuda" if available else "cpu") if name == "auto" else name


def _run(
    agent: Agent,
    config: TrainConfig,
    folder: RunFolder,
    saved: dict[str, Any] | None,
    report: Report | None,
    remark: Callable[[str], None] | None,
) -> dict[str, Any]:
    resume_at = None if saved is None else saved["counters"]["num_timesteps"]
    log = RunLog(folder, resume_at, _guides(config))
    keeper = _Keeper(config, folder, log, report, remark)
    try:
        if saved is not None:
            state.restore(agent, saved)
            keeper.restore(saved["run"])
            del saved
        left = config.steps - agent.num_timesteps
        if left > 0:
            try:
                with interruptible(keeper):
                    agent.learn(left, callback=keeper, reset_num_timesteps=False)
            except (InvalidInput, ValueError) as error:  # of actions or values that are not finite
                if agent.diverged:
                    raise keeper.diverged() from error
                raise
            keeper.finish()
        else:  # a kill may have come between the last checkpoint and its policy
            export_policy(agent, config, folder.policy_path, keeper.row)
    finally:
        log.close()
        assert agent.env is not None
        agent.env.close()
    return {
        "policy": str(folder.policy_path),
        "steps": agent.num_timesteps,
        "last": keeper.row,
    }


class _Keeper(BaseCallback):
    """Counts, logs and saves, between the updates and the next step."""

    def __init__(
        self,
        config: TrainConfig,
        folder: RunFolder,
        log: RunLog,
        report: Report | None,
        remark: Callable[[str], None] | None,
    ) -> None:
        super().__init__()
        self.config, self.folder, self.log = config, folder, log
        self.report, self.remark = report, remark
        self.tally = Tally()
        self.row: dict[str, float] = {}
        self.stop = False
        self._next_log = config.log_every
        self._next_checkpoint = config.checkpoint_every
        self._seconds, self._since = 0.0, time.monotonic()

    def _agent(self) -> Agent:
        assert isinstance(self.model, GuidedSAC | GuidedTD3)
        return self.model

    def _on_step(self) -> bool:
        env = self._agent().env
        assert isinstance(env, StableBaselinesVecEnv)
        self.tally.add(self.locals["rewards"], env.ended, env.info)
        return True

    def _on_rollout_start(self) -> None:
        """Between an update and the next step, where a checkpoint is the whole truth."""
        step = self._agent().num_timesteps
        if step >= self._next_log:
            self._write_row()
        if step >= self._next_checkpoint:
            try:
                self.save()
            except (CheckpointError, OSError) as error:  # go on: nothing is lost yet
                self._say(str(error))
        if self.report is not None:
            self.report(step, self.row)
        if self.stop:
            self.save()
            raise KeyboardInterrupt

    def _say(self, text: str) -> None:
        if self.remark is not None:
            self.remark(text)

    def finish(self) -> None:
        """The last row, checkpoint and policy."""
        if self._agent().num_timesteps > self.row.get("step", -1):
            self._write_row()
        self.save()
        if self.report is not None:
            self.report(self._agent().num_timesteps, self.row)

    def _write_row(self) -> None:
        agent = self._agent()
        guide = agent.guide
        assert guide is not None
        acted, chances, choices = guide.take_counts()
        self.row = {
            "step": agent.num_timesteps,
            "updates": agent._n_updates,
            **self.tally.row(),
            "controller_share": float(1.0 - acted[POLICY] / max(acted.sum(), 1)),
            **who_acted(acted, chances, choices, _guides(self.config)),
            **agent.statistics,
            "beta": guide.beta(agent.num_timesteps),
            "seconds": self.seconds,
        }
        try:
            self.log.write(self.row)
        except OSError as error:  # a full disk; the row is kept and written with the next one
            self._say(f"cannot write {self.log.path}: {error.strerror}")
        self._next_log = _next(agent.num_timesteps, self.config.log_every)

    @property
    def seconds(self) -> float:
        """Training time so far, interruptions left out [s]."""
        return self._seconds + time.monotonic() - self._since

    def save(self) -> None:
        """Checkpoint and policy.

        Raises:
            TrainingDiverged: the weights are not finite; the checkpoint before is left.
        """
        self.log.sync()
        agent = self._agent()
        if agent.diverged:
            raise self.diverged()
        self._next_checkpoint = _next(agent.num_timesteps, self.config.checkpoint_every)
        run = {
            "tally": dict(self.tally.sums),
            "row": dict(self.row),
            "next_log": self._next_log,
            "next_checkpoint": self._next_checkpoint,
            "seconds": self.seconds,
        }
        self.folder.write_checkpoint({**state.capture(agent), "run": run})
        export_policy(agent, self.config, self.folder.policy_path, self.row)

    def diverged(self) -> TrainingDiverged:
        """What to say where the weights are not finite."""
        there = self.folder.checkpoint_path.exists()
        kept = "the checkpoint from before is kept" if there else "there is no checkpoint yet"
        return TrainingDiverged(
            f"training diverged before step {self._agent().num_timesteps}: weights are not finite; "
            f"{kept}; a lower learning rate may help"
        )

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Continue from what a checkpoint has."""
        self.tally.sums = dict(saved["tally"])
        self.row = dict(saved["row"])
        self._next_log = saved["next_log"]
        self._next_checkpoint = saved["next_checkpoint"]
        self._seconds, self._since = saved["seconds"], time.monotonic()


def _guides(config: TrainConfig) -> tuple[str, ...]:
    """Names of the controllers that guide a run; none for method "rl"."""
    return () if config.guidance.method == "rl" else config.controllers


def _next(step: int, every: int) -> int:
    """The first multiple of ``every`` beyond ``step``."""
    return (step // every + 1) * every
