"""What SAC and TD3 share: exploration with a guide, exact transitions, frozen critics."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from copy import deepcopy
from typing import Any

import numpy as np
import torch

from learning.agents.loop import OverlappedLoop
from learning.agents.losses import cloning_weight
from learning.agents.replay import GuidedReplayBuffer, GuidedSamples
from learning.exploration.guide import Guide, Guided


class GuidedExploration(OverlappedLoop):
    """Mixed in before a stable-baselines3 algorithm: its behaviour becomes the guide's.

    The two hook points are `_sample_action`, which decides who acts, and `_store_transition`,
    which keeps what the controllers did beside each transition.

    Attributes:
        guide: who acts; None explores as stable-baselines3 does.
        exploration_noise: standard deviation of what is added to the policy's actions, in units
            of the action space [-1, 1].
        average, averaged_actor: the mean of the actor's weights over its last updates, each
            counting this much less than the next; None where it is 0. It never acts: from one
            update to the next a policy may get better or worse, its mean less so.
        statistics: means over the last call of :meth:`train`, by name.
    """

    guide: Guide | None = None
    exploration_noise: float = 0.0
    critic: Any
    actor: Any
    replay_buffer: GuidedReplayBuffer | None

    def _begin(
        self, guide: Guide | None, exploration_noise: float, overlap: bool, average: float
    ) -> None:
        self.guide = guide
        self.exploration_noise = exploration_noise
        self.overlap = overlap
        self.average = average
        self.averaged_actor = None
        if average > 0:
            self.averaged_actor = deepcopy(self.actor).requires_grad_(False)
        self.statistics: dict[str, float] = {}
        self._choice: Guided | None = None

    def _sample_action(
        self,
        learning_starts: int,
        action_noise: Any = None,
        n_envs: int = 1,
    ) -> tuple[np.ndarray, np.ndarray]:
        """The actions of all environments, as the environment and as the memory take them."""
        assert self._last_obs is not None
        policy = self.policy
        if self.num_timesteps < learning_starts:
            shape = (n_envs, *self.action_space.shape)  # type: ignore[misc]
            learner = (2.0 * torch.rand(shape) - 1.0).numpy()
        else:
            learner = self._policy_actions(np.asarray(self._last_obs))
        if self.guide is None:
            self._choice = None
            return policy.unscale_action(learner), learner
        self._choice = self.guide.act(
            self.num_timesteps, policy.unscale_action(learner), self._values
        )
        action = self._choice.action
        return action, policy.scale_action(action).astype(np.float32)

    def _policy_actions(self, observation: np.ndarray) -> np.ndarray:
        """Sampled actions ``(N, d)`` in [-1, 1]."""
        with torch.no_grad():
            obs = torch.as_tensor(observation, dtype=torch.float32, device=self.device)
            action = self.actor(obs, deterministic=False) if self._stochastic else self.actor(obs)
            if self.exploration_noise:
                noise = self.exploration_noise * torch.randn_like(action)
                action = (action + noise).clamp_(-1.0, 1.0)
            return action.cpu().numpy()

    @property
    def _stochastic(self) -> bool:
        """Whether the actor draws its actions."""
        return hasattr(self.actor, "get_action_dist_params")

    def _values(self, rows: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """The smaller of the critics' values of actions ``(K, n, d)`` in ``rows``, ``(K, n)``."""
        count, n, d = actions.shape
        flat = self.policy.scale_action(actions.reshape(count * n, d))
        obs = np.tile(np.asarray(self._last_obs)[rows], (count, 1))
        with torch.no_grad():
            values = self.critic(
                torch.as_tensor(obs, dtype=torch.float32, device=self.device),
                torch.as_tensor(flat, dtype=torch.float32, device=self.device),
            )
            least = torch.cat(values, dim=1).min(dim=1).values
        return least.cpu().numpy().reshape(count, n)

    def _store_transition(
        self,
        replay_buffer: GuidedReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray,
        reward: np.ndarray,
        dones: np.ndarray,
        infos: Sequence[dict[str, Any]],
    ) -> None:
        """Keep a step of all environments; episodes cut by their time limit did not terminate."""
        assert self._last_obs is not None
        next_obs, terminated = new_obs, np.zeros(len(dones))
        ended = np.flatnonzero(dones)
        if len(ended):
            next_obs = new_obs.copy()
            for i in ended.tolist():
                next_obs[i] = infos[i]["terminal_observation"]
                terminated[i] = not infos[i].get("TimeLimit.truncated", False)
        choice = self._choice
        if choice is None:
            replay_buffer.add(
                self._last_obs,  # type: ignore[arg-type]
                next_obs,
                buffer_action,
                reward,
                terminated,
                ended=dones,
            )
        else:
            label = None
            if replay_buffer.labels:
                label = self.policy.scale_action(choice.label)
            replay_buffer.add(
                self._last_obs,  # type: ignore[arg-type]
                next_obs,
                buffer_action,
                reward,
                terminated,
                ended=dones,
                guided=choice.guided,
                guide_action=label,
            )
        if self.guide is not None:
            self.guide.after_step(np.asarray(dones, bool))
        self._last_obs = new_obs

    @property
    def diverged(self) -> bool:
        """Whether a weight is not finite: no update will mend it."""
        networks = [self.policy, self.averaged_actor]
        weights = [p for network in networks if network is not None for p in network.parameters()]
        return not all(bool(torch.isfinite(weight).all()) for weight in weights)

    def _excluded_save_params(self) -> list[str]:
        """Controllers hold solver handles, which do not pickle."""
        return [*super()._excluded_save_params(), "guide", "_choice", "averaged_actor"]

    def _cloning_weight(
        self, batch: GuidedSamples, policy_value: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor | float]:
        """See `learning.agents.losses.cloning_weight`; ``policy_value`` is ``(B, 1)``."""
        with torch.no_grad():
            found = self.critic(batch.observations, batch.guide_actions)
            least = torch.cat(found, dim=1).min(dim=1, keepdim=True).values
        kind = "value" if self.guide is None else self.guide.config.cloning_weight
        return cloning_weight(kind, least, policy_value.detach(), batch.guided)

    def _actor_updated(self) -> None:
        """To be called after each update of the actor."""
        if self.averaged_actor is not None:
            follow(self.averaged_actor, self.actor, 1.0 - self.average)

    def _beta(self) -> float:
        """Weight of behaviour cloning now."""
        return 0.0 if self.guide is None else self.guide.beta(self.num_timesteps)


@contextmanager
def frozen(module: torch.nn.Module) -> Iterator[None]:
    """No gradients for the parameters of ``module``; they flow through it all the same."""
    module.requires_grad_(False)
    try:
        yield
    finally:
        module.requires_grad_(True)


def follow(target: torch.nn.Module, source: torch.nn.Module, tau: float) -> None:
    """``target += tau (source - target)``, parameter by parameter, in one call."""
    ours: list[torch.Tensor] = list(target.parameters())
    theirs: list[torch.Tensor] = list(source.parameters())
    with torch.no_grad():
        torch._foreach_lerp_(ours, theirs, tau)  # pyright: ignore[reportPrivateImportUsage]


def means(sums: dict[str, torch.Tensor], count: int) -> dict[str, float]:
    """The sums over ``count`` updates as means."""
    return {name: float(value) / max(count, 1) for name, value in sums.items()}
