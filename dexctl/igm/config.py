"""Settings of in-grasp manipulation."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, TypedDict, Unpack

import numpy as np

from dexctl.exceptions import InvalidInput
from dexctl.hand import HandModel
from dexctl.validation import (
    check_kind,
    check_numbers,
    check_settings,
    check_twist,
    shown,
    unit_axis,
)

ENGINES = ("auto", "compiled", "plain")
SLIP_SHARE = 0.3
"""Last share of `slip_limit` over which the motion slows down."""


@dataclass(frozen=True, kw_only=True)
class InGraspManipulationConfig:
    """Settings of `InGraspManipulation`; speeds are per second."""

    twist: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.4)
    """Wanted object velocity (linear [m/s], angular [rad/s]), world frame; the thesis's Delta o
    over the control period."""
    grip_force: float = 2.5
    """Normal force of the finger that presses hardest [N]; scales the QP's result."""
    stability_gain: float = 0.025
    """Set-point speed per force error (alpha of eq. dqstab) [m/(N s)]."""
    regulariser: float = 1e-3
    """Rho of the QP; pulls all forces towards the largest one."""
    min_force: float = 0.5
    """Least force of a holding finger, as a fraction of `grip_force`. It must be well above the
    force from which the hand's sensors count a touch (1 N on the thesis's): a finger that is asked
    for less falls out of touch, and its share to the others."""
    friction: float = 0.3
    """How far a finger may push aside from the normal, towards the object's centre, as a friction
    coefficient; forces through the centre balance where normals do not. It must stay well below
    the real one. 0: along the normal only."""
    length: float | None = None
    """Torques are divided by it in the QP [m]; None: mean contact distance."""
    damping: float = 0.005
    """Of the least-squares inverse [m]."""
    height_gain: float = 1.0
    """Pulls the object back, along the axis of rotation, to where it was at the first call after
    a reset, moved by what was wanted since [1/s]."""
    centring_gain: float = 1.0
    """Pulls it back across the axis [1/s]."""
    tilt_gain: float = 1.0
    """Turns the object's axis back to where it was then [1/s]."""
    odometry: bool = True
    """Where nothing tracks the object, its pose is summed up from the motion of the fingers that
    hold it (`dexctl.grasp.odometry.ContactOdometry`); else the contacts' centroid stands for it."""
    closing_speed: float = 0.03
    """Fingers out of touch move towards the object at this speed [m/s]."""
    closing_lead: float = 0.006
    """Until their set-points are so far ahead of them [m]: what stops such a finger (the object at
    its link, another finger) is pressed no harder than its servos press over that way. It must be
    enough for a touch to be felt."""
    reach_distance: float = 0.01
    """The wanted motion slows down over the last so much of the way that some finger has along it,
    and stops at its end: a joint's limit, a posture in which it cannot go on, a contact that has
    rolled to its link [m]. What turns round goes back at full speed. 0: it goes on regardless."""
    reach_margin: float = 0.01
    """It stops so far before joint limits and singular postures [m]."""
    link_limit: float = 0.2
    """And where the contact normal leans towards the fingertip's link by so much, as the cosine of
    the angle between the two: at 0 the link is parallel to the surface."""
    slip_limit: float = 0.7
    """And where turning takes up so much of friction, as a coefficient: what the fingers push along
    the turn over what they press with, as their set-points are ahead of them. It slows down over
    the last `SLIP_SHARE` of that. It must stay below the real coefficient, and above what friction
    in the gears and latency take up by themselves. 0: it does not count."""
    max_joint_speed: float = 2.0
    """Set-points move at most this fast [rad/s]."""
    max_lead: float = 0.25
    """Set-points stay this close to the measured joints [rad]."""
    engine: str = "auto"
    """"compiled" takes the compiled step (numba, extra `fast`; not for hands whose fingers share
    joints, nor for a regulariser of zero), "plain" the numpy one; "auto" takes the compiled one
    where it can be had. Both give the same numbers."""

    def __post_init__(self) -> None:
        check_twist(self.twist)
        check_numbers(
            self,
            positive=("grip_force", "damping", "closing_lead", "max_joint_speed", "max_lead"),
            not_negative=(
                "stability_gain",
                "regulariser",
                "friction",
                "height_gain",
                "centring_gain",
                "tilt_gain",
                "closing_speed",
                "reach_distance",
                "reach_margin",
                "slip_limit",
            ),
            fractions=("min_force",),
        )
        check_kind(self, odometry=bool)
        if not (isinstance(self.link_limit, (int, float)) and -1 <= self.link_limit <= 1):
            raise InvalidInput(f"link_limit is {self.link_limit!r}; expected a number from -1 to 1")
        if self.length is not None:
            check_numbers(self, positive=("length",))
        if self.regulariser and self.regulariser < 1e-6:
            raise InvalidInput(f"regulariser is {self.regulariser}; expected 0, or 1e-6 and more")
        if not isinstance(self.engine, str) or self.engine not in ENGINES:
            raise InvalidInput(
                f"engine is {shown(self.engine)}; expected one of {', '.join(ENGINES)}"
            )

    @classmethod
    def suiting(cls, hand: HandModel) -> InGraspManipulationConfig:
        """What suits a hand: these defaults where five fingers hold; a slower motion and softer
        corrections where four or fewer do, since three are left at most where one slips.
        """
        return cls(**FEW) if few_fingers(hand) else cls()

    @classmethod
    def for_switching(
        cls, **changes: Unpack[InGraspManipulationChanges]
    ) -> InGraspManipulationConfig:
        """Where fingers are lifted one after the other: those left may share forces freely."""
        check_settings(cls, changes)
        return replace(cls(min_force=0.15), **changes)

    @classmethod
    def thesis(cls, **changes: Unpack[InGraspManipulationChanges]) -> InGraspManipulationConfig:
        """The controller as the thesis has it: no regulariser, no bound, nothing added."""
        check_settings(cls, changes)
        plain = cls(
            twist=(0.0, 0.0, 0.0, 0.0, 0.0, 0.45),
            regulariser=0.0,
            min_force=0.0,
            friction=0.0,
            height_gain=0.0,
            centring_gain=0.0,
            tilt_gain=0.0,
            odometry=False,
            closing_speed=0.0,
            reach_distance=0.0,
        )
        return replace(plain, **changes)

    def about(self, axis: object) -> InGraspManipulationConfig:
        """The same with the rotation about ``axis`` ``(3,)``, of any length, at the same speed."""
        speed = float(np.linalg.norm(self.twist[3:]))
        x, y, z = (speed * part for part in unit_axis(axis))
        return replace(self, twist=(*self.twist[:3], x, y, z))


# measured on the Allegro and the LEAP hand (docs/what-helped.md)
FEW: dict[str, Any] = {
    "twist": (0.0, 0.0, 0.0, 0.0, 0.0, 0.25),
    "stability_gain": 0.008,
    "closing_lead": 0.004,
}


def few_fingers(hand: HandModel) -> bool:
    """Whether three fingers at most are left where one slips or is lifted."""
    return hand.n_fingers <= 4


class InGraspManipulationChanges(TypedDict, total=False):
    """`InGraspManipulationConfig`'s fields as keywords, for type checkers."""

    twist: tuple[float, float, float, float, float, float]
    grip_force: float
    stability_gain: float
    regulariser: float
    min_force: float
    friction: float
    length: float | None
    damping: float
    height_gain: float
    centring_gain: float
    tilt_gain: float
    odometry: bool
    closing_speed: float
    closing_lead: float
    reach_distance: float
    reach_margin: float
    link_limit: float
    slip_limit: float
    max_joint_speed: float
    max_lead: float
    engine: str
