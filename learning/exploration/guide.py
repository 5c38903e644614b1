"""Guide: asks policy, critic and controllers, and says what each environment does next."""

from __future__ import annotations

import io
import pickle
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from dexctl.controller import Controller
from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.state import Bools, Floats, GraspState
from dexctl.streams import Streams
from dexctl.validation import check_numbers
from learning.exploration.mixture import (
    POLICY,
    Segments,
    advance,
    fixed_probabilities,
    linear_decay,
    value_probabilities,
)

CLONED = (None, "acted", "visited")
CLONINGS = ("likelihood", "squared")
CLONING_WEIGHTS = ("value", "equal", "better")
METHODS = ("rl", "rl+bc", "fge", "vge", "vge+bc")
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


@dataclass(frozen=True, kw_only=True)
class GuidanceConfig:
    """How the controllers guide the exploration.

    Attributes:
        method: "rl": no controllers. "rl+bc": they label the states that the policy visits.
            "fge": chosen on a fixed schedule (fixed guided exploration). "vge": chosen by value
            (value guided exploration). "vge+bc": and the policy imitates what they did.
        horizon: H, steps that a choice holds for; None: as long as the controller's own motion,
            and as the longest of them for the policy.
        hard_stop: controllers are asked no more from this environment step on; the thesis has 4 M.
        temperature: of VGE's softmax; 1 is the thesis's.
        fixed_start: FGE's share of the controllers at step 0; it falls linearly to 0 at the hard
            stop. The thesis gives no numbers; ours.
        beta: weight of behaviour cloning at step 0; falls linearly. Ours.
        beta_end: what it falls to; the thesis has 0.
        beta_stop: the step at which it is there; None: the hard stop.
        cloned: what the methods with bc imitate: "acted", the controllers' actions in the steps
            that they did (the thesis's VGE+BC), or "visited", what the first controller would do
            in every state that comes about, whoever acts (as in dataset aggregation; Ross et al.
            2011). RL+BC, where no controller acts, knows "visited" only. None: the method's.
        cloning: "likelihood" (the thesis's), or "squared": the squared distance between the
            policy's mean action and the controller's. TD3 knows "squared" only.
        cloning_weight: of each imitated action: "value", max(Q, 0) as in the thesis; "equal":
            1, with the actor's own loss divided by the mean |Q| (Fujimoto and Gu 2021), so
            that beta means the same however large values are; or "better": 1 where the critics
            prefer the controller's action to the policy's, else 0 (Nair et al. 2018).
    """

    method: str = "vge"
    horizon: int | None = None
    hard_stop: int = 4_000_000
    temperature: float = 1.0
    fixed_start: float = 1.0
    beta: float = 0.1
    beta_end: float = 0.0
    beta_stop: int | None = None
    cloned: str | None = None
    cloning: str = "likelihood"
    cloning_weight: str = "value"

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise UnknownName("method", self.method, METHODS)
        if self.horizon is not None and not self.horizon >= 1:
            raise InvalidInput(f"horizon is {self.horizon}; expected steps of at least 1, or None")
        for name, known in (
            ("cloned", CLONED), ("cloning", CLONINGS), ("cloning_weight", CLONING_WEIGHTS),
        ):  # fmt: skip
            if getattr(self, name) not in known:
                raise UnknownName(name, getattr(self, name), [str(one) for one in known])
        if self.cloned == "acted" and self.method == "rl+bc":
            raise InvalidInput("cloned is 'acted', and no controller acts in the method 'rl+bc'")
        if self.beta_stop is not None and self.beta_stop < 1:
            raise InvalidInput(f"beta_stop is {self.beta_stop}; expected steps from 1 on, or None")
        check_numbers(
            self,
            positive=("temperature",),
            not_negative=("hard_stop", "beta", "beta_end"),
            fractions=("fixed_start",),
        )

    @property
    def labels_all(self) -> bool:
        """Whether every state is labelled with what the first controller would do."""
        return self.imitates and (self.method == "rl+bc" or self.cloned == "visited")

    @property
    def follows(self) -> bool:
        """Whether controllers act."""
        return self.method in ("fge", "vge", "vge+bc")

    @property
    def imitates(self) -> bool:
        """Whether the policy is cloned from them."""
        return self.method.endswith("+bc")


