"""Metric: how far grasps are from each other, and which of a tree is nearest to a target."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dexctl.exceptions import InvalidInput
from dexctl.planning.nodes import Frame, Nodes
from dexctl.state import Floats
from dexctl.validation import check_numbers

_BLOCK = 4096  # points that are compared at a time


@dataclass(frozen=True, kw_only=True)
class Metric:
    """Weights of the parts of a distance between grasps (dist of thesis chapter 5, Alg. G-RRT).

    A grasp is a point of d + 6 coordinates: joints, position, tilt and rotation, each times its
    weight; the distance is Euclid's. The rotation is the unwrapped one: with the angle modulo a
    turn, a grasp after a full turn would be as near to a target as the root.
    """

    joints: float = 0.3
    """Of a radian of joint."""
    position: float = 10.0
    """Of a metre of the object."""
    tilt: float = 1.0
    """Of a radian of the object's tilt."""
    rotation: float = 1.0
    """Of a radian of the object's rotation about the axis."""

    def __post_init__(self) -> None:
        check_numbers(self, not_negative=("joints", "position", "tilt", "rotation"))
        if not (self.position or self.tilt or self.rotation or self.joints):
            raise InvalidInput("all weights of the metric are 0; expected one above 0")

    def features(
        self, q: Floats, displacement: Floats, tilt: Floats, rotation: Floats
    ) -> NDArray[np.float32]:
        """Points ``(..., d + 6)`` whose Euclidean distance is the metric's."""
        return np.concatenate(
            [
                self.joints * q,
                self.position * displacement,
                self.tilt * tilt,
                self.rotation * rotation[..., None],
            ],
            axis=-1,
        ).astype(np.float32)

    def of(self, frame: Frame, nodes: Nodes) -> NDArray[np.float32]:
        """The points of nodes, ``(N, d + 6)``."""
        return self.features(
            nodes.q,
            frame.displacement(nodes.object_position),
            frame.tilt(nodes.object_quaternion),
            nodes.rotation,
        )


class Nearest:
    """The nearest of a growing set of points, by brute force.

    At twenty dimensions and 10^5 points a matrix product in float32 with the norms kept is six
    times as fast as a KD-tree, which has to look nearly everywhere. The norms are a column of the
    points, and the product is taken in blocks that stay in the cache: three times as fast again.
    """

    def __init__(self, width: int) -> None:
        self._points = np.zeros((1024, width + 1), np.float32)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def add(self, points: NDArray[np.float32]) -> None:
        """Append points ``(K, width)``."""
        end = self._count + len(points)
        while end > len(self._points):
            self._points = np.concatenate([self._points, np.zeros_like(self._points)])
        self._points[self._count : end, :-1] = points
        self._points[self._count : end, -1] = (points * points).sum(axis=1)
        self._count = end

    def __call__(self, targets: NDArray[np.float32]) -> NDArray[np.intp]:
        """Which point is nearest to each target ``(B, width)``, ``(B,)``."""
        return self.nearest(targets)[0]

    def nearest(self, targets: NDArray[np.float32]) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
        """As by a call, and how far it is, ``(B,)`` each."""
        points, count = self._points[: self._count], len(targets)
        # |p|^2 - 2 p t, which is the squared distance but for |t|^2
        sought = np.concatenate([-2.0 * targets, np.ones((count, 1), np.float32)], axis=1)
        index, least = np.zeros(count, np.intp), np.full(count, np.inf, np.float32)
        for first in range(0, len(points), _BLOCK):
            found = sought @ points[first : first + _BLOCK].T
            best = np.argmin(found, axis=1)
            value = found[np.arange(count), best]
            nearer = value < least
            index[nearer], least[nearer] = first + best[nearer], value[nearer]
        # anew: the difference of squares above is not exact where two points nearly coincide
        return index, np.linalg.norm(points[index, :-1] - targets, axis=1)
