"""Closing: after an approach, fingers that do not feel the object go on until they do.

Where the origins of joints are off, by the few hundredths of a radian that a calibration leaves,
fingers that go to the set-points of a grasp stop short of the object by millimetres. A controller
that begins there, with two or three fingers of five, begins where it knows nothing.
"""

from __future__ import annotations

from typing import final

import numpy as np

from dexctl import HandModel
from dexctl.exceptions import InvalidInput
from dexctl.state import Bools, Floats, GraspState
from dexctl.validation import check_numbers

_DAMPING = 0.01  # m, of the pseudo-inverse: far below the length of a finger


@final
class Closing:
    """Moves the fingertips that do not press towards the middle of the grasp.

    Args:
        hand: the hand.
        control_period: time between two calls [s].
        speed: of a fingertip's set-point [m/s]. With servos 50 ms late it presses by a few tenths
            of a newton more than asked for.
        travel: how far it goes on at most [m].
        force: from which a finger presses enough [N].

    Attributes:
        travelled: how far each finger went on, ``(m,)`` [m].
        done: whether each presses, or has gone as far as it may.

    Raises:
        InvalidInput: a number that is not finite and above 0.
    """

    def __init__(
        self,
        hand: HandModel,
        *,
        control_period: float,
        speed: float = 0.02,
        travel: float = 0.02,
        force: float = 1.2,
    ) -> None:
        self.hand, self.control_period = hand, control_period
        self.speed, self.travel, self.force = speed, travel, force
        check_numbers(self, positive=("control_period", "speed", "travel", "force"))
        self.travelled = np.zeros(hand.n_fingers)
        self.done = False

    def __call__(self, state: GraspState, unfelt: Bools | None = None) -> Floats:
        """The change of set-points for this control period, ``(d,)`` [rad].

        Args:
            state: of one hand, ``()``.
            unfelt: fingers of which nothing is known now, ``(m,)``; they stay where they are, since
                one whose sensor is silent would press as hard as it can.

        Raises:
            InvalidInput: a batch.
        """
        if state.batch_shape:
            raise InvalidInput(f"the state has the batch shape {state.batch_shape}; expected ()")
        hand = self.hand
        presses = state.in_contact & (state.contact_force >= self.force)
        going = ~presses & (self.travelled < self.travel - 1e-9)
        if unfelt is not None:
            going &= ~unfelt
        self.done = not going.any()
        if self.done:
            return np.zeros(hand.nq)
        tips = hand.fingertip_positions(state.q)
        inwards = tips.mean(axis=0) - tips
        inwards /= np.maximum(np.linalg.norm(inwards, axis=1, keepdims=True), 1e-9)
        step = self.speed * self.control_period
        wanted = np.where(going[:, None], step * inwards, 0.0)
        jacobian = hand.contact_jacobian(state.q, tips)
        change = np.zeros(hand.nq)
        alone = hand.moves.sum(axis=0) == 1  # a joint of several would move those that press
        for finger in np.flatnonzero(going):
            own = hand.moves[finger] & alone
            j = jacobian[finger][:, own]
            damped = j @ j.T + _DAMPING**2 * np.eye(3)
            change[own] = j.T @ np.linalg.solve(damped, wanted[finger])
        self.travelled[going] += step
        return change
