"""FingerGaiting: the gait of the thesis, with a finger switched at random."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from dexctl.controller import Controller, check_action, check_sound, check_state
from dexctl.hand import HandModel
from dexctl.igm import InGraspManipulation, InGraspManipulationConfig, Share
from dexctl.state import Floats, GraspState
from dexctl.switch.profile import SwitchProfile
from dexctl.validation import check_kind, check_numbers, with_changes


@dataclass(frozen=True, kw_only=True)
class FingerGaitingConfig:
    """Settings of `FingerGaiting`."""

    in_grasp: InGraspManipulationConfig = field(default_factory=InGraspManipulationConfig.thesis)
    """Of in-grasp manipulation; the thesis's by default."""
    duration: float = 1.0
    """Of one switch [s]; the thesis's H is duration / control_period (not published)."""
    speed: tuple[float, float] = (0.1, 0.4)
    """Joint speeds of a switch are drawn between these [rad/s]."""

    def __post_init__(self) -> None:
        check_kind(self, in_grasp=InGraspManipulationConfig)
        check_numbers(self, positive=("duration",))

    def about(self, axis: object) -> FingerGaitingConfig:
        """The same with the rotation about ``axis`` ``(3,)``, of any length, at the same speed."""
        return replace(self, in_grasp=self.in_grasp.about(axis))


class FingerGaitingChanges(TypedDict, total=False):
    """`FingerGaitingConfig`'s fields as keywords, for type checkers."""

    in_grasp: InGraspManipulationConfig
    duration: float
    speed: tuple[float, float]


class FingerGaiting(Controller):
    """psi_FG = psi_IGM + psi_CS (thesis chapter 4): one random finger after the other switches.

    The finger that switches follows a fixed velocity profile; in-grasp manipulation turns the
    object with the others. Nothing coordinates the two, so it gets no further than in-grasp
    manipulation does and may drop the object: it is a prior for learning, not a way to turn things
    (`CoordinatedGait` is).

    Args:
        hand: the hand; every finger needs three joints of its own.
        config: the settings; keyword arguments change single ones.
        control_period: [s].
        axis: about which the object is to be turned, ``(3,)``, at the speed of the settings; None
            keeps their axis.
    """

    def __init__(
        self,
        hand: HandModel,
        config: FingerGaitingConfig | None = None,
        *,
        control_period: float = 0.05,
        axis: ArrayLike | None = None,
        **changes: Unpack[FingerGaitingChanges],
    ) -> None:
        super().__init__(hand, control_period=control_period)
        self.config = with_changes(FingerGaitingConfig, config, changes, axis)
        self.in_grasp = InGraspManipulation(
            hand, self.config.in_grasp, control_period=control_period
        )
        spin = np.array(self.config.in_grasp.twist[3:])
        self.profile = SwitchProfile(
            hand,
            duration=self.config.duration,
            speed=self.config.speed,
            axis=spin if spin.any() else (0.0, 0.0, 1.0),
            control_period=control_period,
        )

    def reset(self, seed: ArrayLike | None = None, mask: ArrayLike | None = None) -> None:
        self.in_grasp.reset(seed, mask)
        self.profile.reset(seed, mask)

    def state_dict(self) -> dict[str, Any]:
        return self._signed(in_grasp=self.in_grasp.state_dict(), profile=self.profile.state_dict())

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        parts = self._parts(saved, "in_grasp", "profile")
        self.in_grasp.load_state_dict(parts["in_grasp"])
        self.profile.load_state_dict(parts["profile"])

    def act(self, state: GraspState) -> Floats:
        check_state(self.hand, state)
        check_sound(self.hand, state)
        self.profile.begin(state)
        switching, finger = self.profile.switching, self.profile.finger
        moved = self.profile.act(state)
        held = self.in_grasp.command(state, Share(released=switching))
        self._diagnostics = {
            **self.in_grasp.diagnostics,
            "finger": finger,
            "in_grasp_action": held,
            "switch_action": moved,
        }
        return check_action(held + moved)
