"""Guide: asks policy, critic and controllers, and says what each environment does next."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from dexctl.controller import Controller
from dexctl.exceptions import InvalidInput
from dexctl.state import Bools, Floats, GraspState
from dexctl.streams import Streams, StreamsState
from learning.exploration.config import GuidanceConfig, check_controllers
from learning.exploration.mixture import (
    POLICY,
    Segments,
    advance,
    fixed_probabilities,
    linear_decay,
    value_probabilities,
)

Values = Callable[[np.ndarray, np.ndarray], np.ndarray]


class GuidedEnv(Protocol):
    """What the controllers need of a vector environment."""

    @property
    def num_envs(self) -> int: ...

    @property
    def state(self) -> GraspState:
        """The true state, without noise."""
        ...

    def change_to_action(self, change: Floats) -> Floats:
        """The action that asks for a set-point change [rad], within the action space."""
        ...


class Guided(NamedTuple):
    """What to do in N environments.

    Attributes:
        action: ``(N, d)``, in the environment's action space.
        actor: ``(N,)``; 0 the policy, j the controller j - 1.
        guided: where ``label`` is a controller's action, ``(N,)`` bool.
        label: ``(N, d)``.
    """

    action: np.ndarray
    actor: np.ndarray
    guided: Bools
    label: np.ndarray


class Guide:
    """The behaviour of the thesis's algorithm qsampling, for N environments at once.

    Controllers see the true state, the learned policy its observation only. They are asked for
    all environments at every step, whoever acts, so that those with a memory follow what happens.
    A controller whose motion has a length of its own (see `commitment`) starts it anew at each
    choice, so that following it for H steps is one whole motion.

    Args:
        env: the environments.
        controllers: one or more; none for plain RL.
        config: the settings.
        seed: of the choices; environment i has the stream ``seed + i``, controllers too.
        where: which environments each controller guides, ``(controllers, N)`` bool; None: all.

    Attributes:
        lengths: H of each candidate, ``(1 + controllers,)`` [steps].
        alone: environments in which nobody but the policy acts before the hard stop, ``(N,)``.
        acted: steps that each candidate has acted, ``(1 + controllers,)``.
        chances: sums over choices of each candidate's probability, ``(1 + controllers,)``.
        choices: how many choices of who acts there were.
    """

    def __init__(
        self,
        env: GuidedEnv,
        controllers: Sequence[Controller],
        config: GuidanceConfig,
        seed: int = 0,
        where: ArrayLike | None = None,
    ) -> None:
        if config.method == "rl":
            controllers, where = (), None
        self.env, self.config = env, config
        self.controllers = tuple(controllers)
        shape = len(self.controllers), env.num_envs
        if where is None:
            check_controllers(config.method, [type(one).__name__ for one in self.controllers])
            where = np.ones(shape, bool)
        if np.shape(where) != shape:
            raise InvalidInput(f"where has shape {np.shape(where)}; expected {shape}")
        policy = np.ones((1, env.num_envs), bool)
        self._there = np.concatenate([policy, np.asarray(where, bool)]).T
        guides = self._there.copy()
        guides[:, POLICY] = False
        self._labels = guides.argmax(axis=1)  # the first that guides there; the policy: nobody
        own = [commitment(controller) for controller in self.controllers]
        self._restarts = [length is not None for length in own]
        lengths = [config.horizon or length or UNSTATED_HORIZON for length in own]
        self.lengths = np.array([max(lengths, default=1), *lengths], np.int64)
        self.alone = spread(config.alone if config.follows else 1.0, env.num_envs)
        self._streams = Streams(seed, (env.num_envs,))
        self.segments = Segments.start(env.num_envs)
        self.acted = np.zeros(len(self.lengths), np.int64)
        self.chances, self.choices = np.zeros(len(self.lengths)), 0
        for controller in self.controllers:
            controller.reset(seed)

    def asks(self, step: int) -> bool:
        """Whether the controllers are asked at environment step ``step``."""
        stop = self.config.hard_stop
        return bool(self.controllers) and (stop is None or step < stop)

    def own(self, step: int) -> Bools:
        """Where the policy acts by itself at environment step ``step``, ``(N,)``."""
        return self.alone if self.asks(step) else np.ones_like(self.alone)

    def beta(self, step: int) -> float:
        """Weight of behaviour cloning at environment step ``step``."""
        config = self.config
        if not config.imitates:
            return 0.0
        stop = config.hard_stop if config.beta_stop is None else config.beta_stop
        return config.beta_end + linear_decay(step, config.beta - config.beta_end, stop)

    def act(self, step: int, learner: np.ndarray, values: Values) -> Guided:
        """What each environment does.

        Args:
            step: environment steps so far.
            learner: the policy's actions ``(N, d)``.
            values: (rows ``(n,)``, candidates' actions ``(K, n, d)``) -> Q(s, a) ``(K, n)``.
        """
        nobody = np.zeros(len(learner), bool)
        if not self.asks(step):
            self.segments = Segments.start(len(learner))
            self.acted[POLICY] += len(learner)
            return Guided(learner, self.segments.actor, nobody, learner)
        due = self.segments.due
        proposed = np.stack([learner, *self._ask(due & self.config.follows)])
        labelled = proposed[self._labels, np.arange(len(learner))]
        if not self.config.follows:
            self.acted[POLICY] += len(learner)
            return Guided(learner, self.segments.actor, self._labels != POLICY, labelled)
        chances = self._probabilities(step, np.flatnonzero(due), proposed, values)
        self.chances += chances[due].sum(axis=0)
        self.choices += int(due.sum())
        self.segments = advance(
            self.segments,
            chances,
            self._streams.uniform(mask=due),
            self.lengths,
        )
        actor = self.segments.actor
        action = proposed[actor, np.arange(len(actor))]
        self.acted += np.bincount(actor, minlength=len(self.acted))
        if self.config.labels_all:
            return Guided(action, actor, self._labels != POLICY, labelled)
        return Guided(action, actor, actor != POLICY, action)

    def _ask(self, due: Bools) -> list[np.ndarray]:
        """The controllers' actions, ``(N, d)`` each."""
        state = self.env.state
        if due.any():
            for controller, restarts in zip(self.controllers, self._restarts, strict=True):
                if restarts:
                    controller.reset(mask=due)
        return [self.env.change_to_action(one.act(state)) for one in self.controllers]

    def _probabilities(
        self, step: int, rows: np.ndarray, proposed: np.ndarray, values: Values
    ) -> Floats:
        config, count = self.config, len(proposed)
        found = np.zeros((proposed.shape[1], count))
        if config.method == "fge":
            share = linear_decay(step, config.fixed_start, config.hard_stop)
            found[:] = fixed_probabilities(share, count, self._there)
        elif len(rows):
            of_rows = values(rows, proposed[:, rows])
            found[rows] = value_probabilities(of_rows.T, config.temperature, self._there[rows])
        found[self.alone] = np.eye(count)[POLICY]
        return found

    def take_counts(self) -> tuple[np.ndarray, Floats, int]:
        """`acted`, `chances` and `choices` since the last call; they begin anew."""
        found = self.acted, self.chances, self.choices
        self.acted, self.chances = np.zeros_like(self.acted), np.zeros_like(self.chances)
        self.choices = 0
        return found

    def after_step(self, done: Bools) -> None:
        """Tell which episodes have ended, ``(N,)``: their environments begin anew."""
        self.segments = self.segments.after_step(done)
        if done.any():
            for controller in self.controllers:
                controller.reset(mask=done)

    def state_dict(self) -> dict[str, Any]:
        """All that decides the future, as arrays and plain values.

        A controller that cannot give its state has None there: it begins anew.
        """
        return {
            "actor": self.segments.actor,
            "left": self.segments.left,
            "streams": self._streams.save()._asdict(),
            "acted": self.acted.copy(),
            "chances": self.chances.copy(),
            "choices": self.choices,
            "controllers": [_state_of(controller) for controller in self.controllers],
        }

    def load_state_dict(self, saved: dict[str, Any]) -> list[str]:
        """Continue from what `state_dict` gave.

        Returns:
            What people should know: which controllers begin anew.

        Raises:
            InvalidInput: it is of other controllers, or of another number of environments.
        """
        if len(saved["controllers"]) != len(self.controllers) or len(saved["actor"]) != len(
            self.segments.actor
        ):
            raise InvalidInput(
                f"the saved guide has {len(saved['controllers'])} controllers and "
                f"{len(saved['actor'])} environments; this one has {len(self.controllers)} and "
                f"{len(self.segments.actor)}"
            )
        self.segments = Segments(saved["actor"].copy(), saved["left"].copy())
        self._streams.restore(StreamsState(**saved["streams"]))
        self.acted, self.chances = saved["acted"].copy(), saved["chances"].copy()
        self.choices = int(saved["choices"])
        remarks = []
        for controller, state in zip(self.controllers, saved["controllers"], strict=True):
            if state is None:
                name = type(controller).__name__
                remarks.append(f"{name} does not give its state: it begins anew")
            else:
                controller.load_state_dict(state)
        return remarks


def spread(share: float, count: int) -> Bools:
    """``share`` of ``count`` places, evenly spread among them, ``(count,)`` bool."""
    edges = np.floor(share * np.arange(count + 1) + 1e-9)
    return np.diff(edges) > 0


UNSTATED_HORIZON = 40
"""Steps for controllers that state no length; a switch of the coordinated gait takes 28 to 34."""


def commitment(controller: Controller) -> int | None:
    """The length of a controller's own motion [steps], or None where it has none.

    The thesis's contact switching is a trajectory of H steps; so is the random gait's switch.
    """
    config = getattr(controller, "config", None)
    duration = getattr(config, "duration", None)
    if duration is None or getattr(config, "kind", "profile") != "profile":
        return None
    return max(1, round(duration / controller.control_period))


def _state_of(controller: Controller) -> dict[str, Any] | None:
    try:
        return controller.state_dict()
    except NotImplementedError:
        return None
