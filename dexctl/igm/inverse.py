"""From contact velocities to joint velocities: damped least squares, finger by finger or whole."""

from __future__ import annotations

import numpy as np

from dexctl.hand import HandModel
from dexctl.state import Floats


class ContactInverse:
    """Solves J_S dq = dp in the damped least-squares sense (thesis chapter 4, eqs. dqstab, dqrot).

    Where no joint is shared, each finger is a system of its own and is solved as a 3 x 3 one;
    with a wrist the stacked system of all fingers is solved. Both give
    dq = J^T (J J^T + damping^2 I)^-1 dp.

    Args:
        hand: the hand.
        damping: in metres, the unit of J; keeps dq finite near singular finger postures.
    """

    def __init__(self, hand: HandModel, damping: float) -> None:
        self._nq = hand.nq
        self._shared = hand.shares_joints
        self._ridge = damping**2 * np.eye(3 * hand.n_fingers if self._shared else 3)
        if not self._shared:
            widest = int(hand.moves.sum(axis=1).max())
            # joints of each finger, padded with a column that is always zero (index nq)
            self._joints = np.full((hand.n_fingers, widest), hand.nq)
            for finger, moved in enumerate(hand.moves):
                own = np.flatnonzero(moved)
                self._joints[finger, : len(own)] = own
            self._padded = bool((self._joints == hand.nq).any())
            # the joints of finger 1, then of finger 2, ...: often just 0, 1, 2, ...
            flat = self._joints.ravel()
            self._in_order = flat.size == hand.nq and bool((flat == np.arange(hand.nq)).all())
            self._rows = np.arange(hand.n_fingers)[:, None]

    def solve(self, jacobian: Floats, velocity: Floats) -> Floats:
        """Joint velocities ``(..., d)`` for J ``(..., m, 3, d)`` and dp ``(..., m, 3)``."""
        batch = velocity.shape[:-2]
        if self._shared:
            stacked = jacobian.reshape(*batch, -1, self._nq)
            gram = stacked @ stacked.swapaxes(-1, -2) + self._ridge
            weights = np.linalg.solve(gram, velocity.reshape(*batch, -1, 1))
            return (stacked.swapaxes(-1, -2) @ weights)[..., 0]
        if self._padded:
            jacobian = np.concatenate([jacobian, np.zeros((*jacobian.shape[:-1], 1))], axis=-1)
        # own[..., i, j, :] is the column of finger i's j-th joint: J_i transposed
        own = jacobian.swapaxes(-1, -2)[..., self._rows, self._joints, :]
        gram = own.swapaxes(-1, -2) @ own + self._ridge
        motion = (own @ np.linalg.solve(gram, velocity[..., None]))[..., 0]
        if self._in_order:
            return motion.reshape(*batch, self._nq)
        out = np.zeros((*batch, self._nq + 1))
        out[..., self._joints] = motion
        return out[..., :-1]
