"""Stock stable-baselines3 SAC on our environments: what our learner is compared with."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import VecEnv

from learning.config import TrainConfig
from learning.envs.vector import ManipulationVectorEnv, make_vector

_NOTHING: dict[str, Any] = {}


def stock_sac(of: TrainConfig) -> SAC:
    """With the numbers of our SAC's configuration, and entropy coefficient 0 like ours."""
    sac = of.sac
    return SAC(
        "MlpPolicy",
        StockVecEnv(make_vector(of.env, of.num_envs, of.seed)),
        ent_coef=0.0,
        learning_rate=sac.learning_rate,
        buffer_size=sac.buffer_size,
        learning_starts=sac.learning_starts,
        batch_size=sac.batch_size,
        tau=sac.tau,
        gamma=sac.gamma,
        train_freq=1,
        gradient_steps=sac.gradient_steps,
        policy_kwargs={"net_arch": list(sac.network)},
        seed=of.seed,
        device="cpu",
    )


class StockVecEnv(VecEnv):
    """Our vector environment as stable-baselines3 takes it; no loop over environments.

    Both reset in the same step: what `step` returns for an environment whose episode ended is the
    first observation of the next one. The one that it ended with is
    ``infos[i]["terminal_observation"]``, and ``infos[i]["TimeLimit.truncated"]`` says that it did
    not terminate. Environments whose episode goes on share one empty info.
    """

    def __init__(self, env: ManipulationVectorEnv) -> None:
        self.env = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self._actions = np.zeros((env.num_envs, env.hand.nq))

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
                "episode": {
                    "r": float(info["episode_return"][i]),
                    "l": int(info["episode_length"][i]),
                },
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
