"""Settings of contact switching."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TypedDict

from dexctl.exceptions import InvalidInput
from dexctl.validation import check_kind, check_numbers, shown, unit_axis

PATHS = ("jacobian", "planned")
KINDS = ("profile", "guarded")


@dataclass(frozen=True, kw_only=True)
class GuardedSwitchConfig:
    """Settings of `GuardedSwitch`; speeds are per second."""

    path: str = "jacobian"
    """"jacobian" follows the path with the finger's Jacobian; "planned" optimises the swing first
    (`SwingPlanner`) and falls back where no plan is feasible."""
    unload_time: float = 0.3
    """Over which the finger's share of the grip goes to zero [s]."""
    yield_rate: float = 10.0
    """At which an unloading finger's set-point goes back to the finger [1/s]."""
    unloaded_force: float = 0.2
    """Normal force below which the finger may lift [N]."""
    clearance: float = 0.018
    """Distance of the tip from the touched surface while it is carried [m]."""
    lift_speed: float = 0.15
    """Of the fingertip while it lifts [m/s]."""
    carry_speed: float = 0.2
    """Of the fingertip while it is carried [m/s]."""
    place_speed: float = 0.06
    """Of the fingertip while it comes down [m/s]."""
    place_depth: float = 0.03
    """How far beyond the expected surface to look for touch [m]."""
    touch_force: float = 0.05
    """Normal force that counts as touch while placing [N]."""
    load_time: float = 0.2
    """Over which the finger's share of the grip comes back [s]."""
    time_limit: float = 2.0
    """A phase that takes longer gives up [s]; see `GuardedSwitch`."""
    far_distance: float = 0.12
    """A tip that has to go further than this is carried along joint angles from inverse kinematics
    (`FingerIK`) instead of the Jacobian [m]."""
    damping: float = 0.01
    """Of the finger's damped least-squares inverse [m]."""

    def __post_init__(self) -> None:
        if not isinstance(self.path, str) or self.path not in PATHS:
            raise InvalidInput(f"path is {shown(self.path)}; expected one of {', '.join(PATHS)}")
        check_numbers(
            self,
            positive=(
                "unload_time",
                "yield_rate",
                "clearance",
                "lift_speed",
                "carry_speed",
                "place_speed",
                "load_time",
                "time_limit",
                "far_distance",
                "damping",
            ),
            not_negative=("unloaded_force", "place_depth", "touch_force"),
        )
        if self.time_limit <= self.unload_time:
            raise InvalidInput(
                f"time_limit is {self.time_limit} s; expected more than unload_time, "
                f"{self.unload_time} s, or no finger ever lifts"
            )


@dataclass(frozen=True, kw_only=True)
class ContactSwitchConfig:
    """Settings of `ContactSwitch`."""

    kind: str = "profile"
    """"profile" is the thesis's fixed trajectory of joint speeds; "guarded" unloads, lifts, places
    and loads in Cartesian space, and only where the others can hold."""
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Of the object's rotation; fingers are moved against it."""
    duration: float = 1.0
    """Of the profile [s]; see `SwitchProfile`."""
    speed: tuple[float, float] = (0.1, 0.4)
    """Least and greatest joint speed of the profile [rad/s]."""
    switch: GuardedSwitchConfig = field(default_factory=GuardedSwitchConfig)
    """Settings of the guarded switch."""
    swing: float = 0.4
    """How far a guarded switch carries a finger about the axis [rad]."""
    pause: float = 0.5
    """Between two guarded switches [s]."""
    friction: float = 0.8
    """Assumed by the force-closure guard."""
    hold_force: float = 1.5
    """Normal force to which a placed finger is loaded [N]."""
    stability_gain: float = 0.025
    """Set-point speed per force error while loading [m/(N s)]."""
    max_joint_speed: float = 2.0
    """Guarded set-points move at most this fast [rad/s]."""
    max_lead: float = 0.25
    """Guarded set-points stay this close to the measured joints [rad]."""

    def __post_init__(self) -> None:
        if not isinstance(self.kind, str) or self.kind not in KINDS:
            raise InvalidInput(f"kind is {shown(self.kind)}; expected one of {', '.join(KINDS)}")
        check_numbers(
            self,
            positive=(
                "duration",
                "friction",
                "hold_force",
                "stability_gain",
                "max_joint_speed",
                "max_lead",
            ),
            not_negative=("swing", "pause"),
        )
        check_kind(self, switch=GuardedSwitchConfig)
        unit_axis(self.axis)

    def about(self, axis: object) -> ContactSwitchConfig:
        """The same for an object that turns about ``axis`` ``(3,)``, of any length."""
        return replace(self, axis=unit_axis(axis))


class ContactSwitchChanges(TypedDict, total=False):
    """`ContactSwitchConfig`'s fields but `axis`, the constructor's, as keywords for checkers."""

    kind: str
    duration: float
    speed: tuple[float, float]
    switch: GuardedSwitchConfig
    swing: float
    pause: float
    friction: float
    hold_force: float
    stability_gain: float
    max_joint_speed: float
    max_lead: float
