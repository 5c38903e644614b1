"""Latency: what the sensors tell now is how things were some control steps ago."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dexctl.state import Bools, GraspState
from learning.envs.batches import merged


class Delay:
    """Gives the states of a batch back so many control steps later.

    Set-points are not sensed, so they are the present ones. At the start of an episode the sensors
    tell what they told first, until there is something older than the latency.

    Args:
        steps: how many; 0 gives each state back as it is.
    """

    def __init__(self, steps: int) -> None:
        self._steps = steps
        self._past: tuple[GraspState, ...] = ()  # steps + 1 states, the oldest first

    def __call__(self, state: GraspState, begin: Bools | None = None) -> GraspState:
        """What is sensed of ``state`` ``(N,)``.

        Args:
            state: now.
            begin: None where a control step has passed in every environment; else those
                ``(N,)`` whose episode begins with ``state``, while the others stand still.
        """
        if not self._steps:
            return state
        if not self._past:
            self._past = (state,) * (self._steps + 1)
        elif begin is None:
            self._past = (*self._past[1:], state)
        else:
            self._past = tuple(merged(begin, state, one) for one in self._past)
        then = self._past[0]
        age = np.maximum(state.age, np.asarray(state.time) - np.asarray(then.time))
        return replace(then, q_target=state.q_target, time=state.time, age=age)

    def save(self) -> tuple[GraspState, ...]:
        """All that decides what is to come, to be given to `restore`."""
        return self._past

    def restore(self, saved: tuple[GraspState, ...]) -> None:
        """Go on from what `save` returned."""
        self._past = saved
