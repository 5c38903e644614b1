"""Where a training step spends its time: the clock read at the calls that begin or end a part."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import stable_baselines3.sac.sac as stock_sac
from stable_baselines3 import SAC

import learning.agents.sac as our_sac

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


def profiled(call: Callable[[], Any], agent: Any) -> dict[str, float]:
    """Milliseconds of each part and ``total``, for each step of all environments of ``call``."""
    watch = Stopwatch()

    def whole(part: str) -> Callable[[Any], Any]:
        def make(before: Any) -> Any:
            def timed(*arguments: Any, **named: Any) -> Any:
                watch.begin(part)
                try:
                    return before(*arguments, **named)
                finally:
                    watch.end()

            return timed

        return make

    def then(part: str) -> Callable[[Any], Any]:
        def make(before: Any) -> Any:
            def turning(*arguments: Any, **named: Any) -> Any:
                try:
                    return before(*arguments, **named)
                finally:
                    watch.turn(part)

            return turning

        return make

    steps = agent.num_timesteps
    with ExitStack() as stack:

        def wrap(owner: Any, name: str, make: Callable[[Any], Any]) -> None:
            stack.enter_context(replaced(owner, name, make))

        wrap(agent.env, "step", whole("environment"))
        for group in agent.env.env.sim.groups:
            wrap(group, "_pool", lambda before: lambda: _Timed(before(), watch))
        if getattr(agent, "guide", None) is not None:
            wrap(agent.guide, "act", whole("choice"))
            wrap(agent.guide, "_ask", whole("controllers"))
            wrap(agent.guide, "after_step", whole("controllers"))
            wrap(agent, "_policy_actions", whole("policy"))
        else:
            wrap(agent, "_sample_action", whole("policy"))
        wrap(agent, "_store_transition", whole("store"))
        wrap(agent, "train", whole("loop"))
        wrap(agent.replay_buffer, "sample", _sampling(watch))
        if type(agent) is SAC:  # critics, actor, target critics
            wrap(agent.critic.optimizer, "step", then("actor"))
            wrap(agent.actor.optimizer, "step", then("follow"))
            wrap(stock_sac, "polyak_update", then("loop"))
        else:  # critics, target critics, actor
            wrap(agent.critic.optimizer, "step", then("follow"))
            wrap(our_sac, "follow", then("actor"))
            wrap(agent.actor.optimizer, "step", then("loop"))
        watch.lap()
        watch.seconds = dict.fromkeys(PARTS, 0.0)
        call()
        watch.lap()
    turns = (agent.num_timesteps - steps) / agent.n_envs
    found = {part: 1e3 * seconds / turns for part, seconds in watch.seconds.items()}
    found = {**found, "total": sum(found.values())}
    return {part: round(ms, 3) for part, ms in found.items()}


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
