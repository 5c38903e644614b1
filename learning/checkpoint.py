"""Checkpoints: everything that decides the rest of a run, in one file, never half written.

A checkpoint is written beside the last one under another name, brought to the disk, and then
renamed over it: a run that is killed at any moment leaves the one or the other, whole. There is
one file, and one more while it is written. Its size is that of the filled part of the replay
buffer plus three times the networks' (weights, and Adam's two moments), plus the environments'
state; `GuidedReplayBuffer.nbytes` is the bound that counts.

The file holds pickled objects: load only what you wrote yourself.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import random
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch

from dexctl.exceptions import DexctlError
from learning.agents.guided import GuidedExploration
from learning.agents.vec_env import StableBaselinesVecEnv

FORMAT = 1
NAME = "checkpoint.pt"
PARTIAL = NAME + ".partial"


class CheckpointError(DexctlError, RuntimeError):
    """A checkpoint cannot be written, read, or continued from."""


class TrainingDiverged(DexctlError, RuntimeError):
    """The weights are no longer finite; the last checkpoint has those from before."""


def write(folder: Path, content: dict[str, Any]) -> Path:
    """Put ``content`` into the checkpoint of ``folder``, in place of the one before.

    Raises:
        CheckpointError: it cannot be written (a full disk, for one); the one before is left.
    """
    path, partial = folder / NAME, folder / PARTIAL
    writer = None
    try:
        with partial.open("wb") as file:
            writer = _Writer(file)
            torch.save({"format": FORMAT, **content}, writer)  # type: ignore[arg-type]
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except (OSError, RuntimeError) as error:  # torch reports a failed write as RuntimeError
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
        kept = "the one before is kept" if path.exists() else "there is none before it"
        cause = (writer and writer.failure) or error
        reason = getattr(cause, "strerror", None) or str(cause).partition("\n")[0]
        raise CheckpointError(f"cannot write {path}: {reason}; {kept}") from error
    _sync(folder)
    return path


class _Writer:
    """A file that remembers why writing failed, which torch does not tell."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.failure: OSError | None = None

    def write(self, data: bytes) -> int:
        try:
            return self._file.write(data)
        except OSError as error:
            self.failure = error
            raise

    def flush(self) -> None:
        self._file.flush()


def read(folder: Path) -> dict[str, Any]:
    """The content of the checkpoint of ``folder``.

    Raises:
        CheckpointError: there is none, it is damaged, or of another version.
    """
    path = folder / NAME
    if not path.exists():
        raise CheckpointError(f"there is no checkpoint in {folder}")
    try:
        content = torch.load(path, map_location="cpu", weights_only=False)
    except (
        OSError, RuntimeError, EOFError, ValueError, KeyError, AttributeError, ImportError,
        pickle.UnpicklingError,
    ) as error:  # fmt: skip
        reason = str(error).partition("\n")[0]
        raise CheckpointError(f"cannot read the checkpoint {path}: {reason}") from error
    found = content.get("format") if isinstance(content, dict) else None
    if found != FORMAT:
        raise CheckpointError(
            f"the checkpoint {path} has format {found}; this version reads format {FORMAT}"
        )
    return content


def capture(agent: GuidedExploration) -> dict[str, Any]:
    """Everything of an agent that decides what it does next, its environments included.

    To be taken between updates and rollouts. Large arrays are views: write them before the agent
    goes on.
    """
    env = agent.env
    assert isinstance(env, StableBaselinesVecEnv)
    assert agent.replay_buffer is not None
    averaged = agent.averaged_actor
    return {
        "algorithm": type(agent).__name__,
        "policy": agent.policy.state_dict(),
        "optimizers": {
            "actor": agent.actor.optimizer.state_dict(),
            "critic": agent.critic.optimizer.state_dict(),
        },
        "averaged_actor": averaged and averaged.state_dict(),
        "replay_buffer": agent.replay_buffer.state_dict(),
        "guide": None if agent.guide is None else agent.guide.state_dict(),
        "env": env.env.save(),
        "last_obs": np.array(agent._last_obs),
        "counters": {
            "num_timesteps": agent.num_timesteps,
            "_episode_num": agent._episode_num,
            "_n_updates": agent._n_updates,
        },
        "statistics": dict(agent.statistics),
        "random": _random_states(),
    }


def restore(agent: GuidedExploration, content: dict[str, Any]) -> None:
    """Put what `capture` gave into an agent built from the same configuration.

    Raises:
        CheckpointError: it was taken from another kind of agent.
    """
    env = agent.env
    assert isinstance(env, StableBaselinesVecEnv)
    assert agent.replay_buffer is not None
    if content["algorithm"] != type(agent).__name__:
        raise CheckpointError(
            f"the checkpoint is of a {content['algorithm']}; this run trains a "
            f"{type(agent).__name__}"
        )
    try:
        agent.policy.load_state_dict(content["policy"])
        if agent.averaged_actor is not None:  # a run may begin to average when it is resumed
            averaged = content.get("averaged_actor") or agent.actor.state_dict()
            agent.averaged_actor.load_state_dict(averaged)
        agent.actor.optimizer.load_state_dict(content["optimizers"]["actor"])
        agent.critic.optimizer.load_state_dict(content["optimizers"]["critic"])
        agent.replay_buffer.load_state_dict(content["replay_buffer"])
        env.env.restore(content["env"])
        if agent.guide is not None:
            agent.guide.load_state_dict(content["guide"])
    except (DexctlError, RuntimeError, ValueError, KeyError, TypeError) as error:
        reason = str(error).partition("\n")[0]
        raise CheckpointError(
            f"the checkpoint does not fit this configuration: {reason}"
        ) from error
    agent._last_obs = content["last_obs"].copy()
    for name, value in content["counters"].items():
        setattr(agent, name, value)
    agent.statistics = dict(content["statistics"])
    _restore_random_states(content["random"])


def _random_states() -> dict[str, Any]:
    cuda = torch.cuda.get_rng_state_all() if torch.cuda.is_available() else []
    return {
        "python": random.getstate(),
        "numpy": np.random.get_state(),  # noqa: NPY002 (what stable-baselines3 draws from)
        "torch": torch.get_rng_state(),
        "cuda": cuda,
    }


def _restore_random_states(saved: dict[str, Any]) -> None:
    random.setstate(saved["python"])
    np.random.set_state(saved["numpy"])  # noqa: NPY002
    torch.set_rng_state(saved["torch"])
    if saved["cuda"] and torch.cuda.is_available():
        torch.cuda.set_rng_state_all(saved["cuda"])


def _sync(folder: Path) -> None:
    """Bring the renaming to the disk, where folders can be synced."""
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
