"""stable-baselines3's algorithms with our settings, and our environments as it takes them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from learning.algorithms.config import PPOConfig, SACConfig

_NOTHING: dict[str, Any] = {}


def stock_sac(of: SACConfig, env: gymnasium.vector.VectorEnv, seed: int) -> SAC:
    """Its SAC with the numbers of ours; the entropy coefficient stays as it is, too."""
    return SAC(
        "MlpPolicy",
        StockVecEnv(env),
        ent_coef=of.entropy_coefficient,
        learning_rate=of.learning_rate,
        buffer_size=of.buffer_size,
        learning_starts=of.learning_starts,
        batch_size=of.batch_size,
        tau=of.tau,
        gamma=of.gamma,
        train_freq=1,
        gradient_steps=of.gradient_steps,
        policy_kwargs={"net_arch": list(of.network)},
        seed=seed,
        device="cpu",
    )


def stock_ppo(of: PPOConfig, env: gymnasium.vector.VectorEnv, seed: int) -> PPO:
    """Its PPO with the numbers of ours.

    What has no setting stays as each has it: its mean action is not squashed, its weights begin
    orthogonal, one gradient is cut for actor and critic, advantages are normalised in each
    minibatch, and values are not clipped.
    """
    adapted: VecEnv = StockVecEnv(env)
    if of.normalise:
        adapted = VecNormalize(adapted, norm_reward=False)
    return PPO(
        "MlpPolicy",
        adapted,
        learning_rate=of.learning_rate,
        n_steps=of.rollout_steps,
        batch_size=env.num_envs * of.rollout_steps // of.minibatches,
        n_epochs=of.epochs,
        gamma=of.gamma,
        gae_lambda=of.gae_lambda,
        clip_range=of.clip,
        ent_coef=of.entropy_coefficient,
        vf_coef=of.value_weight,
        max_grad_norm=of.max_gradient,
        policy_kwargs={
            "net_arch": list(of.network),
            "activation_fn": torch.nn.ReLU,
            "log_std_init": float(np.log(of.initial_deviation)),
        },
        seed=seed,
        device="cpu",
    )


class StockVecEnv(VecEnv):
    """A vector environment as stable-baselines3 takes it; no loop over environments.

    Both reset in the same step (gymnasium's `AutoresetMode.SAME_STEP`): what `step` returns for
    an environment whose episode ended is the first observation of the next one. The one that it
    ended with is ``infos[i]["terminal_observation"]``, and ``infos[i]["TimeLimit.truncated"]`` says
    that it did not terminate. Environments whose episode goes on share one empty info.
    """

    def __init__(self, env: gymnasium.vector.VectorEnv) -> None:
        self.env = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self._actions = np.zeros(env.action_space.shape or ())

    def reset(self) -> np.ndarray:
        return self.env.reset()[0]

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        seen, reward, terminated, truncated, info = self.env.step(self._actions)
        done = terminated | truncated
        infos = [_NOTHING] * self.num_envs
        for i in np.flatnonzero(done):  # few, if any
            infos[i] = {
                "terminal_observation": info["final_obs"][i],
                "TimeLimit.truncated": bool(truncated[i] and not terminated[i]),
            }
        return seen, reward.astype(np.float32), done, infos

    def close(self) -> None:
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        value = getattr(self.env, attr_name)
        return [value for _ in self._chosen(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise NotImplementedError("the environments of a batch share their attributes")

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        raise NotImplementedError("the environments of a batch are called together")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        return [False for _ in self._chosen(indices)]

    def _chosen(self, indices: Any) -> Iterable[int]:
        if indices is None:
            return range(self.num_envs)
        return [indices] if isinstance(indices, int) else indices
