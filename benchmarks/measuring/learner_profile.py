"""Where a training step spends its time: the clock read at the calls that begin or end a part."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import stable_baselines3.sac.sac as stock
from stable_baselines3 import SAC

from learning.envs.vector import ManipulationVectorEnv
from learning.training.trainer import Trainer

PARTS = {
    "physics": "physics (`mujoco.rollout`, two threads)",
    "environment": "set-points, sensing, reward, observation",
    "controllers": "controllers",
    "choice": "who acts, the critic's values",
    "policy": "the policy's actions",
    "store": "replay: store",
    "sample": "replay: sample",
    "critic": "update of the critics",
    "actor": "update of the actor",
    "follow": "update of the target critics",
    "loop": "the rest of the loop",
}


class Stopwatch:
    """Time by part; a part that begins inside another stops that one's clock."""

    def __init__(self) -> None:
        self.seconds = dict.fromkeys(PARTS, 0.0)
        self._inside = ["loop"]
        self._since = time.perf_counter()

    def lap(self) -> None:
        """Give the time since the last call to the part that is going on."""
        now = time.perf_counter()
        self.seconds[self._inside[-1]] += now - self._since
        self._since = now

    def begin(self, part: str) -> None:
        """A part begins inside the one that is going on."""
        self.lap()
        self._inside.append(part)

    def end(self) -> None:
        """The part ends, and the one around it goes on."""
        self.lap()
        self._inside.pop()

    def turn(self, part: str) -> None:
        """The part that is going on gives way to another."""
        self.lap()
        self._inside[-1] = part


@contextmanager
def replaced(owner: Any, name: str, make: Callable[[Any], Any]) -> Iterator[None]:
    """An attribute of ``owner`` in the place of another made from it."""
    before, own = getattr(owner, name), name in vars(owner)
    setattr(owner, name, make(before))
    try:
        yield
    finally:
        if own:
            setattr(owner, name, before)
        else:
            delattr(owner, name)


Wrap = Callable[[Any, str, Callable[[Any], Any]], None]


def profiled_stock(agent: SAC, call: Callable[[], Any], turns: int) -> dict[str, float]:
    """Milliseconds of each part and ``total``, for each of the ``turns`` of ``call``."""

    def wrap_all(watch: Stopwatch, wrap: Wrap) -> None:
        env: Any = agent.env
        wrap(env, "step", _whole(watch, "environment"))
        _wrap_physics(watch, wrap, env.env)
        wrap(agent, "_sample_action", _whole(watch, "policy"))
        wrap(agent, "_store_transition", _whole(watch, "store"))
        wrap(agent, "train", _whole(watch, "loop"))
        wrap(agent.replay_buffer, "sample", _sampling(watch))
        # critics, actor, target critics
        wrap(agent.critic.optimizer, "step", _then(watch, "actor"))
        wrap(agent.actor.optimizer, "step", _then(watch, "follow"))
        wrap(stock, "polyak_update", _then(watch, "loop"))

    return _profiled(wrap_all, call, turns)


def profiled_ours(trainer: Trainer, call: Callable[[], Any], turns: int) -> dict[str, float]:
    """As `profiled_stock`, of a trainer whose SAC updates after the environments' step."""

    def wrap_all(watch: Stopwatch, wrap: Wrap) -> None:
        algorithm: Any = trainer.algorithm
        wrap(trainer.env, "step", _whole(watch, "environment"))
        _wrap_physics(watch, wrap, trainer.env)
        wrap(trainer.guide, "act", _whole(watch, "choice"))
        wrap(trainer.guide, "_ask", _whole(watch, "controllers"))
        wrap(trainer.guide, "after_step", _whole(watch, "controllers"))
        wrap(algorithm, "act", _whole(watch, "policy"))
        wrap(algorithm, "observe", _whole(watch, "store"))
        wrap(algorithm, "update", _whole(watch, "loop"))
        wrap(algorithm.replay, "sample", _sampling(watch))
        # critics, target critics, actor
        wrap(algorithm.optimizers["critic"], "step", _then(watch, "follow"))
        wrap(algorithm.networks["critic_target"], "follow", _then(watch, "actor"))
        wrap(algorithm.optimizers["actor"], "step", _then(watch, "loop"))

    return _profiled(wrap_all, call, turns)


def _profiled(
    wrap_all: Callable[[Stopwatch, Wrap], None], call: Callable[[], Any], turns: int
) -> dict[str, float]:
    watch = Stopwatch()
    with ExitStack() as stack:
        wrap_all(watch, lambda *which: stack.enter_context(replaced(*which)))
        watch.lap()
        watch.seconds = dict.fromkeys(PARTS, 0.0)
        call()
        watch.lap()
    found = {part: 1e3 * seconds / turns for part, seconds in watch.seconds.items()}
    found = {**found, "total": sum(found.values())}
    return {part: round(ms, 3) for part, ms in found.items()}


def _whole(watch: Stopwatch, part: str) -> Callable[[Any], Any]:
    """Of a call that is a part."""

    def make(before: Any) -> Any:
        def timed(*arguments: Any, **named: Any) -> Any:
            watch.begin(part)
            try:
                return before(*arguments, **named)
            finally:
                watch.end()

        return timed

    return make


def _then(watch: Stopwatch, part: str) -> Callable[[Any], Any]:
    """Of a call behind which the part begins."""

    def make(before: Any) -> Any:
        def turning(*arguments: Any, **named: Any) -> Any:
            try:
                return before(*arguments, **named)
            finally:
                watch.turn(part)

        return turning

    return make


def _sampling(watch: Stopwatch) -> Callable[[Any], Any]:
    def make(before: Any) -> Any:
        def sample(*arguments: Any, **named: Any) -> Any:
            watch.turn("sample")
            try:
                return before(*arguments, **named)
            finally:
                watch.turn("critic")

        return sample

    return make


def _wrap_physics(watch: Stopwatch, wrap: Wrap, env: ManipulationVectorEnv) -> None:
    for group in env.simulation.sim.groups:
        wrap(group, "_pool", lambda before: lambda: _Timed(before(), watch))


class _Timed:
    """A rollout pool whose calls are timed."""

    def __init__(self, pool: Any, watch: Stopwatch) -> None:
        self._pool, self._watch = pool, watch

    def rollout(self, *arguments: Any, **named: Any) -> Any:
        self._watch.begin("physics")
        try:
            return self._pool.rollout(*arguments, **named)
        finally:
            self._watch.end()
