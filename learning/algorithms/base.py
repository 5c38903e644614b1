"""What an algorithm is: it acts, observes what came of it, and updates its policy."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np

from dexctl.exceptions import InvalidInput, UnknownName

CLONINGS = ("likelihood", "squared")
CLONING_WEIGHTS = ("value", "equal", "better")
GROUPS = ("policy", "critic")
Layers = list[tuple[np.ndarray, np.ndarray]]


class Transitions(NamedTuple):
    """One step of N environments.

    Attributes:
        observation: what the actions were chosen by, ``(N, K)``.
        action: what was done, ``(N, d)``, in [-1, 1].
        reward: ``(N,)``.
        next_observation: ``(N, K)``; where the episode ended, the observation it ended with and
            not the first one of the next episode.
        terminated: where the episode ended and nothing can follow, ``(N,)`` bool.
        ended: where it terminated or was cut by its time limit, ``(N,)`` bool.
        guided: where ``guide_action`` is a controller's, ``(N,)`` bool; None: nowhere.
        guide_action: what a controller did, or would have done, ``(N, d)``; None: as ``action``.
    """

    observation: np.ndarray
    action: np.ndarray
    reward: np.ndarray
    next_observation: np.ndarray
    terminated: np.ndarray
    ended: np.ndarray
    guided: np.ndarray | None = None
    guide_action: np.ndarray | None = None

    def check(self) -> None:
        """Raise InvalidInput where a number is not finite."""
        rows = (self.observation, self.action, self.reward[:, None], self.next_observation)
        if self.guide_action is not None:
            rows = (*rows, self.guide_action)
        if not all(np.isfinite(numbers.sum()) for numbers in rows):
            bad = ~np.all([np.isfinite(numbers).all(axis=1) for numbers in rows], axis=0)
            if bad.any():
                raise InvalidInput(
                    f"a transition of environments {np.flatnonzero(bad)[:8].tolist()} is not "
                    "finite: NaN or infinity in observation, action or reward"
                )


@dataclass(frozen=True, kw_only=True)
class Cloning:
    """How a policy imitates the controllers' actions."""

    kind: str = "likelihood"
    """Of the loss: "likelihood", or "squared" (distance to the mean action)."""
    weight: str = "value"
    """Of each action: "value", "equal" or "better"; see `learning.algorithms.losses`."""

    def __post_init__(self) -> None:
        for name, value, known in (
            ("cloning", self.kind, CLONINGS), ("cloning weight", self.weight, CLONING_WEIGHTS),
        ):  # fmt: skip
            if value not in known:
                raise UnknownName(name, value, known)


