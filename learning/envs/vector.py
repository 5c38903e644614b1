"""FingerGaitingVectorEnv: N hands that are rewarded for turning their objects."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.hand import HandModel
from dexctl.state import Bools, Floats, GraspState
from dexctl.streams import Streams, StreamsState
from learning.envs import reward as rewards
from learning.envs.action import SetPointAction, check_action
from learning.envs.batches import merged, random_seed, spread_seeds
from learning.envs.config import EnvConfig
from learning.envs.episode import Episodes
from learning.envs.initial_states import InitialStates, StateSampler
from learning.envs.latency import Delay
from learning.envs.noise import observed
from learning.envs.observation import Observation
from learning.envs.pushes import Pusher
from learning.envs.rendering import RENDER_MODES, Renderer
from learning.envs.simulation import build_simulator, check_count

_LOG = logging.getLogger(__name__)

# The streams of one environment must not repeat each other; the simulator's takes the seed itself.
_NOISE_SEED, _DRAW_SEED, _PUSH_SEED = 1 << 40, 1 << 41, 1 << 43


@dataclass(frozen=True, eq=False)
class EnvState:
    """Everything that decides the future of a `FingerGaitingVectorEnv`; it can be pickled."""

    simulator: Any
    state: GraspState
    noise: StreamsState
    draws: StreamsState
    pushes: StreamsState
    force: Floats
    episodes: dict[str, np.ndarray]
    diverged_count: int
    sensed: tuple[GraspState, ...] = ()


class FingerGaitingVectorEnv(gymnasium.vector.VectorEnv):
    """N environments stepped together, with no Python loop over them.

    Environment i of a batch seeded with s has the numbers of a single one seeded with s + i.
    Spaces, reward, termination and options are described in docs/learning.md.

    Autoreset is in the same step: where ``info["done"]``, the observation returned is the first of
    the next episode, and the last of the episode that ended is the row of ``info["final_obs"]``
    ``(N, k)`` (whose other rows are the observations returned). So no step is wasted, and a learner
    bootstraps from the true last observation.

    Args:
        config: what the environments are.
        num_envs: N.
        seed: of the random streams; None draws one.
        autoreset: False leaves environments that are done as they are until `reset`.
        render_mode: None, "rgb_array" or "human".

    Attributes:
        config, hand: as given.
        observation, action: how observations and set-points are made.
        objects: name of the object in each environment.
        diverged_count: simulations that broke down so far. Their episodes end (terminated) with
            their last finite state and a reward of 0.

    Raises:
        UnknownName, InvalidInput: a setting is wrong.
        SimulationError: the hand does not hold the object.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (as gymnasium declares it)
        "render_modes": list(RENDER_MODES),
        "render_fps": 20,
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }

    def __init__(
        self,
        config: EnvConfig | None = None,
        num_envs: int = 1,
        seed: int | None = None,
        *,
        autoreset: bool = True,
        render_mode: str | None = None,
    ) -> None:
        if render_mode not in (None, *RENDER_MODES):
            raise UnknownName("render_mode", render_mode, ["None", *RENDER_MODES])
        self.config = config if config is not None else EnvConfig()
        self.num_envs = check_count(self.config, num_envs)
        self.render_mode = render_mode
        first = random_seed() if seed is None else int(spread_seeds(seed, 1)[0])
        self.sim = build_simulator(self.config, num_envs, first)
        self.hand: HandModel = self.sim.hand
        self.objects = self.sim.objects
        self.action = SetPointAction(
            self.hand,
            max_speed=self.config.max_speed,
            max_lead=self.config.max_lead,
            control_period=self.config.control_period,
        )
        centre = self.sim.groups[0].scene.grasp_centre
        self.observation = Observation(
            self.hand, self.config.parts, scaled=self.config.scaled, centre=centre
        )
        self._autoreset = bool(autoreset)
        self.metadata = {
            **self.metadata,
            "render_fps": round(1.0 / self.config.control_period),
            "autoreset_mode": AutoresetMode.SAME_STEP if autoreset else AutoresetMode.DISABLED,
        }
        self.single_observation_space = gymnasium.spaces.Box(
            self.observation.low, self.observation.high, dtype=np.float32
        )
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (self.hand.nq,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._axis = np.array(self.config.direction)
        self._upright = np.concatenate(
            [
                np.tile(group.scene.settled.qpos[group.scene.object_qpos][3:], (len(rows), 1))
                for group, rows in self._groups()
            ]
        )
        self._sampler = self._make_sampler()
        self._sensor_noise = self.config.noise
        self._noise = Streams(first + _NOISE_SEED, (num_envs,))
        self._draws = Streams(first + _DRAW_SEED, (num_envs,))
        self._pusher = Pusher(
            self.config.push, Streams(first + _PUSH_SEED, (num_envs,)), self.config.control_period
        )
        self._delay = Delay(self.config.latency_steps)
        self._renderer: Renderer | None = None
        self.diverged_count = 0
        self._state = self.sim.read()
        self._episodes = Episodes(num_envs, self._axis)
        self._begin(np.ones(num_envs, bool), None)

    @property
    def state(self) -> GraspState:
        """The true state ``(N,)``, as controllers see it in training."""
        return self._state

    def action_to_change(self, actions: ArrayLike) -> Floats:
        """Set-point changes [rad] that actions ``(..., d)`` ask for."""
        return self.action.to_change(actions)

    def change_to_action(self, change: ArrayLike) -> Floats:
        """The actions in [-1, 1] that ask for set-point changes ``(..., d)`` [rad]."""
        return self.action.from_change(change)

    def reset(
        self,
        *,
        seed: ArrayLike | None = None,
        mask: ArrayLike | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin new episodes.

        Args:
            seed: environment i gets ``seed + i``, or ``seed[i]``; None: the streams go on.
            mask: which environments, ``(N,)`` bool; None is all. Also as
                ``options={"reset_mask": mask}``, gymnasium's way.
            options: see ``mask``.

        Returns:
            Observations ``(N, k)`` of all environments, and info.
        """
        if mask is None and options:
            mask = options.get("reset_mask")
        chosen = np.ones(self.num_envs, bool) if mask is None else np.asarray(mask)
        if chosen.dtype != bool or chosen.shape != (self.num_envs,):
            raise InvalidInput(
                f"mask has shape {chosen.shape} and type {chosen.dtype}; expected "
                f"({self.num_envs},) of bool"
            )
        self._begin(chosen, seed)
        return self._observe(chosen), {}

    def step(
        self, actions: ArrayLike
    ) -> tuple[NDArray[np.float32], Floats, Bools, Bools, dict[str, Any]]:
        """One control step of every environment.

        Args:
            actions: ``(N, d)``, in [-1, 1]; what is beyond is cut off.

        Returns:
            Observations ``(N, k)``, rewards ``(N,)`` [rad/s], terminated and truncated ``(N,)``
            bool, and info: arrays ``(N,)`` of the step and of the episode up to and with it,
            ``done``, ``final_obs``.

        Raises:
            InvalidInput: wrong shape, or numbers that are not finite.
        """
        wanted = self.action.to_change(
            check_action(actions, (self.num_envs, self.hand.nq)),
        )
        before = self._state
        broken = self.sim.diverged  # none, unless those that are done are left as they are
        self.sim.write(before.q_target + self.action.limited(before, wanted))
        if self.config.push_force > 0:
            self.sim.push(self._pusher(self._episodes.length))
        self.sim.step()
        diverged = self.sim.diverged
        self._count_diverged(diverged & ~broken)
        after = self.sim.read()
        if diverged.any():  # the last finite state, its touch included
            after = merged(diverged, before, after)
        self._state = after
        result, info = self._judge(diverged)
        terminated = info["dropped"] | diverged
        truncated = (self._episodes.length >= self.config.episode_steps) & ~terminated
        done = terminated | truncated
        observations = self._observe(None)
        info |= {"done": done, "final_obs": observations, "_final_obs": done}
        if self._autoreset and done.any():
            self._begin(done, None)
            observations = np.where(done[:, None], self._observe(done), observations)
        if self.render_mode == "human":
            self.render()
        return observations, result, terminated, truncated, info

    def _count_diverged(self, new: Bools) -> None:
        if new.any():
            self.diverged_count += int(new.sum())
            _LOG.warning(
                "simulation broken down in environments %s; their episodes end (%d so far)",
                np.flatnonzero(new)[:8].tolist(),
                self.diverged_count,
            )

    def _judge(self, diverged: Bools) -> tuple[Floats, dict[str, Any]]:
        """Rewards, and what the step and the episode came to."""
        config, state, episodes = self.config, self._state, self._episodes
        position, quaternion = state.object_position, state.object_quaternion
        assert position is not None
        assert quaternion is not None
        turning = rewards.Turning(
            speed=np.where(diverged, 0.0, self.sim.object_angular_velocity @ self._axis),
            tilt=rewards.tilt(quaternion, self._upright, self._axis),
            fingertips=state.in_contact.sum(axis=-1),
            fingertips_only=self.sim.other_contact == 0.0,
        )
        result = rewards.reward(turning, config.max_reward, config.max_tilt, config.min_fingertips)
        away = np.linalg.norm(position - self.sim.start_position, axis=-1)
        episodes.add(result, quaternion)
        return result, {
            "dropped": (away > config.drop_distance) & ~diverged,
            "diverged": diverged,
            "speed": turning.speed,
            "tilt": turning.tilt,
            "fingertips": turning.fingertips,
            "fingertips_only": turning.fingertips_only,
            "rotation": episodes.rotation.copy(),
            "episode_return": episodes.returns.copy(),
            "episode_length": episodes.length.copy(),
        }

    def _begin(self, chosen: Bools, seed: ArrayLike | None) -> None:
        """New episodes in the environments chosen."""
        if seed is not None:
            seeds = spread_seeds(seed, self.num_envs)
            self._noise.reseed(seeds + _NOISE_SEED, chosen)
            self._draws.reseed(seeds + _DRAW_SEED, chosen)
            self._pusher.streams.reseed(seeds + _PUSH_SEED, chosen)
            self.sim.reset(seeds, chosen)
        else:
            self.sim.reset(None, chosen)
        if self._sampler is not None:
            self._place(self._sampler, chosen)
        fresh = self.sim.read()
        self._state = merged(chosen, fresh, self._state)
        assert fresh.object_quaternion is not None
        self._episodes.begin(chosen, fresh.object_quaternion)

    def _place(self, sampler: StateSampler, chosen: Bools) -> None:
        """Put the environments chosen into states of the file."""
        index = sampler(self._draws.uniform((), chosen))
        noise = self._draws.normal((self.hand.nq,), chosen)
        states = sampler.states
        self.sim.set_grasp(
            states.q[index],
            states.q_target[index] + self.config.disturbance * noise,
            states.object_position[index],
            states.object_quaternion[index],
            mask=chosen,
        )

    def _observe(self, mask: Bools | None) -> NDArray[np.float32]:
        sensed = observed(self._state, self._sensor_noise, self._noise, mask)
        return self.observation(self._delay(sensed, mask))

    def save(self) -> EnvState:
        """All that decides the future, to be given to :meth:`restore`."""
        return EnvState(
            simulator=self.sim.save(),
            state=self._state,
            noise=self._noise.save(),
            draws=self._draws.save(),
            pushes=self._pusher.streams.save(),
            force=self._pusher.force.copy(),
            episodes=self._episodes.save(),
            diverged_count=self.diverged_count,
            sensed=self._delay.save(),
        )

    def restore(self, saved: EnvState) -> None:
        """Continue from a saved state: the same actions give the same bits.

        Raises:
            SimulationError: it was saved by environments of another number or kind.
        """
        self.sim.restore(saved.simulator)
        self._state = saved.state
        self._noise.restore(saved.noise)
        self._draws.restore(saved.draws)
        self._pusher.streams.restore(saved.pushes)
        self._pusher.force = saved.force.copy()
        self._episodes.restore(saved.episodes)
        self.diverged_count = saved.diverged_count
        self._delay.restore(saved.sensed)

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Pictures of the first environment of each object ("rgb_array"), or the window."""
        if self.render_mode is None:
            return None
        if self._renderer is None:
            self._renderer = Renderer(self.sim, self.render_mode)
        return self._renderer.draw()

    def close_extras(self, **kwargs: Any) -> None:
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
        self.sim.close()

    def _groups(self) -> list[tuple[Any, range]]:
        return [
            (group, range(rows.start, rows.stop))
            for group, rows in zip(self.sim.groups, self.sim.slices, strict=True)
        ]

    def _make_sampler(self) -> StateSampler | None:
        path = self.config.initial_states
        if path is None:
            return None
        return StateSampler(InitialStates.load(path), self.hand, self.objects)


def make_vector(
    config: EnvConfig | None = None, num_envs: int = 1, seed: int | None = None
) -> FingerGaitingVectorEnv:
    """N environments of one configuration; see `FingerGaitingVectorEnv`."""
    return FingerGaitingVectorEnv(config, num_envs, seed)


def make_from_options(
    num_envs: int = 1, *, render_mode: str | None = None, seed: int | None = None, **options: Any
) -> FingerGaitingVectorEnv:
    """What ``gymnasium.make_vec`` calls; ``options`` are the fields of `EnvConfig`."""
    return FingerGaitingVectorEnv(config_from(options), num_envs, seed, render_mode=render_mode)


def config_from(options: Mapping[str, Any]) -> EnvConfig:
    """The configuration that ``options`` name.

    Raises:
        UnknownName: no such option.
    """
    known = [field.name for field in fields(EnvConfig)]
    for name in options:
        if name not in known:
            raise UnknownName("option", name, known)
    return EnvConfig(**options)
