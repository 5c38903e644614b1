"""Symmetries of a hand: turns and mirror images of it that are the hand itself, fingers swapped.

Found from its kinematics. Whether the shapes of its links follow them is not looked at.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import permutations, product
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from dexctl.hand import HandModel, random_configurations
from dexctl.rotations import multiply
from dexctl.state import Floats, GraspState

_TOLERANCE = 1e-6  # of fingertips [m], and of joint limits [rad]
_MOST_FINGERS = 6  # the ways to place them are tried one by one
_SAMPLES = 6
_FAR = 1e6  # stands for no limit [rad]
_known: WeakKeyDictionary[HandModel, tuple[HandSymmetry, ...]] = WeakKeyDictionary()


_MIRROR = np.diag([1.0, -1.0, 1.0])  # of an object's body, where the hand is mirrored


@dataclass(frozen=True, eq=False)
class HandSymmetry:
    """A turn about the hand frame's origin, or a mirror image, that brings the hand to itself.

    In a mirror image everything turns the other way round, so a controller that turns an object
    about z turns it about -z there. The object's own image is taken in the xz plane of its body;
    shapes that are equal to it (`dexctl.sim.shapes.Shape.is_mirrored`) are the same object there.

    Attributes:
        matrix: orthogonal, ``(3, 3)``; its determinant is 1 for a turn and -1 for a mirror image.
        fingers: finger i comes to where finger ``fingers[i]`` is, ``(m,)``.
        joints: joint j's value becomes that of joint ``joints[j]``, ``(d,)``, ...
        signs: ... times 1 or -1, ``(d,)``.
    """

    matrix: Floats
    fingers: NDArray[np.intp]
    joints: NDArray[np.intp]
    signs: Floats

    def __post_init__(self) -> None:
        for values in (self.matrix, self.fingers, self.joints, self.signs):
            values.flags.writeable = False  # kept for whoever asks next

    @cached_property
    def mirrors(self) -> bool:
        """Whether it is a mirror image."""
        return bool(np.linalg.det(self.matrix) < 0)

    @cached_property
    def inverse(self) -> HandSymmetry:
        """What undoes it."""
        back = np.argsort(self.joints)
        return HandSymmetry(self.matrix.T, np.argsort(self.fingers), back, self.signs[back])

    @cached_property
    def _quaternion(self) -> Floats:
        """Of the turn, which of a mirror image is what comes behind the object's own one."""
        return _quaternion(self.matrix @ _MIRROR if self.mirrors else self.matrix)

    def of_joints(self, values: Floats) -> Floats:
        """Joint positions, set-points or their changes ``(..., d)``, turned."""
        found = np.empty_like(values)
        found[..., self.joints] = self.signs * values
        return found

    def of_fingers(self, values: np.ndarray) -> np.ndarray:
        """What there is one of for each finger, ``(..., m)``, turned."""
        found = np.empty_like(values)
        found[..., self.fingers] = values
        return found

    def of_vectors(self, values: Floats) -> Floats:
        """Vectors or points of the hand frame ``(..., 3)``, turned."""
        return values @ self.matrix.T

    def of_turnings(self, values: Floats) -> Floats:
        """Angular velocities, rotation vectors or axes to turn about ``(..., 3)``, turned."""
        return -self.of_vectors(values) if self.mirrors else self.of_vectors(values)

    def of_points(self, values: Floats) -> Floats:
        """A vector or point for each finger, ``(..., m, 3)``, turned."""
        found = np.empty_like(values)
        found[..., self.fingers, :] = self.of_vectors(values)
        return found

    def of_orientations(self, values: Floats) -> Floats:
        """Orientations of an object, wxyz ``(..., 4)``, turned."""
        if self.mirrors:
            values = values * np.array([1.0, -1.0, 1.0, -1.0])  # between two images in its xz plane
        return multiply(np.broadcast_to(self._quaternion, values.shape), values)

    def of_state(self, state: GraspState) -> GraspState:
        """The state in which the same happens, turned."""
        turned = {
            "q": self.of_joints(state.q),
            "q_target": self.of_joints(state.q_target),
            "in_contact": self.of_fingers(state.in_contact),
            "contact_position": self.of_points(state.contact_position),
            "contact_normal": self.of_points(state.contact_normal),
            "contact_force": self.of_fingers(state.contact_force),
        }
        for names, turn in (
            (("object_position", "gravity"), self.of_vectors),
            (("goal_angular_velocity",), self.of_turnings),
            (("object_quaternion", "goal_quaternion"), self.of_orientations),
        ):
            for name in names:
                value = getattr(state, name)
                if value is not None:
                    turned[name] = turn(value)
        return replace(state, **turned)


