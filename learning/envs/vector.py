"""ManipulationVectorEnv: N hands, each with an object and a task."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from dexctl.exceptions import UnknownName
from dexctl.settings import from_plain
from dexctl.sim import GraspStates, checks
from dexctl.sim.simulation import Simulation
from dexctl.state import Bools, Floats, GraspState
from learning.envs.action import SetPointAction, check_action
from learning.envs.config import EnvConfig
from learning.envs.history import History
from learning.envs.observation import Observation
from learning.envs.rendering import RENDER_MODES, Renderer
from learning.envs.task import Step
from learning.envs.truth import truth_parts

_LOG = logging.getLogger(__name__)


class ManipulationVectorEnv(gymnasium.vector.VectorEnv):
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
        simulation, task: what is simulated, and what for.
        observation, action: how the policy's observations and set-points are made.
        history: the policy's observations of the last control steps.
        observations: what an observation is made of: the policy's, the same for each step of its
            history, and where there is any, what only critics see.
        groups: the columns of an observation that the "policy" and the "critic" see.
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
        config = self.config = config if config is not None else EnvConfig()
        self.render_mode = render_mode
        first = int(np.random.SeedSequence().generate_state(1)[0]) if seed is None else seed
        self.simulation = Simulation(config.scene, num_envs, first)
        self.hand, self.objects = self.simulation.hand, self.simulation.objects
        self.num_envs = self.simulation.num_envs
        self.task = config.task.build(self.simulation)
        period = self.simulation.control_period
        self.action = SetPointAction(
            self.hand,
            max_speed=config.max_speed,
            max_lead=config.max_lead,
            control_period=period,
        )
        self._observe_with()
        self._autoreset = bool(autoreset)
        self.metadata = {
            **self.metadata,
            "render_fps": round(1.0 / period),
            "autoreset_mode": AutoresetMode.SAME_STEP if autoreset else AutoresetMode.DISABLED,
        }
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (self.hand.nq,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._renderer: Renderer | None = None
        self.diverged_count = 0
        self._length = np.zeros(self.num_envs, np.int64)
        self._returns = np.zeros(self.num_envs)
        self._begun(np.ones(self.num_envs, bool))

    def _observe_with(self) -> None:
        config = self.config
        options = {
            "scaled": config.scaled,
            "centre": self.simulation.sim.groups[0].scene.grasp_centre,
            "more": truth_parts(self.simulation),
        }
        self.observation = Observation(self.hand, config.parts, **options)
        self.history = History(self.observation.size, config.history)
        seen = [self.observation] * (1 + len(config.history))
        self._critics = None
        if config.critic_parts:
            self._critics = Observation(self.hand, config.critic_parts, **options)
            seen.append(self._critics)
        self.observations = tuple(seen)
        size = sum(one.size for one in seen)
        self.groups = {"policy": slice(0, self.history.size), "critic": slice(0, size)}
        self.single_observation_space = gymnasium.spaces.Box(
            np.concatenate([one.low for one in seen]),
            np.concatenate([one.high for one in seen]),
            dtype=np.float32,
        )

    @property
    def state(self) -> GraspState:
        """The true state ``(N,)``, as controllers see it in training, with what is wanted."""
        return self.task.with_goal(self.simulation.state)

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
        chosen = checks.mask(mask, (self.num_envs,))
        self.simulation.reset(seed, chosen)
        self._begun(chosen)
        return self._observe(chosen), {}

    def step(
        self, actions: ArrayLike
    ) -> tuple[NDArray[np.float32], Floats, Bools, Bools, dict[str, Any]]:
        """One control step of every environment.

        Args:
            actions: ``(N, d)``, in [-1, 1]; what is beyond is cut off.

        Returns:
            Observations ``(N, k)``, rewards ``(N,)``, terminated and truncated ``(N,)`` bool, and
            info: arrays ``(N,)`` of the step and of the episode up to and with it, ``done``,
            ``final_obs``.

        Raises:
            InvalidInput: wrong shape, or numbers that are not finite.
        """
        wanted = self.action.to_change(check_action(actions, (self.num_envs, self.hand.nq)))
        simulation, before = self.simulation, self.simulation.state
        broken = simulation.diverged  # none, unless those that are done are left as they are
        # set-points are sent as the encoders have them, which may be off
        simulation.write(simulation.read().q_target + self.action.limited(before, wanted))
        simulation.step()
        diverged = simulation.diverged
        self._count_diverged(diverged & ~broken)
        found = self.task.judge(Step.of(simulation))
        self._length += 1
        self._returns += found.reward
        terminated = found.dropped | found.succeeded | diverged
        truncated = (self._length >= self.config.episode_steps) & ~terminated
        done = terminated | truncated
        observations = self._observe()
        info = {
            **found.info,
            "dropped": found.dropped,
            "succeeded": found.succeeded,
            "diverged": diverged,
            "episode_return": self._returns.copy(),
            "episode_length": self._length.copy(),
            "done": done,
            "final_obs": observations,
            "_final_obs": done,
        }
        if self._autoreset and done.any():
            simulation.reset(None, done)
            self._begun(done)
            observations = np.where(done[:, None], self._observe(done), observations)
        if self.render_mode == "human":
            self.render()
        return observations, found.reward, terminated, truncated, info

    def _count_diverged(self, new: Bools) -> None:
        if new.any():
            self.diverged_count += int(new.sum())
            _LOG.warning(
                "simulation broken down in environments %s; their episodes end (%d so far)",
                np.flatnonzero(new)[:8].tolist(),
                self.diverged_count,
            )

    def _begun(self, chosen: Bools) -> None:
        self.task.begin(chosen, self.simulation.state)
        self._length[chosen] = 0
        self._returns[chosen] = 0.0

    def place(self, states: GraspStates, index: ArrayLike) -> NDArray[np.float32]:
        """Begin new episodes in given grasps, at rest and undisturbed.

        Args:
            states: see `Simulation.place`.
            index: which of them each environment gets, ``(N,)``.

        Returns:
            Observations ``(N, k)``.
        """
        self.simulation.place(states, index)
        chosen = np.ones(self.num_envs, bool)
        self._begun(chosen)
        return self._observe(chosen)

    def _observe(self, begun: Bools | None = None) -> NDArray[np.float32]:
        """What the policy's sensors tell and told and, for critics, how things are.

        Args:
            begun: where an episode begins, ``(N,)``; None: a control step has been made.
        """
        seen = self.observation(self.task.with_goal(self.simulation.read()))
        if begun is None:
            self.history.add(seen)
        else:
            self.history.begin(seen, begun)
        seen = self.history.look()
        if self._critics is None:
            return seen
        return np.concatenate([seen, self._critics(self.state)], axis=-1)

    def save(self) -> dict[str, Any]:
        """All that decides the future, as arrays and plain values, to be given to `restore`."""
        return {
            "simulation": self.simulation.save(),
            "task": self.task.save(),
            "length": self._length.copy(),
            "returns": self._returns.copy(),
            "history": self.history.save(),
            "diverged_count": self.diverged_count,
        }

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Continue from a saved state: the same actions give the same bits.

        Raises:
            SimulationError: it was saved by environments of another number or kind.
        """
        self.simulation.restore(saved["simulation"])
        self.task.restore(saved["task"])
        self._length, self._returns = saved["length"].copy(), saved["returns"].copy()
        self.history.restore(saved["history"])
        self.diverged_count = saved["diverged_count"]

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Pictures of the first environment of each object ("rgb_array"), or the window."""
        if self.render_mode is None:
            return None
        if self._renderer is None:
            self._renderer = Renderer(self.simulation.sim, self.render_mode)
        return self._renderer.draw()

    def close_extras(self, **kwargs: Any) -> None:
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
        self.simulation.close()


def make_vector(
    config: EnvConfig | None = None, num_envs: int = 1, seed: int | None = None
) -> ManipulationVectorEnv:
    """N environments of one configuration; see `ManipulationVectorEnv`."""
    return ManipulationVectorEnv(config, num_envs, seed)


def make_from_options(
    num_envs: int = 1, *, render_mode: str | None = None, seed: int | None = None, **options: Any
) -> ManipulationVectorEnv:
    """What ``gymnasium.make_vec`` calls; ``options`` are settings of `EnvConfig` by name."""
    config = from_plain(EnvConfig, options)
    return ManipulationVectorEnv(config, num_envs, seed, render_mode=render_mode)