def check_controllers(method: str, names: Sequence[str]) -> None:
    """Raise InvalidInput where a method has more or fewer controllers than it can use."""
    if method != "rl" and not names:
        raise InvalidInput(f"method {method!r} got no controllers; expected one or more")
    if method == "rl+bc" and len(names) > 1:
        raise InvalidInput(
            f"method 'rl+bc' has the controllers {', '.join(names)} at once; it takes one"
        )


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

    Attributes:
        lengths: H of each candidate, ``(1 + controllers,)`` [steps].
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
    ) -> None:
        if config.method == "rl":
            controllers = ()
        check_controllers(config.method, [type(controller).__name__ for controller in controllers])
        self.env, self.config = env, config
        self.controllers = tuple(controllers)
        own = [commitment(controller) for controller in self.controllers]
        self._restarts = [length is not None for length in own]
        lengths = [config.horizon or length or UNSTATED_HORIZON for length in own]
        self.lengths = np.array([max(lengths, default=1), *lengths], np.int64)
        self._streams = Streams(seed, (env.num_envs,))
        self.segments = Segments.start(env.num_envs)
        self.acted = np.zeros(len(self.lengths), np.int64)
        self.chances, self.choices = np.zeros(len(self.lengths)), 0
        for controller in self.controllers:
            controller.reset(seed)

    def asks(self, step: int) -> bool:
        """Whether the controllers are asked at environment step ``step``."""
        return bool(self.controllers) and step < self.config.hard_stop

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
        if not self.config.follows:
            self.acted[POLICY] += len(learner)
            return Guided(learner, self.segments.actor, ~nobody, proposed[1])
        chances = self._probabilities(step, np.flatnonzero(due), proposed, values)
        self.chances += np.broadcast_to(chances, (len(due), len(proposed)))[due].sum(axis=0)
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
            return Guided(action, actor, ~nobody, proposed[1])
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
        if config.method == "fge":
            share = linear_decay(step, config.fixed_start, config.hard_stop)
            return fixed_probabilities(share, count)
        found = np.zeros((proposed.shape[1], count))
        if len(rows):
            of_rows = values(rows, proposed[:, rows])
            found[rows] = value_probabilities(of_rows.T, config.temperature)
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
        """All that decides the future; controllers are pickled whole, but for their hand."""
        return {
            "actor": self.segments.actor,
            "left": self.segments.left,
            "streams": tuple(self._streams.save()),
            "acted": self.acted.copy(),
            "chances": self.chances.copy(),
            "choices": self.choices,
            "controllers": [_pickled(controller) for controller in self.controllers],
        }

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Continue from what `state_dict` gave.

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
        self._streams.restore(type(self._streams.save())(*saved["streams"]))
        self.acted = saved["acted"].copy()
        # checkpoints of earlier versions have not counted these
        self.chances = np.array(saved.get("chances", np.zeros(len(self.lengths))))
        self.choices = int(saved.get("choices", 0))
        self.controllers = tuple(
            _unpickled(data, controller.hand)
            for data, controller in zip(saved["controllers"], self.controllers, strict=True)
        )


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


def _pickled(controller: Controller) -> bytes:
    class Pickler(pickle.Pickler):
        def persistent_id(self, obj: object) -> str | None:
            return "hand" if obj is controller.hand else None

    file = io.BytesIO()
    Pickler(file).dump(controller)
    return file.getvalue()


def _unpickled(data: bytes, hand: object) -> Controller:
    class Unpickler(pickle.Unpickler):
        def persistent_load(self, pid: object) -> object:
            return hand

    return Unpickler(io.BytesIO(data)).load()
