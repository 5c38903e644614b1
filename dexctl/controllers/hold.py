"""Hold: the grasp by itself, for comparison."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike

from dexctl.controller import Controller, check_state
from dexctl.hand import HandModel
from dexctl.state import Floats, GraspState


@final
class Hold(Controller):
    """Leaves the set-points where they are: what the grasp does by itself, for comparison.

    Args:
        hand: the hand.
        control_period: [s].
        axis: whichever; it does not turn.
    """

    def __init__(
        self, hand: HandModel, *, control_period: float = 0.05, axis: ArrayLike | None = None
    ) -> None:
        super().__init__(hand, control_period=control_period)

    def reset(self, seed: ArrayLike | None = None, mask: ArrayLike | None = None) -> None:
        """Nothing to forget."""

    def state_dict(self) -> dict[str, Any]:
        return self._signed()

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        self._parts(saved)

    def act(self, state: GraspState) -> Floats:
        check_state(self.hand, state)
        return np.zeros_like(state.q_target)