def symmetries(hand: HandModel) -> tuple[HandSymmetry, ...]:
    """All that bring the hand to itself: the identity, then other turns, then mirror images.

    Every way to place the fingers is tried, with every choice of which joints of a finger change
    their sign; it is one where an orthogonal matrix (by least squares; Kabsch 1976) takes the
    fingertips of random configurations to those of the configurations that belong to them, and the
    joints' limits go along. Hands whose fingers share joints, have different numbers of them, or
    are more than six have the identity only. What was found for a hand is kept as long as the hand.
    """
    found = _known.get(hand)
    if found is None:
        found = _known[hand] = _search(hand)
    return found


def _search(hand: HandModel) -> tuple[HandSymmetry, ...]:
    """The symmetries of a hand; see `symmetries`, which keeps them."""
    joints = hand.finger_joints
    m, n = joints.shape
    own = hand.moves.sum(axis=1)
    identity = HandSymmetry(np.eye(3), np.arange(m), np.arange(hand.nq), np.ones(hand.nq))
    if hand.shares_joints or (own != n).any() or m > _MOST_FINGERS:
        return (identity,)
    limits = np.clip([hand.lower, hand.upper], -_FAR, _FAR)
    q = random_configurations(hand, _SAMPLES, 0)
    tips = hand.fingertip_positions(q)
    found = []
    for order in permutations(range(m)):
        fingers = np.array(order)
        for chosen in product((1.0, -1.0), repeat=n):
            places, signs = np.empty(hand.nq, np.intp), np.empty(hand.nq)
            places[joints] = joints[fingers]
            signs[joints] = chosen
            one = HandSymmetry(identity.matrix, fingers, places, signs)
            if not _limits_fit(limits, one):
                continue
            there = hand.fingertip_positions(one.of_joints(q))[:, fingers]
            for matrix in _nearest(tips.reshape(-1, 3), there.reshape(-1, 3)):
                if np.abs(tips @ matrix.T - there).max() < _TOLERANCE:
                    found.append(replace(one, matrix=matrix))
                    break
    # the identity comes with the first order; what else leaves every fingertip in place is none
    others = [one for one in found if (one.fingers != identity.fingers).any()]
    return (identity, *sorted(others, key=lambda one: one.mirrors))


def turned_to(hand: HandModel, axis: Floats, wanted: Floats) -> HandSymmetry | None:
    """The symmetry that makes of turning about ``axis`` turning about ``wanted``; None: no such.

    Args:
        hand: the hand.
        axis, wanted: unit vectors ``(3,)`` of the hand frame.
    """
    for one in symmetries(hand):
        if np.abs(one.of_turnings(axis) - wanted).max() < _TOLERANCE:
            return one
    return None


def _limits_fit(limits: Floats, one: HandSymmetry) -> bool:
    """Whether joints' limits ``(2, d)``, lower and upper, go along."""
    there = np.sort([one.of_joints(end) for end in limits], axis=0)
    return bool(np.abs(there - limits).max() < _TOLERANCE)


def _nearest(points: Floats, there: Floats) -> tuple[Floats, Floats]:
    """The turn and the mirror image ``(3, 3)`` that take points ``(k, 3)`` nearest to others."""
    left, _, right = np.linalg.svd(there.T @ points)
    one, other = left @ right, left @ np.diag([1.0, 1.0, -1.0]) @ right
    return (one, other) if np.linalg.det(one) > 0 else (other, one)


def _quaternion(rotation: Floats) -> Floats:
    """Wxyz ``(4,)``, w >= 0 (as the eigenvector of Bar-Itzhack 2000, sound for every angle)."""
    m = rotation
    k = np.array(
        [
            [m.trace(), m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [0.0, 2 * m[0, 0] - m.trace(), m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]],
            [0.0, 0.0, 2 * m[1, 1] - m.trace(), m[1, 2] + m[2, 1]],
            [0.0, 0.0, 0.0, 2 * m[2, 2] - m.trace()],
        ]
    )
    found = np.linalg.eigh(k, UPLO="U")[1][:, -1]
    return found if found[0] >= 0 else -found
