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
        self._hand = hand
        self._shared = hand.shares_joints
        self._ridge = damping**2 * np.eye(3 * hand.n_fingers if self._shared else 3)
        joints = hand.finger_joints.ravel()
        # the joints of finger 1, then of finger 2, ...: often just 0, 1, 2, ...
        self._in_order = joints.size == hand.nq and bool((joints == np.arange(hand.nq)).all())

    def solve(self, finger_jacobian: Floats, velocity: Floats) -> Floats:
        """Joint velocities ``(..., d)`` for contact velocities dp ``(..., m, 3)``.

        ``finger_jacobian`` ``(..., m, n, 3)`` is that of `HandConfiguration`.
        """
        batch = velocity.shape[:-2]
        if self._shared:
            stacked = finger_jacobian.swapaxes(-1, -2) @ self._hand.finger_joint_map
            rows = stacked.shape[-3] * stacked.shape[-2]  # -1 is not told in an empty batch
            stacked = stacked.reshape(*batch, rows, self._hand.nq)
            gram = stacked @ stacked.swapaxes(-1, -2) + self._ridge
            weights = np.linalg.solve(gram, velocity.reshape(*batch, rows, 1))
            return (stacked.swapaxes(-1, -2) @ weights)[..., 0]
        gram = finger_jacobian.swapaxes(-1, -2) @ finger_jacobian
        gram += self._ridge
        motion = finger_jacobian @ solve_symmetric3(gram, velocity)[..., None]
        if self._in_order:
            return motion.reshape(*batch, self._hand.nq)
        return (motion.swapaxes(-1, -2) @ self._hand.finger_joint_map).sum(axis=(-3, -2))


def solve_symmetric3(matrix: Floats, right: Floats) -> Floats:
    """Solve A x = b for symmetric positive definite A ``(..., 3, 3)`` and b ``(..., 3)``.

    By cofactors: for many small systems at once this is several times faster than LAPACK.
    """
    if matrix.ndim < 4:
        return np.asarray(np.linalg.solve(matrix, right[..., None])[..., 0], float)
    a, b, c = matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 0, 2]
    d, e, f = matrix[..., 1, 1], matrix[..., 1, 2], matrix[..., 2, 2]
    x, y, z = right[..., 0], right[..., 1], right[..., 2]
    aa, bb, cc = d * f - e * e, c * e - b * f, b * e - c * d
    scale = 1.0 / (a * aa + b * bb + c * cc)
    dd, ee, ff = a * f - c * c, b * c - a * e, a * d - b * b
    out = np.empty_like(right)
    out[..., 0] = (aa * x + bb * y + cc * z) * scale
    out[..., 1] = (bb * x + dd * y + ee * z) * scale
    out[..., 2] = (cc * x + ee * y + ff * z) * scale
    return out
