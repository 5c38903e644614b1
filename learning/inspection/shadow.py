"""Controllers in shadow: asked in every state that another one's actions lead to.

The angle between what was done and what they would have done says how far somebody goes their way.
"""

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
NOTHING = 1e-9
"""A set-point change shorter than this [rad] has no direction."""


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


def action_angle(a: ArrayLike, b: ArrayLike, joints: ArrayLike | None = None) -> Floats:
    """Angle ``(...)`` [rad] in [0, pi] between set-point changes ``(..., d)``.

    NaN where one of them is zero: then there is no angle. Two random directions of d joints make
    one of pi/2, give or take about 1 / sqrt(d).

    Args:
        a, b: the actions.
        joints: which joints count, ``(..., d)`` bool; None is all.

    Raises:
        InvalidInput: they are not of one shape.
    """
    a, b = np.asarray(a, float), np.asarray(b, float)
    if a.shape != b.shape:
        raise InvalidInput(f"actions have shapes {a.shape} and {b.shape}; expected the same")
    if joints is not None:
        a, b = np.where(joints, a, 0.0), np.where(joints, b, 0.0)
    long_a = np.sqrt((a * a).sum(axis=-1, keepdims=True))
    long_b = np.sqrt((b * b).sum(axis=-1, keepdims=True))
    defined = ((long_a > NOTHING) & (long_b > NOTHING))[..., 0]
    a = a / np.where(long_a > NOTHING, long_a, 1.0)
    b = b / np.where(long_b > NOTHING, long_b, 1.0)
    # exact near 0 and pi, where the arc cosine is not
    apart = np.sqrt(((a - b) ** 2).sum(axis=-1))
    together = np.sqrt(((a + b) ** 2).sum(axis=-1))
    return np.where(defined, 2.0 * np.arctan2(apart, together), np.nan)
