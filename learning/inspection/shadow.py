"""Controllers in shadow: asked in every state that another one's actions lead to."""

from __future__ import annotations

from collections.abc import Mapping
from typing import final

import numpy as np
from numpy.typing import ArrayLike

from dexctl.controller import Controller
from dexctl.exceptions import InvalidInput
from dexctl.state import Floats, GraspState
from learning.exploration.guide import UNSTATED_HORIZON, commitment

ACTION = "inspected_action"


@final
class Shadowed(Controller):
    """A controller that acts, and others that only say what they would do.

    As in training, those in shadow see every state, so that the ones with a memory follow what
    happens; and those whose motion has a length of its own begin it anew every ``horizon`` steps,
    as they would at each choice of who acts.

    Args:
        controller: who acts.
        shadows: the others, by name.
        horizon: steps that a choice holds for; None as in training: the longest motion.

    Attributes:
        horizon: as used [steps].

    Diagnostics are the controller's own, `ACTION` with what it did, and ``shadow:NAME`` with what
    each other would have done, ``(..., d)`` [rad].

    Raises:
        InvalidInput: they are not of one hand and one control period.
    """

    def __init__(
        self,
        controller: Controller,
        shadows: Mapping[str, Controller],
        horizon: int | None = None,
    ) -> None:
        super().__init__(controller.hand, control_period=controller.control_period)
        for name, one in shadows.items():
            if one.hand is not controller.hand or one.control_period != controller.control_period:
                raise InvalidInput(f"{name} is of another hand or control_period than who acts")
        self._controller, self._shadows = controller, dict(shadows)
        own = {name: commitment(one) for name, one in shadows.items()}
        lengths = [horizon or length or UNSTATED_HORIZON for length in own.values()]
        self.horizon = max(lengths, default=horizon or UNSTATED_HORIZON)
        self._restarted = [name for name, length in own.items() if length is not None]
        self._steps = 0

    def reset(self, seed: ArrayLike | None = None, mask: ArrayLike | None = None) -> None:
        """All of them."""
        for one in (self._controller, *self._shadows.values()):
            one.reset(seed, mask)
        self._steps = 0

    def act(self, state: GraspState) -> Floats:
        if self._steps % self.horizon == 0 and self._steps:
            everywhere = np.ones(state.batch_shape, bool) if state.batch_shape else None
            for name in self._restarted:
                self._shadows[name].reset(mask=everywhere)
        self._steps += 1
        action = self._controller.act(state)
        self._diagnostics = {**self._controller.diagnostics, ACTION: action}
        for name, one in self._shadows.items():
            self._diagnostics[f"shadow:{name}"] = one.act(state)
        return action
