"""Transitions turned by a hand's symmetries: what was learned from one also holds for the others.

(Lin et al., Invariant transform experience replay, 2020; van der Pol et al., MDP homomorphic
networks, 2020.)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from dexctl.exceptions import InvalidInput
from dexctl.hand import HandModel
from dexctl.rotations import cross
from dexctl.state import Floats
from dexctl.symmetry import HandSymmetry, symmetries
from learning.envs.observation import (
    DRAWN,
    FINGERTIP_FORCE,
    JOINT_OFFSET,
    OBJECT_VELOCITY,
    Observation,
)
from learning.envs.truth import turned_features

_TOLERANCE = 1e-6
Turned = Callable[[HandSymmetry, Floats], Floats]


def _points(one: HandSymmetry, values: Floats) -> Floats:
    each = values.reshape(len(values), len(one.fingers), 3)
    return one.of_points(each).reshape(values.shape)


def _orientations(one: HandSymmetry, values: Floats) -> Floats:
    found = one.of_orientations(values)
    return np.where(found[:, :1] < 0, -found, found)


def _orientation_columns(one: HandSymmetry, values: Floats) -> Floats:
    """As `_orientations`, of the first two columns of rotation matrices, ``(B, 6)``."""
    found = values.reshape(-1, 2, 3) @ one.matrix.T
    if one.mirrors:
        found[:, 1] *= -1.0  # between two images in its xz plane
    return found.reshape(values.shape)


def _rotations(one: HandSymmetry, values: Floats) -> Floats:
    """Of the first two columns of rotation matrices, ``(B, 6)``."""
    x, y = values[:, :3], values[:, 3:]
    matrix = np.stack([x, y, cross(x, y)], axis=-1)
    return (one.matrix @ matrix @ one.matrix.T)[..., :2].swapaxes(1, 2).reshape(-1, 6)


def _velocities(one: HandSymmetry, values: Floats) -> Floats:
    linear, angular = one.of_vectors(values[:, :3]), one.of_turnings(values[:, 3:])
    return np.concatenate([linear, angular], axis=1)


_TURNED: dict[str, Turned] = {
    "q": HandSymmetry.of_joints,
    "q_target": HandSymmetry.of_joints,
    "contact_position": _points,
    "contact_normal": _points,
    "contact_force": HandSymmetry.of_fingers,
    "touch": HandSymmetry.of_fingers,
    "object_position": HandSymmetry.of_vectors,
    "object_quaternion": _orientations,
    "object_rotation": _orientation_columns,
    "gravity": HandSymmetry.of_vectors,
    "goal_quaternion": _orientations,
    "goal_rotation": _rotations,
    "goal_angular_velocity": HandSymmetry.of_turnings,
    OBJECT_VELOCITY: _velocities,
    FINGERTIP_FORCE: _points,
    JOINT_OFFSET: HandSymmetry.of_joints,
    DRAWN: turned_features,
}


class Fixed(NamedTuple):
    """What a symmetry has to leave as it is.

    Attributes:
        directions: of the hand frame, such as gravity's, each ``(3,)``.
        axes: to turn about, which are always the same, each ``(3,)``.
        mirrored: whether the objects are their own mirror images in the xz planes of their bodies.
    """

    directions: Sequence[Floats]
    axes: Sequence[Floats] = ()
    mirrored: bool = True


class Symmetry:
    """Turns observations and actions by the symmetries of a hand.

    Args:
        hand: the hand.
        observations: the policy's and, behind it, the critics'.
        fixed: what decides what is worth what, and no part tells; only symmetries that leave it as
            it is are taken.

    Attributes:
        elements: the symmetries, the identity first.

    Raises:
        InvalidInput: the hand has none that can be used, or a part cannot be turned.
    """

    def __init__(self, hand: HandModel, observations: Sequence[Observation], fixed: Fixed) -> None:
        points = np.array([*fixed.directions, *(one.centre for one in observations)])
        axes = np.array(fixed.axes).reshape(-1, 3)
        self.elements = tuple(
            one
            for one in symmetries(hand)
            if np.abs(one.of_vectors(points) - points).max() < _TOLERANCE
            and np.abs(one.of_turnings(axes) - axes).max(initial=0.0) < _TOLERANCE
            and (fixed.mirrored or not one.mirrors)
        )
        if len(self.elements) < 2:
            raise InvalidInput(
                f"symmetry is True, and the hand {hand.name!r} has no symmetry that leaves "
                "gravity, the axis of the task and the place of the grasp as they are; expected "
                "False"
            )
        self._parts: list[tuple[slice, Turned]] = []
        start = 0
        for one in observations:
            for name, columns in one.slices.items():
                if name not in _TURNED:
                    raise InvalidInput(
                        f"symmetry is True, and an observation has the part {name!r}, which cannot "
                        "be turned; expected False, or another part"
                    )
                where = slice(start + columns.start, start + columns.stop)
                self._parts.append((where, _TURNED[name]))
            start += one.size

    def observation(self, which: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Observations ``(B, K)``, each turned by the element that ``which`` ``(B,)`` says."""
        found = values.copy()
        for i, one in enumerate(self.elements[1:], start=1):
            rows = which == i
            if rows.any():
                chosen = values[rows]
                for columns, turn in self._parts:
                    chosen[:, columns] = turn(one, values[rows][:, columns])
                found[rows] = chosen
        return found

    def action(self, which: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Actions ``(B, d)``, turned likewise."""
        found = values.copy()
        for i, one in enumerate(self.elements[1:], start=1):
            rows = which == i
            found[rows] = one.of_joints(values[rows])
        return found
