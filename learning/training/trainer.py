"""Trainer: steps environments beside updates, asks the guide, logs and saves."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dexctl.exceptions import DexctlError, InvalidInput
from dexctl.settings import absolute, difference, from_plain, to_plain
from dexctl.sim.grasp_states import GraspStates
from learning import policies
from learning.algorithms.base import Transitions
from learning.algorithms.off_policy import OffPolicy
from learning.config import ALGORITHMS, TrainConfig
from learning.exploration import POLICY
from learning.starts.base import Remark
from learning.starts.catalogue import make_starts
from learning.starts.check import check_starts
from learning.starts.planned import planned_alike
from learning.training.build import build_algorithm, build_env, build_guide
from learning.training.checkpoint import CheckpointError
from learning.training.curriculum import Curriculum
from learning.training.export import export_policy, policy_spec
from learning.training.imitation import imitate
from learning.training.interruption import interruptible
from learning.training.log import RunLog, Tally, who_acted
from learning.training.run_folder import RunFolder

Report = Callable[[int, Mapping[str, float]], None]

# what may differ between a checkpoint's configuration and the run's: it fits all the same
_MAY_CHANGE = (
    "steps", "log_every", "checkpoint_every", "overlap", "device", "torch_threads", "threads",
    "learning_rate", "learning_rate_end", "decay_start", "gradient_steps", "batch_size", "gamma",
    "tau", "policy_average", "policy_delay", "actor_starts", "exploration_noise", "action_noise",
    "hard_stop", "beta", "beta_end", "beta_stop", "temperature", "fixed_start", "curriculum",
)  # fmt: skip


class TrainingDiverged(DexctlError, RuntimeError):
    """The weights are no longer finite; the last checkpoint has those from before."""


def train(
    config: TrainConfig,
    path: Path,
    *,
    report: Report | None = None,
    remark: Remark | None = None,
) -> dict[str, Any]:
    """Train from the beginning; what `resume` returns.

    Files that the configuration names are written down with their absolute paths, so that the run
    and its policy are found from any folder.

    Raises:
        InvalidInput: the folder holds a run already, or another process is at work in it.
    """
    folder = RunFolder(path)
    folder.check_new()
    config = absolute(config, Path.cwd())
    say = remark or (lambda text: None)
    # what is wrong with the configuration shows before a file is written
    trainer = Trainer(config, folder, report, remark)
    try:
        if trainer.env.simulation.starts is not None:  # those of a file
            check_starts(trainer.env.simulation, say)
        trainer.begin()
        with folder.lock():
            folder.create(trainer.config)
            folder.note_hand(trainer.env.hand, config.env.scene)
            say(f"the run is kept in {path}")
            trainer.take_starts()
            try:
                trainer.plan()
            except DexctlError:  # the same command may be given again with other settings
                folder.forget()
                say(f"the run has not begun, and nothing is kept in {path}")
                raise
            return trainer.run(None)
    finally:
        trainer.close()


def resume(
    path: Path,
    steps: int | None = None,
    *,
    report: Report | None = None,
    remark: Remark | None = None,
) -> dict[str, Any]:
    """Continue a run from its last checkpoint, or from the beginning where it has none.

    What was done after the checkpoint is done again, to the same bits.

    Args:
        path: of the run's folder.
        steps: train up to this many environment steps; None: as many as the run was made for.
        report: called with the steps so far and the last row of the log, after each step.
        remark: called with what people should know, a checkpoint that could not be written.

    Returns:
        Where the policy is, the steps, and the figures of the last row.

    Raises:
        InvalidInput, CheckpointError: there is no run in the folder, it cannot be continued, or
            another process is at work in it.
    """
    folder = RunFolder(path)
    config = folder.config()
    if steps is not None:
        config = replace(config, steps=steps)
    with folder.lock():
        folder.clean()
        saved = folder.read_checkpoint()
        trainer = Trainer(config, folder, report, remark)
        try:
            folder.note_hand(trainer.env.hand, config.env.scene)
            if saved is None:
                trainer.begin()
            trainer.plan()
            return trainer.run(saved)
        finally:
            trainer.close()


class Trainer:
    """One training run.

    A turn chooses the actions of all environments, lets them take their step, shows the algorithm
    what came of it, and updates:

    - not overlapped: choose, step, observe, update;
    - overlapped: choose, then step in a thread of its own *while* updating, then observe.

    So the updates that follow a step run beside the next one. There are as many of them; the one
    difference is that the policy which acts is older by the updates of one turn. Nothing is shared
    between the two sides while they overlap, and a turn ends with both finished: runs repeat to
    the bit, and between two turns a checkpoint is the whole truth.

    Args:
        config: of the run.
        folder: where it is kept.
        report: called with the steps so far and the last row of the log, after each turn.
        remark: called with what people should know.

    Attributes:
        env, guide, algorithm, curriculum: what the configuration describes.
        row: the last one of the log.
        stop: set it, and the run saves and raises KeyboardInterrupt before the next turn.
    """

    def __init__(
        self,
        config: TrainConfig,
        folder: RunFolder,
        report: Report | None = None,
        remark: Remark | None = None,
    ) -> None:
        torch.set_num_threads(config.torch_threads)
        self.folder = folder
        self.env = build_env(config)
        self.config = config = config.with_mass(self.env.hand.config)
        self._remark = remark or (lambda text: None)
        self.guide = build_guide(config, self.env, self._remark)
        self.algorithm = build_algorithm(config, self.env)
        self.curriculum = Curriculum(config.curriculum, config.env.episode_steps)
        self.starts = make_starts(config.starts, self.env, config.seed)
        self.tally = Tally()
        self.row: dict[str, float] = {}
        self.stop = False
        self._report = report or (lambda step, row: None)
        self._next_log, self._next_checkpoint = config.log_every, config.checkpoint_every
        self._begin_clocks(0.0, 0.0)
        self.env.simulation.randomiser.schedule = config.curriculum.level_schedule
        self.env.simulation.randomiser.level = self.curriculum.level
        self._observation, _ = self.env.reset()
        self._log: RunLog | None = None

    def plan(self) -> None:
        """Make or read the states that episodes start from, which may take minutes; before `run`.

        Raises:
            InvalidInput, SimulationError: there are none, or too few.
        """
        self.starts.begin(self.folder.starts_path, self._remark)

    def run(self, saved: dict[str, Any] | None) -> dict[str, Any]:
        """After `plan`, train, from a checkpoint's content or from the beginning; see `resume`."""
        resume_at = None
        if saved is None:
            self._prepare()
        else:
            self._restore(saved)
            resume_at = self.algorithm.steps
        self._log = RunLog(
            self.folder.progress_path, self.folder.tensorboard_path, resume_at, self.config.guides
        )
        if self.algorithm.steps < self.config.steps:
            # the pool waits for a step that is under way, also where an update fails
            with interruptible(self), ThreadPoolExecutor(1, "environments") as pool:
                while self.algorithm.steps < self.config.steps:
                    self._between_turns()
                    self.turn(pool)
            if self.algorithm.steps > self.row.get("step", -1):
                self._write_row()
            self.save()
            self._report(self.algorithm.steps, self.row)
        else:  # a kill may have come between the last checkpoint and its policy
            self._export()
        policy = str(self.folder.policy_path)
        return {"policy": policy, "steps": self.algorithm.steps, "last": self.row}

    def _prepare(self) -> None:
        """What comes before the first step of a new run."""
        if self.env.simulation.starts is None:
            return
        if self.config.imitation.imitated != "none":
            imitate(self.algorithm, self.env, self.config.imitation, self.config.seed)
        self._observation, _ = self.env.reset(seed=self.config.seed)

    def begin(self) -> None:
        """Take the networks of another run, or a policy, where the configuration names one.

        Raises:
            InvalidInput: there is no such run or policy, the run has no checkpoint, the networks
                are of another shape, or the policy is for other observations or actions.
        """
        begun = self.config.begin_from
        if begun is None:
            return
        try:
            if RunFolder.is_run(begun):
                saved = RunFolder(begun).read_checkpoint()
                if saved is None:
                    raise InvalidInput("there is no checkpoint in it yet")
                self.algorithm.begin_as(saved["algorithm"])
            else:
                policy = policies.load(str(begun), hand=self.env.hand)
                policy.spec.check_like(policy_spec(self.algorithm, self.env, self.config))
                self.algorithm.begin_with([(layer.weight, layer.bias) for layer in policy.layers])
                if isinstance(self.algorithm, OffPolicy):  # measured: docs/learning.md
                    self._remark(
                        f"{begun} is a policy alone, and critics that have seen one policy mislead "
                        "an actor: it falls before it rises; as a guide (--method vge "
                        f"--controllers {begun}) it teaches a new one without that"
                    )
        except (DexctlError, KeyError) as error:
            raise InvalidInput(f"begin_from is {begun}: {error}") from None

    def take_starts(self) -> None:
        """Take what was planned for the run that this one begins with, where it would be the same.

        Planning takes minutes for each object.
        """
        begun = self.config.begin_from
        if begun is None or not RunFolder.is_run(begun):
            return
        other = RunFolder(begun)
        if (
            other.starts_path.exists()
            and planned_alike(self.config, other.config())
            and other.hand_digest() == self.env.hand.digest  # folders of earlier versions: None
            and other.hand_widths() == self.folder.hand_widths()
        ):
            GraspStates.load(other.starts_path).save(self.folder.starts_path)
            self._remark(f"states to start from are those of {begun}")

    def turn(self, pool: ThreadPoolExecutor) -> None:
        """One step of all environments, and the updates that are due."""
        algorithm, env, seen = self.algorithm, self.env, self._observation
        before = algorithm.steps
        try:
            wanted = algorithm.act(seen)
            chosen = self.guide.act(before, wanted, partial(self._values, seen))
            if self.config.overlap and algorithm.overlaps:
                pending = pool.submit(env.step, chosen.action)
                self._update()
                found = pending.result()
            else:
                found = env.step(chosen.action)
            self._observation, reward, terminated, _, info = found
            algorithm.observe(
                Transitions(
                    observation=seen,
                    action=np.asarray(chosen.action, np.float32),
                    reward=reward,
                    next_observation=info["final_obs"],
                    terminated=terminated,
                    ended=info["done"],
                    guided=chosen.guided,
                    guide_action=chosen.label,
                )
            )
        except (InvalidInput, ValueError) as error:  # of actions or values that are not finite
            if algorithm.diverged:
                raise self._diverged() from error
            raise
        lost = info["dropped"] | info["diverged"]
        if self.curriculum.add(self.guide.own(before), lost):
            env.simulation.randomiser.level = self.curriculum.level
        self.guide.after_step(info["done"])
        self.starts.after_step(algorithm.steps, info["done"])
        self.tally.add(reward, np.flatnonzero(info["done"]), info)
        if not (self.config.overlap and algorithm.overlaps):
            self._update()

    def _values(self, seen: np.ndarray, rows: np.ndarray, actions: np.ndarray) -> np.ndarray:
        return self.algorithm.values(seen[rows], actions)

    def _update(self) -> None:
        steps = self.algorithm.steps
        left = max(0.0, 1.0 - steps / self.config.steps)
        self.algorithm.update(beta=self.guide.beta(steps), left=left)

    def _between_turns(self) -> None:
        """Where a checkpoint is the whole truth."""
        step = self.algorithm.steps
        if step >= self._next_log:
            self._write_row()
        if step >= self._next_checkpoint:
            try:
                self.save()
            except (CheckpointError, OSError) as error:  # go on: nothing is lost yet
                self._remark(str(error))
        self._report(step, self.row)
        if self.stop:
            self.save()
            raise KeyboardInterrupt(
                f"interrupted at step {step}: checkpoint and policy are saved in "
                f"{self.folder.path}; `dexctl train --resume {self.folder.path}` goes on"
            )

    def _write_row(self) -> None:
        algorithm, guide = self.algorithm, self.guide
        acted, chances, choices = guide.take_counts()
        self.row = {
            "step": algorithm.steps,
            "updates": algorithm.updates,
            **self.tally.row(),
            "controller_share": float(1.0 - acted[POLICY] / max(acted.sum(), 1)),
            **who_acted(acted, chances, choices, self.config.guides),
            **self.curriculum.row(),
            **algorithm.statistics,
            "beta": guide.beta(algorithm.steps),
            "seconds": self.seconds,
        }
        if self.cpu_seconds is not None:
            self.row["cpu_seconds"] = self.cpu_seconds
        assert self._log is not None
        try:
            self._log.write(self.row)
        except OSError as error:  # a full disk; the row is kept and written with the next one
            self._remark(f"cannot write {self._log.path}: {error.strerror}")
        self._next_log = _next(algorithm.steps, self.config.log_every)

    @property
    def seconds(self) -> float:
        """Training time so far, interruptions left out [s]."""
        return self._seconds + time.monotonic() - self._since

    @property
    def cpu_seconds(self) -> float | None:
        """Processor time of that, all threads [s]; None where a part of it was not counted."""
        return None if self._cpu is None else self._cpu + time.process_time() - self._cpu_since

    def _begin_clocks(self, seconds: float, cpu: float | None) -> None:
        self._seconds, self._since = seconds, time.monotonic()
        self._cpu, self._cpu_since = cpu, time.process_time()

    def save(self) -> None:
        """Write checkpoint and policy.

        Raises:
            TrainingDiverged: the weights are not finite; the checkpoint before is left.
        """
        if self._log is not None:
            self._log.sync()
        algorithm = self.algorithm
        if algorithm.diverged:
            raise self._diverged()
        self._next_checkpoint = _next(algorithm.steps, self.config.checkpoint_every)
        self.folder.write_checkpoint(
            {
                "config": to_plain(self.config),
                "algorithm": algorithm.state_dict(),
                "guide": self.guide.state_dict(),
                "starts": self.starts.state_dict(),
                "env": self.env.save(),
                "curriculum": self.curriculum.save(),
                "observation": self._observation,
                "run": {
                    "tally": dict(self.tally.sums),
                    "row": dict(self.row),
                    "next_log": self._next_log,
                    "next_checkpoint": self._next_checkpoint,
                    "seconds": self.seconds,
                    "cpu_seconds": self.cpu_seconds,
                },
            }
        )
        self._export()

    def _export(self) -> None:
        export_policy(self.algorithm, self.env, self.config, self.folder.policy_path, self.row)

    def _restore(self, saved: Mapping[str, Any]) -> None:
        """Continue from what a checkpoint has.

        Raises:
            CheckpointError: it is of another configuration, or lacks something.
        """
        where = self.folder.checkpoint_path
        then = _with_defaults(saved.get("config", {}))
        other = difference(_fixed(then), _fixed(to_plain(self.config)))
        if other is not None:
            raise CheckpointError(
                f"{where} does not fit {self.folder.config_path.name}: {other}; put that back, or "
                "begin anew in another folder"
            )
        try:
            self.algorithm.load_state_dict(saved["algorithm"])
            self.starts.load_state_dict(saved["starts"])
            self.env.restore(saved["env"])
            for text in self.guide.load_state_dict(saved["guide"]):
                self._remark(text)
            self.curriculum.restore(saved["curriculum"])
            self._observation = saved["observation"].copy()
            run = saved["run"]
            self.tally.sums, self.row = dict(run["tally"]), dict(run["row"])
            self._next_log, self._next_checkpoint = run["next_log"], run["next_checkpoint"]
            self._begin_clocks(run["seconds"], run.get("cpu_seconds"))  # not in earlier ones
        except (
            DexctlError,
            RuntimeError,
            ValueError,
            KeyError,
            TypeError,
            AttributeError,
        ) as error:
            reason = " ".join(str(error).split())[:200]
            raise CheckpointError(f"{where} does not fit this configuration: {reason}") from error

    def _diverged(self) -> TrainingDiverged:
        there = self.folder.checkpoint_path.exists()
        kept = "the checkpoint from before is kept" if there else "there is no checkpoint yet"
        return TrainingDiverged(
            f"training diverged before step {self.algorithm.steps}: weights are not finite; "
            f"{kept}; a lower learning rate may help"
        )

    def close(self) -> None:
        """Close logs and environments."""
        if self._log is not None:
            self._log.close()
        self.env.close()


def _with_defaults(config: Mapping[str, Any]) -> Mapping[str, Any]:
    """The same; settings that have come since it was written are as by default, as they were."""
    try:
        return to_plain(from_plain(TrainConfig, config))
    except DexctlError:
        return config  # what it has that there is no more will be told


def _fixed(config: Mapping[str, Any]) -> dict[str, Any]:
    """What a checkpoint depends on, of a configuration as `to_plain` has it."""
    chosen = config.get("algorithm")
    found = {}
    for name, value in config.items():
        if name in _MAY_CHANGE or (name in ALGORITHMS and name != chosen):
            continue
        found[name] = _fixed(value) if isinstance(value, Mapping) else value
    return found


def _next(step: int, every: int) -> int:
    """The first multiple of ``every`` beyond ``step``."""
    return (step // every + 1) * every
