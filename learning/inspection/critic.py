"""The critic of a run: what it finds the policy's and the controllers' actions worth."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from typing import NamedTuple

import numpy as np

from dexctl.exceptions import MissingExtra
from dexctl.settings import changed
from dexctl.state import Floats, GraspState
from learning.algorithms.config import OffPolicyConfig
from learning.evaluation import Subject
from learning.exploration.mixture import value_probabilities
from learning.training.run_folder import CheckpointError, RunFolder

_ROWS = 4096  # states valued at a time


class Valued(NamedTuple):
    """What a critic says of K candidates, the policy first.

    Attributes:
        values: the smaller of the critics' Q(s, a), ``(..., K)`` [rad/s, discounted].
        chances: softmax of them, p_pi and p_psi of the thesis, ``(..., K)``.
    """

    values: Floats
    chances: Floats


class Critic:
    """The critics of a run's checkpoint.

    Args:
        folder: of the run, whose algorithm has critics of actions.

    Attributes:
        temperature: of the choice by value in training.
        steps: environment steps at the checkpoint.

    Raises:
        InvalidInput, CheckpointError: the run's files are damaged, or of another version.
    """

    def __init__(self, folder: RunFolder) -> None:
        from learning.algorithms.networks import restore
        from learning.algorithms.off_policy import OffPolicy
        from learning.training.build import build_algorithm, build_env

        config, saved = folder.config(), folder.read_checkpoint()
        # the same networks, with the least of everything else
        least = {"buffer_size": config.learner.batch_size}  # type: ignore[union-attr]
        small = changed(
            config,
            {
                "num_envs": 1,
                "device": "cpu",
                "object": config.env.scene.object[:1],
                "initial_states": None,
                "threads": 1,
                config.algorithm: changed(config.learner, least),
            },
        )
        env = build_env(small)
        try:
            algorithm = build_algorithm(small, env)
            assert isinstance(algorithm, OffPolicy)
            self._algorithm, self._observations = algorithm, env.observations
            assert saved is not None
            restore(algorithm.networks, saved["algorithm"]["networks"])
            self.steps = int(saved["algorithm"]["steps"])
        except (RuntimeError, ValueError, LookupError, TypeError, AttributeError) as error:
            reason = " ".join(str(error).split())[:200]
            raise CheckpointError(
                f"{folder.checkpoint_path} does not fit the run's configuration: {reason}"
            ) from error
        finally:
            env.close()
        self.temperature = config.guidance.temperature

    def judge(self, states: GraspState, actions: Sequence[Floats]) -> Valued:
        """What candidates are worth.

        Args:
            states: how things are, ``(n,)``; critics are asked without noise.
            actions: of each candidate, the policy's first, ``(n, d)`` in [-1, 1].
        """
        observation = np.concatenate([one(states) for one in self._observations], axis=-1)
        stacked = np.stack(actions).astype(np.float32)  # (K, n, d)
        values = np.empty((len(observation), len(actions)))
        for start in range(0, len(observation), _ROWS):
            rows = slice(start, start + _ROWS)
            values[rows] = self._algorithm.values(observation[rows], stacked[:, rows]).T
        return Valued(values, value_probabilities(values, self.temperature))


def open_critic(subject: Subject) -> tuple[Critic | None, str | None]:
    """The critic of a subject's run, or None and why there is none.

    Raises:
        CheckpointError: the run's checkpoint is damaged, or of another version.
        MissingExtra: there is no torch to ask it.
    """
    folder = subject.folder
    if subject.kind == "controller":
        return None, "A controller has no critic, so there is no p_psi."
    if folder is None:
        return None, "A policy has no critic: p_psi needs the run folder, with its checkpoint."
    config = folder.config()
    if not isinstance(config.learner, OffPolicyConfig):
        found = f"The run's algorithm, {config.algorithm}, has no critic of actions"
        return None, f"{found}, so there is no p_psi."
    if config.env.history:
        return None, "The run's critic observes what was before, too, so there is no p_psi."
    if not folder.checkpoint_path.exists():
        name = folder.checkpoint_path.name
        return None, f"The run has no {name}, so there is no critic and no p_psi."
    if find_spec("torch") is None:
        raise MissingExtra("the critic of a run (its policy.npz can do without)", "learning")
    return Critic(folder), None
