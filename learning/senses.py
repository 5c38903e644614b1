"""A controller that sees through sensors which are noisy and late."""

from __future__ import annotations

from typing import final

import numpy as np
from numpy.typing import ArrayLike

from dexctl.controller import Controller
from dexctl.state import Floats, GraspState
from dexctl.streams import Streams
from learning.envs.latency import Delay
from learning.envs.noise import SensorNoise, observed

# a stream of its own, beside the simulator's and the controller's
_NOISE_SEED = 1 << 42


@final
class Senses(Controller):
    """A controller, and the sensors between it and a batch of hands.

    Args:
        controller: who sees.
        count: N.
        noise: how badly.
        latency: how late, in control steps.
    """

    def __init__(
        self,
        controller: Controller,
        count: int,
        noise: SensorNoise = SensorNoise(),  # noqa: B008 (frozen)
        latency: int = 0,
    ) -> None:
        super().__init__(controller.hand, control_period=controller.control_period)
        self._controller, self._noise = controller, noise
        self._streams = Streams(_NOISE_SEED, (count,))
        self._delay = Delay(latency)
        self._begin = np.ones(count, bool)

    def reset(self, seed: ArrayLike | None = None, mask: ArrayLike | None = None) -> None:
        self._controller.reset(seed, mask)
        chosen = np.ones_like(self._begin) if mask is None else np.asarray(mask, bool)
        self._begin = self._begin | chosen
        if seed is not None:
            self._streams.reseed(np.asarray(seed, object) + _NOISE_SEED, chosen)

    def act(self, state: GraspState) -> Floats:
        sensed = observed(state, self._noise, self._streams)
        seen = self._delay(sensed)
        if self._begin.any():
            seen = self._delay(sensed, self._begin)
            self._begin = np.zeros_like(self._begin)
        action = self._controller.act(seen)
        self._diagnostics = dict(self._controller.diagnostics)
        return action
