"""The loop of an off-policy agent, with the simulation and the updates side by side."""

from __future__ import annotations

from concurrent.futures import Executor, Future, ThreadPoolExecutor
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm


class OverlappedLoop(OffPolicyAlgorithm):
    """`learn` of stable-baselines3, restated so that updates need not wait for the simulation.

    One turn of the loop chooses the actions of all environments, lets them take their step,
    remembers it, and updates:

    - not overlapped, as in stable-baselines3: choose, step, remember, update;
    - overlapped: choose, then step in a thread of its own *while* updating, then remember.

    So the updates that follow a step run beside the next one. They draw from the same memory, and
    there are as many of them; the one difference is that the policy which acts is older by the
    updates of one turn (2 by default, of tens of thousands). Nothing is shared between the two
    sides while they overlap, and a turn ends with both finished: runs repeat to the bit, and
    between two turns (the callback's ``on_rollout_start``) a checkpoint is the whole truth.

    Attributes:
        overlap: whether they do.
    """

    overlap: bool = False

    def learn(
        self,
        total_timesteps: int,
        callback: Any = None,
        log_interval: int | None = 4,
        tb_log_name: str = "run",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Any:
        """As `stable_baselines3`'s; each turn is one step of all environments."""
        if self.train_freq.frequency != 1 or self.gradient_steps < 0:  # type: ignore[union-attr]
            raise NotImplementedError("train_freq must be 1 step, and gradient_steps a number")
        total, calls = self._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        calls.on_training_start(locals(), globals())
        # the pool waits for a step that is under way, also where an update fails
        with ThreadPoolExecutor(1, "environments") as pool:
            going_on = True
            while going_on and self.num_timesteps < total:
                going_on = self._turn(pool, calls, log_interval)
        calls.on_training_end()
        return self

    def _turn(self, pool: Executor, callback: BaseCallback, log_interval: int | None) -> bool:
        """One step of all environments, and its updates; False where the callback says stop."""
        env = self.env
        assert env is not None
        assert self.replay_buffer is not None
        self.policy.set_training_mode(False)
        callback.on_rollout_start()
        actions, buffer_actions = self._sample_action(
            self.learning_starts, self.action_noise, env.num_envs
        )
        if self.overlap:
            pending: Future[Any] = pool.submit(env.step, actions)
            self._update()
            new_obs, rewards, dones, infos = pending.result()
        else:
            new_obs, rewards, dones, infos = env.step(actions)
        assert isinstance(new_obs, np.ndarray)
        self.num_timesteps += env.num_envs
        callback.update_locals(locals())
        if not callback.on_step():
            return False
        self._store_transition(self.replay_buffer, buffer_actions, new_obs, rewards, dones, infos)
        self._count_episodes(dones, infos, log_interval)
        callback.on_rollout_end()
        if not self.overlap:
            self._update()
        return True

    def _update(self) -> None:
        """The updates of a turn, once enough is remembered."""
        self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
        if self.gradient_steps and self.num_timesteps > max(self.learning_starts, 0):
            self.train(gradient_steps=self.gradient_steps, batch_size=self.batch_size)

    def _count_episodes(self, dones: Any, infos: Any, log_interval: int | None) -> None:
        ended = int(dones.sum())
        if not ended:
            return
        self._update_info_buffer(infos, dones)
        before, self._episode_num = self._episode_num, self._episode_num + ended
        if log_interval is not None and self._episode_num // log_interval > before // log_interval:
            self.dump_logs()
