"""From our vector environments to stable-baselines3's, exact about where episodes end."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

_NOTHING: dict[str, Any] = {}


class StableBaselinesVecEnv(VecEnv):
    """A `FingerGaitingVectorEnv` as stable-baselines3 takes it; no loop over environments.

    Both reset in the same step: what `step` returns for an environment whose episode ended is
    the first observation of the next one. The observation that it ended with is
    ``infos[i]["terminal_observation"]``, ``infos[i]["TimeLimit.truncated"]`` says that it did not
    terminate, and ``infos[i]["episode"]`` has its return "r" and length "l", as with
    stable-baselines3's own monitor. Environments whose episode goes on share one empty info.

    Args:
        env: the vector environment, in its same-step autoreset mode.

    Attributes:
        env: as given.
        info: the environment's own info of the last step.
        ended: environments whose episode the last step ended.
    """

    def __init__(self, env: Any) -> None:
        self.env = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self.info: dict[str, Any] = {}
        self.ended = np.zeros(0, np.int64)
        self._actions = np.zeros((env.num_envs, *env.single_action_space.shape))

    def reset(self) -> np.ndarray:
        """The first observations ``(N, k)`` of new episodes; a seed given before is used once."""
        seeds = [seed for seed in self._seeds if seed is not None]
        obs, self.info = self.env.reset(seed=seeds[0] if seeds else None)
        self._reset_seeds()
        self.ended = np.zeros(0, np.int64)
        return np.asarray(obs, np.float32)

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        obs, reward, terminated, truncated, self.info = self.env.step(self._actions)
        done = terminated | truncated
        infos = [_NOTHING] * self.num_envs
        self.ended = np.flatnonzero(done)
        for i in self.ended:  # few, if any
            infos[i] = {
                "terminal_observation": np.asarray(self.info["final_obs"][i], np.float32),
                "TimeLimit.truncated": bool(truncated[i] and not terminated[i]),
                "episode": {
                    "r": float(self.info["episode_return"][i]),
                    "l": int(self.info["episode_length"][i]),
                },
            }
        return np.asarray(obs, np.float32), reward.astype(np.float32), done, infos

    def close(self) -> None:
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        value = getattr(self.env, attr_name)
        return [value for _ in self._chosen(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        if indices is not None:
            raise NotImplementedError("the environments of a batch share their attributes")
        setattr(self.env, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        if indices is not None:
            raise NotImplementedError("the environments of a batch are called together")
        return [getattr(self.env, method_name)(*method_args, **method_kwargs)]

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        return [False for _ in self._chosen(indices)]

    def _chosen(self, indices: Any) -> Iterable[int]:
        if indices is None:
            return range(self.num_envs)
        return [indices] if isinstance(indices, int) else indices
