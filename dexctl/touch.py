"""Touch without touch sensors: from joint torques, or from switches that only say yes or no.

A finger that presses with force F has torques J^T F at its joints beside those that hold its own
links, with the Jacobian J of its contact point (thesis chapter 4, eq. dqstab, in forces). So a
force follows from the torques of three joints and more; where it points to, there the contact is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dexctl.enclosing import enclosing_centre
from dexctl.exceptions import InvalidInput
from dexctl.validation import check_numbers, numbers, shown

Floats = NDArray[np.float64]  # as in dexctl.state, which stands above
Bools = NDArray[np.bool_]
MOST = 1e9  # of angles, torques, stiffness and damping of a joint, and of metres
_DAMPING = 0.005  # keeps forces finite where a finger is stretched [m]


@dataclass(frozen=True, kw_only=True)
class TouchConfig:
    """How touch is told from joint torques or switches.

    Raises:
        InvalidInput: a number that is not finite or out of range.
    """

    touch_force: float = 0.4
    """A fingertip touches from this estimated force on [N]; it must be above what gear friction,
    and the weight of the links where it is not taken off, feign."""
    release_force: float = 0.2
    """And until the force has fallen below this [N]."""
    lean: float = 0.0
    """How far the contact normal may lean with the estimated force, away from the direction to
    the object's centre (the middle of the fingertips where nothing tracks it), as a tangent.
    0: it points to the centre."""
    nominal_force: float = 1.0
    """Of a switch that is closed, where no torque is known [N]."""
    smoothing_time: float = 0.05
    """Time constant of the low-pass on torques and joint speeds [s]; 0: none."""
    weigh_links: bool = True
    """Whether what the links weigh is taken off, where their masses and gravity are known."""

    def __post_init__(self) -> None:
        check_numbers(
            self,
            positive=("touch_force", "nominal_force"),
            not_negative=("release_force", "lean", "smoothing_time"),
        )
        if not isinstance(self.weigh_links, bool):
            raise InvalidInput(f"weigh_links is {self.weigh_links!r}; expected a bool")
        if self.release_force > self.touch_force:
            raise InvalidInput(
                f"release_force is {self.release_force} N; expected at most touch_force, "
                f"{self.touch_force} N"
            )


class TouchEstimate(NamedTuple):
    """Contacts as `dexctl.GraspState` has them; rows of fingers that do not touch are zero.

    Attributes:
        in_contact: ``(..., m)`` bool.
        contact_position: ``(..., m, 3)`` [m].
        contact_normal: unit, from the fingertip into the object, ``(..., m, 3)``.
        contact_force: along the normal, ``(..., m)`` [N].
    """

    in_contact: Bools
    contact_position: Floats
    contact_normal: Floats
    contact_force: Floats


class Hand(Protocol):
    """What is needed of a `dexctl.HandModel`."""

    nq: int
    n_fingers: int
    effort: Floats
    moves: Bools
    finger_joints: NDArray[np.intp]
    config: Any

    def configuration(self, q: ArrayLike, /) -> Any:
        """Forward kinematics."""
        ...


def check_hand(hand: object) -> None:
    """Raise InvalidInput where ``hand`` has no kinematics, as a name has none."""
    if not hasattr(hand, "configuration"):
        raise InvalidInput(
            f"hand is {shown(hand)}; expected a HandModel, such as dexctl.hands.load('dex5')"
        )


def touch_config(config: object) -> TouchConfig:
    """``config``, or the defaults where it is None.

    Raises:
        InvalidInput: it is of another class.
    """
    if config is None:
        return TouchConfig()
    if not isinstance(config, TouchConfig):
        raise InvalidInput(f"config is {shown(config)}; expected a TouchConfig, or None")
    return config


def servo_torques(hand: Hand, q: Floats, q_target: Floats, stiffness: ArrayLike) -> Floats:
    """Torques ``(..., d)`` of position servos at rest, within the hand's limits [N m].

    Raises:
        InvalidInput: a stiffness that is not above 0, or of another number of joints.
    """
    stiff = per_joint(hand, "stiffness", stiffness, q.shape)
    if not (stiff > 0).all():
        raise InvalidInput(f"stiffness is {shown(stiffness)}; expected N m/rad above 0")
    return np.clip(stiff * (q_target - q), -hand.effort, hand.effort)


def estimate_touch(
    hand: Hand,
    q: Floats,
    torque: Floats | None,
    config: TouchConfig,
    *,
    in_contact: Bools | None = None,
    touched: Bools | None = None,
    object_position: Floats | None = None,
) -> TouchEstimate:
    """What the fingertips feel, from joint torques, from switches, or from both.

    Args:
        hand: the hand. Joints that move several fingers tell nothing of any one and are left out.
        q: ``(..., d)`` [rad].
        torque: what presses on the object, ``(..., d)`` [N m]; None: not known.
        config: the thresholds.
        in_contact: what switches say, ``(..., m)``; None: the force decides.
        touched: which fingers touched before, for the lower of the two thresholds ``(..., m)``.
        object_position: ``(..., 3)`` [m], where something tracks the object.
    """
    now = hand.configuration(q)
    tip = now.fingertip_position
    centre = object_position
    if centre is None:
        centre = _between(tip, touched if in_contact is None else in_contact)
    inward = _unit(centre[..., None, :] - tip)
    if torque is None:
        touch = np.zeros(tip.shape[:-1], bool) if in_contact is None else in_contact
        normal, force = inward, np.full(tip.shape[:-1], config.nominal_force)
    else:
        # friction has a moment about the tip point, which lies inside of the fingertip
        pressing = fingertip_forces(hand, now, tip + hand.config.fingertip_radius * inward, torque)
        along = (pressing * inward).sum(axis=-1)
        aside = pressing - along[..., None] * inward
        size = np.sqrt((aside * aside).sum(axis=-1))
        tangent = np.minimum(size / np.maximum(along, 1e-9), config.lean) * (along > 0)
        normal = _unit(inward + (tangent / np.maximum(size, 1e-9))[..., None] * aside)
        force = np.maximum((pressing * normal).sum(axis=-1), 0.0)
        before = False if touched is None else touched
        least = np.where(before, config.release_force, config.touch_force)
        touch = (force >= least) if in_contact is None else in_contact
    rows = touch[..., None]
    point = tip + hand.config.fingertip_radius * normal
    return TouchEstimate(
        touch,
        np.where(rows, point, 0.0),
        np.where(rows, normal, 0.0),
        np.where(touch, force, 0.0),
    )


def _between(tip: Floats, touch: Bools | None) -> Floats:
    """Middle ``(..., 3)`` of the fingertips ``(..., m, 3)`` that touch, of all where none do."""
    if touch is None:
        return enclosing_centre(tip)
    enough = touch & (touch.sum(axis=-1, keepdims=True) > 1)  # one finger alone tells nothing
    enough = enough | ~enough.any(axis=-1, keepdims=True)
    return enclosing_centre(tip, enough)


def fingertip_forces(hand: Hand, now: Any, point: Floats, torque: Floats) -> Floats:
    """Forces ``(..., m, 3)`` [N] that the fingers press with at ``point`` ``(..., m, 3)``.

    The damped least-squares solution of J^T F = torque, finger by finger, by the joints that move
    no other finger.
    """
    own = hand.moves & (hand.moves.sum(axis=0) == 1)
    mine = np.take_along_axis(own, hand.finger_joints, axis=1)
    # a filled-up place repeats joint 0; it has no row in the Jacobian
    jacobian = now.finger_jacobian(point) * mine[..., None]
    gram = jacobian.swapaxes(-1, -2) @ jacobian + _DAMPING**2 * np.eye(3)
    right = jacobian.swapaxes(-1, -2) @ torque[..., hand.finger_joints][..., None]
    return np.linalg.solve(gram, right)[..., 0]


def per_joint(
    hand: Hand, name: str, value: ArrayLike, shape: tuple[int, ...] | None = None
) -> Floats:
    """``value`` for each joint, of ``shape`` ``(..., d)``; None: ``(d,)``.

    One number is for all joints, ``(d,)`` for all hands.

    Raises:
        InvalidInput: it is not finite, over `MOST`, or of another number of joints or of hands.
    """
    shape = (hand.nq,) if shape is None else shape
    expected = f"finite numbers, one or (..., {hand.nq}), of at most {MOST:.0e}"
    array = numbers(name, value, expected)
    if array.shape[-1:] not in ((), (hand.nq,)) or not (np.abs(array) <= MOST).all():
        raise InvalidInput(f"{name} is {shown(value)}; expected {expected}")
    if array.shape not in ((), (hand.nq,), shape):
        raise InvalidInput(f"{name} has shape {array.shape}; expected {shape}")
    return np.broadcast_to(array, shape)


def _unit(vector: Floats) -> Floats:
    length = np.sqrt((vector * vector).sum(axis=-1, keepdims=True))
    return vector / np.maximum(length, 1e-12)
