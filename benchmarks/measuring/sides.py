"""Two sides that train the same: our algorithms and stable-baselines3's, in turns of some steps."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.wrappers import RescaleAction
from stable_baselines3.common.base_class import BaseAlgorithm

from learning.algorithms import Algorithm, Transitions, make
from learning.algorithms.config import PPOConfig, SACConfig, TD3Config
from learning.config import TrainConfig
from learning.envs.vector import make_vector
from learning.policies.policy import ACTIVATIONS
from learning.training.run_folder import RunFolder
from learning.training.trainer import Trainer
from measuring.stock import stock_ppo, stock_sac

Own = SACConfig | TD3Config | PPOConfig


def gymnasium_vector(name: str, num_envs: int, seed: int) -> VectorEnv:
    """A task of gymnasium, with actions in [-1, 1] and a reset in the step that ends an episode."""
    env = gymnasium.make_vec(
        name,
        num_envs,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP},
        wrappers=[lambda one: RescaleAction(one, np.float32(-1), np.float32(1))],
    )
    env.reset(seed=seed)  # what follows goes on with these streams
    return env


class Side(ABC):
    """One side.

    Attributes:
        wall, processor: seconds of training so far, by the clock and of all threads.
        steps: of all environments together.
    """

    def __init__(self, num_envs: int) -> None:
        self.num_envs = num_envs
        self.wall = self.processor = 0.0
        self.steps = 0

    def advance(self, steps: int) -> None:
        """Train for ``steps`` steps of each environment."""
        processor, wall = time.process_time(), time.perf_counter()
        self._train(steps)
        self.wall += time.perf_counter() - wall
        self.processor += time.process_time() - processor
        self.steps += steps * self.num_envs

    @abstractmethod
    def _train(self, steps: int) -> None: ...

    @abstractmethod
    def decide(self, observation: np.ndarray) -> np.ndarray:
        """Actions of the deterministic policy ``(N, d)``."""

    @abstractmethod
    def close(self) -> None:
        """Close the environments."""


class Ours(Side):
    """Our algorithms; subclasses have the loop."""

    algorithm: Algorithm

    def decide(self, observation: np.ndarray) -> np.ndarray:
        *hidden, (weight, bias) = self.algorithm.policy_layers()
        found = observation[:, : (hidden[0][0] if hidden else weight).shape[1]]
        for one, shift in hidden:
            found = ACTIVATIONS[self.algorithm.activation](found @ one.T + shift)
        return np.tanh(found @ weight.T + bias)


class OursInLoop(Ours):
    """The plain loop over any vector environment of gymnasium's."""

    def __init__(self, of: Own, env: VectorEnv, seed: int) -> None:
        super().__init__(env.num_envs)
        self.env = env
        size, actions = (
            int(np.prod(space.shape or ()))
            for space in (env.single_observation_space, env.single_action_space)
        )
        everything = slice(0, size)
        self.algorithm = make(
            of,
            groups={"policy": everything, "critic": everything},
            observation_size=size,
            action_size=actions,
            num_envs=env.num_envs,
            seed=seed,
        )
        self._seen = env.reset()[0]

    def _train(self, steps: int) -> None:
        for _ in range(steps):
            action = self.algorithm.act(self._seen)
            following, reward, terminated, truncated, info = self.env.step(action)
            ended, last = terminated | truncated, following.copy()
            if ended.any():
                last[ended] = np.stack(list(info["final_obs"][ended]))
            self.algorithm.observe(Transitions(self._seen, action, reward, last, terminated, ended))
            self.algorithm.update()
            self._seen = following

    def close(self) -> None:
        self.env.close()


class OursInTrainer(Ours):
    """The trainer's turns, without a log."""

    def __init__(self, of: TrainConfig) -> None:
        super().__init__(of.num_envs)
        self.trainer = Trainer(of, RunFolder(Path("nowhere")))  # nothing is written between turns
        self.algorithm = self.trainer.algorithm
        self._pool = ThreadPoolExecutor(1)

    def _train(self, steps: int) -> None:
        for _ in range(steps):
            self.trainer.turn(self._pool)

    def close(self) -> None:
        self._pool.shutdown()
        self.trainer.close()


class Stock(Side):
    """stable-baselines3's algorithms with the settings of ours."""

    def __init__(self, of: Own, env: VectorEnv, seed: int) -> None:
        super().__init__(env.num_envs)
        assert not isinstance(of, TD3Config)
        self.agent: BaseAlgorithm
        if isinstance(of, PPOConfig):
            self.agent = stock_ppo(of, env, seed)
        else:
            self.agent = stock_sac(of, env, seed)

    def _train(self, steps: int) -> None:
        self.agent.learn(steps * self.num_envs, reset_num_timesteps=self.steps == 0)

    def decide(self, observation: np.ndarray) -> np.ndarray:
        normalise = self.agent.get_vec_normalize_env()
        if normalise is not None:
            observation = np.asarray(normalise.normalize_obs(observation))
        return self.agent.predict(observation, deterministic=True)[0]

    def close(self) -> None:
        assert self.agent.env is not None
        self.agent.env.close()


def returns(side: Side, env: VectorEnv) -> np.ndarray:
    """Return of the deterministic policy in the first episode of each environment, ``(N,)``."""
    seen, _ = env.reset()
    found, going_on = np.zeros(env.num_envs), np.ones(env.num_envs, bool)
    while going_on.any():
        seen, reward, terminated, truncated, _ = env.step(side.decide(seen))
        found += np.where(going_on, reward, 0.0)
        going_on &= ~(terminated | truncated)
    env.close()
    return found


def build(of: TrainConfig, task: str) -> dict[str, Side]:
    """Both sides by name; ``task`` is one of gymnasium's, or "hand": of's own environments."""
    own = of.learner
    assert isinstance(own, Own)
    if task == "hand":
        env = make_vector(of.env, of.num_envs, of.seed)
        return {"ours": OursInTrainer(of), "stock": Stock(own, env, of.seed)}
    envs = [gymnasium_vector(task, of.num_envs, of.seed) for _ in range(2)]
    return {
        "ours": OursInLoop(own, envs[0], of.seed),
        "stock": Stock(own, envs[1], of.seed),
    }
