"""The critic of a run: what it finds the policy's and the controllers' actions worth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from dexctl.state import Floats, GraspState
from learning.exploration.mixture import value_probabilities
from learning.training import checkpoint
from learning.training.run_folder import RunFolder

if TYPE_CHECKING:
    from learning.policies import Policy
    from learning.settings import TrainConfig

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
        folder: of the run.
        config: of the run.

    Attributes:
        temperature: of the choice by value in training.
        steps: environment steps at the checkpoint.

    Raises:
        CheckpointError: there is none, it is damaged or of another version.
    """

    def __init__(self, folder: Path, config: TrainConfig) -> None:
        from learning.agents import StableBaselinesVecEnv
        from learning.train import build

        saved = checkpoint.read(RunFolder(folder).checkpoint_path)
        # the same networks, with the least of everything else
        small = replace(
            config,
            env=replace(config.env, object=config.env.objects[0], threads=1, initial_states=None),
            guidance=replace(config.guidance, method="rl"),
            num_envs=1,
            buffer_size=config.batch_size,
            device="cpu",
        )
        self._agent = build(small)
        assert isinstance(self._agent.env, StableBaselinesVecEnv)
        self._observation = self._agent.env.env.observation
        self._agent.env.close()
        try:
            self._agent.policy.load_state_dict(saved["policy"])
        except (RuntimeError, KeyError, TypeError) as error:
            reason = " ".join(str(error).split())[:200]
            raise checkpoint.CheckpointError(
                f"the checkpoint in {folder} does not fit the run's configuration: {reason}"
            ) from error
        self.temperature = config.guidance.temperature
        self.steps = int(saved["counters"]["num_timesteps"])

    def judge(self, policy: Policy, states: GraspState, changes: Sequence[Floats]) -> Valued:
        """What the candidates' set-point changes ``(..., d)`` [rad] are worth in ``states``.

        The policy's own action comes first; it is made here, without the exploration noise and
        draws of training.
        """
        batch, d = states.batch_shape, states.q.shape[-1]
        seen = policy.observation(states).reshape(-1, policy.observation.size)
        # the critics' own observation, whatever the policy's is
        observation = self._observation(states).reshape(-1, self._observation.size)
        actions = [policy.predict(seen)]
        actions += [policy.action.from_change(change).reshape(-1, d) for change in changes]
        stacked = np.stack(actions).astype(np.float32)  # (K, n, d)
        values = np.empty((len(observation), len(actions)))
        for start in range(0, len(observation), _ROWS):
            rows = slice(start, start + _ROWS)
            part = observation[rows]
            self._agent._last_obs = part
            values[rows] = self._agent._values(np.arange(len(part)), stacked[:, rows]).T
        values = values.reshape(*batch, len(actions))
        return Valued(values, value_probabilities(values, self.temperature))
