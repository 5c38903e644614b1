"""A finger as a serial chain: which joints are its own, and in which order.

Everything here comes from :meth:`HandModel.configuration`, so it holds for any hand.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.hand import HandModel
from dexctl.state import Floats

Indices = NDArray[np.intp]


class JointRoles(NamedTuple):
    """The joint of every finger that plays each part in the switching profile, ``(m,)`` each.

    Attributes:
        roll: the finger's first own joint, counted from the base.
        middle: the last but one.
        distal: the last.
    """

    roll: Indices
    middle: Indices
    distal: Indices


def check_finger(hand: HandModel, finger: int) -> int:
    """``finger`` as an index into the hand's fingertips.

    Raises:
        UnknownName: the hand has no such finger.
    """
    if isinstance(finger, (bool, np.bool_)) or not isinstance(finger, (int, np.integer)):
        raise UnknownName("finger", finger, map(str, range(hand.n_fingers)))
    if not 0 <= finger < hand.n_fingers:
        raise UnknownName("finger", finger, map(str, range(hand.n_fingers)))
    return int(finger)


def own_joints(hand: HandModel, finger: int) -> Indices:
    """Joints that move this fingertip and no other, from base to tip, ``(k,)``."""
    finger = check_finger(hand, finger)
    own = np.flatnonzero(hand.moves[finger] & (hand.moves.sum(axis=0) == 1))
    return own[np.argsort(_depth(hand, own), kind="stable")]


def _depth(hand: HandModel, joints: Indices) -> Indices:
    """How many of ``joints`` stand before each of them on the way from the base.

    The screw of a joint moves with every joint before it, and with none after it. Joints keep
    the hand's order where they share an axis, as then they can be swapped.
    """
    bend = 0.3 + 0.1 * np.arange(hand.nq)  # a configuration in which no axes meet by chance
    bent = np.tile(bend, (len(joints) + 1, 1))
    bent[np.arange(len(joints)), joints] += 0.5
    screws = hand.configuration(bent).joint_twist[..., joints]
    moved = np.abs(screws[:-1] - screws[-1]).max(axis=1, initial=0.0) > 1e-9
    return moved.sum(axis=0)


def joint_roles(hand: HandModel) -> JointRoles:
    """The roll, middle and distal joint of every finger.

    Raises:
        InvalidInput: a finger has fewer than three joints of its own.
    """
    chains = [own_joints(hand, finger) for finger in range(hand.n_fingers)]
    for name, chain in zip(hand.fingertip_names, chains, strict=True):
        if len(chain) < 3:
            raise InvalidInput(
                f"finger {name!r} has {len(chain)} joints of its own; the switching profile "
                "moves a roll, a middle and a distal joint: it needs at least 3"
            )
    roll, middle, distal = np.array([[c[0], c[-2], c[-1]] for c in chains]).T
    return JointRoles(roll, middle, distal)


def spread(count: int, dimensions: int) -> Floats:
    """``count`` points ``(count, dimensions)`` spread evenly over the unit cube, centre first.

    A Kronecker sequence on the relatives of the golden ratio: no chance in it.
    """
    ratio = np.roots([1.0, *([0.0] * (dimensions - 1)), -1.0, -1.0]).real.max()
    stride = ratio ** -np.arange(1.0, dimensions + 1)
    return (0.5 + np.arange(count)[:, None] * stride) % 1.0