class Turns(Protocol):
    """Symmetries of what is learned: observations and actions that are worth the same."""

    @property
    def elements(self) -> Sequence[Any]:
        """The symmetries, the identity first."""
        ...

    def observation(self, which: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Observations ``(B, K)``, each turned by the element ``which`` ``(B,)``."""
        ...

    def action(self, which: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Actions ``(B, d)``, turned likewise."""
        ...


class Algorithm(ABC):
    """One step of training is `act`, the environments' step, `observe`, `update`.

    An algorithm owns its random generators: two of one seed that are shown the same do the same,
    and `state_dict` holds all that decides what they do next.

    Attributes:
        name: of the algorithm, as a configuration has it.
        overlaps: whether `update` may run while the environments step.
        activation: between the layers of the policy; behind the last one is tanh.
        steps: environment steps observed so far, of all environments together.
        updates: how many there were.
        statistics: means over the last call of `update` that did something, by name.
        begun: whether it has the networks of another run from the first step on.
    """

    name: ClassVar[str]
    overlaps: ClassVar[bool]
    activation: ClassVar[str] = "relu"
    _of_the_run: ClassVar[tuple[str, ...]] = ("random",)
    """What of `state_dict` belongs to the steps of a run, not to what it has learned."""

    def __init__(self) -> None:
        self.steps = 0
        self.updates = 0
        self.statistics: dict[str, float] = {}
        self.begun = False

    @abstractmethod
    def act(self, observation: np.ndarray) -> np.ndarray:
        """Exploring actions ``(N, d)`` float32 in [-1, 1] for observations ``(N, K)``."""

    @abstractmethod
    def observe(self, transitions: Transitions) -> None:
        """Remember a step of all environments.

        Raises:
            InvalidInput: a number is not finite; nothing was remembered.
        """

    @abstractmethod
    def update(self, *, beta: float = 0.0, left: float = 1.0) -> None:
        """Do the updates that are due after one step of all environments, if any.

        Args:
            beta: weight of behaviour cloning now.
            left: share of the training that is left, for schedules of the learning rate.
        """

    def imitate(
        self,
        observation: np.ndarray,
        action: np.ndarray,
        *,
        epochs: int,
        batch_size: int,
        seed: int,
    ) -> None:
        """Begin the policy with what was done elsewhere, before the first step.

        Args:
            observation: ``(E, K)``.
            action: what was done there, ``(E, d)``, in [-1, 1].
            epochs, batch_size: passes over all of them, and how many make an update.
            seed: of their order.

        Raises:
            NotImplementedError: the algorithm imitates while it learns, or not at all.
        """
        raise NotImplementedError(f"{type(self).__name__} does not begin by imitating")

    def values(self, observation: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """What candidates' actions ``(C, n, d)`` are worth in observations ``(n, K)``, ``(C, n)``.

        Raises:
            NotImplementedError: the algorithm has no critic of actions.
        """
        raise NotImplementedError(f"{type(self).__name__} does not value actions")

    @abstractmethod
    def policy_layers(self) -> Layers:
        """The deterministic policy as (weight, bias) pairs, for the columns of group "policy"."""

    def state_dict(self) -> dict[str, Any]:
        """All that decides the future, as tensors, arrays and plain values.

        Tensors and arrays are views of what goes on changing: write them, or copy them, at once.
        """
        return {
            "algorithm": self.name,
            "steps": self.steps,
            "updates": self.updates,
            "statistics": dict(self.statistics),
            **self._state(),
        }

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Continue from what `state_dict` gave.

        Raises:
            InvalidInput: it is of another algorithm or another shape.
        """
        if saved["algorithm"] != self.name:
            raise InvalidInput(f"the saved algorithm is {saved['algorithm']}; expected {self.name}")
        self._load_state(saved)
        self.steps, self.updates = int(saved["steps"]), int(saved["updates"])
        self.statistics = dict(saved["statistics"])

    def begin_as(self, saved: Mapping[str, Any]) -> None:
        """Begin with what another run has learned, and none of its steps.

        Args:
            saved: what `state_dict` gave there.

        Raises:
            InvalidInput: it is of another algorithm or another shape.
        """
        own = self._state()
        kept = {name: own[name] for name in self._of_the_run}
        self.load_state_dict({**saved, **kept, "steps": 0, "updates": 0, "statistics": {}})

    @abstractmethod
    def begin_with(self, policy: Layers) -> None:
        """Begin with a policy alone; what it is worth has to be learned first.

        Args:
            policy: as `policy_layers` gave them.

        Raises:
            InvalidInput: it is of another shape, or the settings leave no time to learn its worth.
        """

    @abstractmethod
    def _state(self) -> dict[str, Any]:
        """What the algorithm has of its own in `state_dict`."""

    @abstractmethod
    def _load_state(self, saved: Mapping[str, Any]) -> None:
        """Continue from what `_state` gave."""

    @property
    @abstractmethod
    def diverged(self) -> bool:
        """Whether a weight is not finite: no update will mend it."""


def columns(
    groups: Mapping[str, slice], observation_size: int, num_envs: int, action_size: int
) -> tuple[slice, slice]:
    """The columns of the groups "policy" and "critic", checked with the other sizes.

    Raises:
        InvalidInput: a group is missing, empty or outside the observation, or a size is below 1.
    """
    sizes = {
        "observation_size": observation_size, "num_envs": num_envs, "action_size": action_size,
    }  # fmt: skip
    for name, size in sizes.items():
        whole(name, size)
    for name in GROUPS:
        found = groups.get(name)
        if found is None:
            raise InvalidInput(
                f"the observation has the groups {', '.join(groups) or 'none'}; expected "
                f"{' and '.join(GROUPS)}"
            )
        start, stop = found.start or 0, observation_size if found.stop is None else found.stop
        if found.step not in (None, 1) or not 0 <= start < stop <= observation_size:
            raise InvalidInput(
                f"group {name!r} is columns {start} to {stop}; expected some of the "
                f"{observation_size} of the observation"
            )
    return groups["policy"], groups["critic"]


def whole(name: str, value: object, least: int = 1) -> None:
    """Raise InvalidInput where ``value`` is not a whole number from ``least`` on."""
    if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < least:
        raise InvalidInput(f"{name} is {value!r}; expected a whole number from {least} on")
