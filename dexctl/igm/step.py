"""What one in-grasp step takes and gives, whichever engine does the sums."""

from __future__ import annotations

from typing import NamedTuple

from numpy.typing import NDArray

from dexctl.configuration import HandConfiguration
from dexctl.igm.regulation import Reference
from dexctl.state import Bools, Floats


class StepInput(NamedTuple):
    """N hands at one moment; arrays have N rows.

    Attributes:
        hand_now: forward kinematics at ``q``.
        q, q_target: ``(N, d)`` [rad].
        touch: fingers that hold the object, ``(N, m)``.
        closing: fingers out of touch that may close in on it, ``(N, m)``.
        position, normal, force: contacts, read where ``touch`` only.
        object_position, object_quaternion: with no rows where nothing tracks the object.
        reference: where the objects were, for regulation.
        twist: wanted, ``(N, 6)``.
        max_force: bound on each finger's share of the grip, ``(N, m)``.
        yielding: rate at which set-points go back to their fingers, ``(N, m)`` [1/s].
    """

    hand_now: HandConfiguration
    q: Floats
    q_target: Floats
    touch: Bools
    closing: Bools
    position: Floats
    normal: Floats
    force: Floats
    object_position: Floats
    object_quaternion: Floats
    reference: Reference
    twist: Floats
    max_force: Floats
    yielding: Floats


class StepResult(NamedTuple):
    """The set-point change and what led to it; arrays have N rows.

    Attributes:
        change: ``(N, d)`` [rad].
        desired: wanted normal forces ``(N, m)`` [N].
        residual: wrench that they leave, as a share of the grip ``(N,)``.
        held: finger whose share is held at one, -1 for none ``(N,)``.
        origin: the point that stands for the object's centre ``(N, 3)`` [m].
        reach: share of the wanted twist that is left, 1 to 0 ``(N,)``.
    """

    change: Floats
    desired: Floats
    residual: Floats
    held: NDArray
    origin: Floats
    reach: Floats
