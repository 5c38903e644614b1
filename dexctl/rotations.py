"""Quaternions (wxyz) for batches, in the few forms that dexctl needs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def rotate(quaternion: Floats, vector: Floats) -> Floats:
    """``vector`` ``(..., 3)`` turned by ``quaternion`` ``(..., 4)``."""
    w, u = quaternion[..., :1], quaternion[..., 1:]
    t = 2.0 * cross(u, vector)
    return vector + w * t + cross(u, t)


def rotation_matrix(quaternion: Floats) -> Floats:
    """The matrices ``(..., 3, 3)`` that turn as ``quaternion`` ``(..., 4)`` does."""
    crossed = skew(quaternion[..., 1:])
    return np.eye(3) + 2.0 * (quaternion[..., :1, None] * crossed + crossed @ crossed)


def inverse(quaternion: Floats) -> Floats:
    """The inverse of unit quaternions ``(..., 4)``."""
    return quaternion * np.array([1.0, -1.0, -1.0, -1.0])


def multiply(a: Floats, b: Floats) -> Floats:
    """The quaternion product ``a b``: b's turn first, then a's."""
    aw, bw, av, bv = a[..., :1], b[..., :1], a[..., 1:], b[..., 1:]
    scalar = aw * bw - (av * bv).sum(axis=-1, keepdims=True)
    return np.concatenate([scalar, aw * bv + bw * av + cross(av, bv)], axis=-1)


def rotation_vector(quaternion: Floats) -> Floats:
    """Axis times angle ``(..., 3)`` [rad], angle in [0, pi]."""
    sign = np.where(quaternion[..., :1] < 0, -1.0, 1.0)
    w, u = sign * quaternion[..., :1], sign * quaternion[..., 1:]
    sine = np.sqrt((u * u).sum(axis=-1, keepdims=True))
    angle = 2.0 * np.arctan2(sine, w)
    return u * np.where(sine > 1e-9, angle / np.maximum(sine, 1e-9), 2.0)


def from_rotation_vector(vector: Floats) -> Floats:
    """The turn about ``vector`` ``(..., 3)`` by its length [rad], wxyz; see `rotation_vector`."""
    angle = np.sqrt((vector * vector).sum(axis=-1, keepdims=True))
    scale = np.where(angle > 1e-9, np.sin(0.5 * angle) / np.maximum(angle, 1e-9), 0.5)
    return np.concatenate([np.cos(0.5 * angle), scale * vector], axis=-1)


def twist_angle(quaternion: Floats, axis: Floats) -> Floats:
    """The turn about ``axis``, ``(3,)`` or ``(..., 3)``: ``(...)`` [rad], in [-2 pi, 2 pi].

    It is the twist of the swing-twist decomposition, so that tilting alone does not count.
    """
    return 2.0 * np.arctan2((quaternion[..., 1:] * axis).sum(axis=-1), quaternion[..., 0])


def shortest(angle: Floats) -> Floats:
    """``angle`` ``(...)`` [rad] as the shortest turn that ends in the same place, [-pi, pi)."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def angle_between(a: Floats, b: Floats) -> Floats:
    """The angle ``(...)`` [rad], in [0, pi], of the turn between orientations ``(..., 4)``."""
    turn = multiply(a, inverse(b))
    sine = np.sqrt((turn[..., 1:] ** 2).sum(axis=-1))
    return 2.0 * np.arctan2(sine, np.abs(turn[..., 0]))


def cross(a: Floats, b: Floats) -> Floats:
    """The cross product along the last axis (numpy's is an order slower for small arrays)."""
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    out[..., 0] = ay * bz - az * by
    out[..., 1] = az * bx - ax * bz
    out[..., 2] = ax * by - ay * bx
    return out


def skew(vector: Floats) -> Floats:
    """The matrices ``(..., 3, 3)`` by which vectors are crossed with ``vector`` ``(..., 3)``."""
    return (vector @ _SKEW).reshape(*vector.shape, 3)


_SKEW = np.zeros((3, 9))
for _axis, (_row, _column) in enumerate(((2, 1), (0, 2), (1, 0))):
    _SKEW[_axis, 3 * _row + _column], _SKEW[_axis, 3 * _column + _row] = 1.0, -1.0
