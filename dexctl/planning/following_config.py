"""Settings of the planned gait."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypedDict

from dexctl.gait import CoordinatedGaitConfig, MacroConfig
from dexctl.hand import HandModel
from dexctl.validation import check_kind, check_numbers


@dataclass(frozen=True, kw_only=True)
class PlannedGaitConfig:
    """Settings of `PlannedGait`."""

    macro: MacroConfig = field(default_factory=MacroConfig)
    """Of in-grasp manipulation and the guarded switch; its twist is not read."""
    rotation: float = 6.283185307179586
    """Paths of the tree count that get so far [rad]; or as far as any where none does."""
    speed: float = 0.35
    """Greatest speed of the rotation [rad/s]."""
    gain: float = 2.0
    """Speed of the rotation for each radian that is left to the next grasp [1/s]."""
    tolerance: float = 0.04
    """The object is there when it is nearer than this [rad]."""
    time_limit: float = 4.0
    """An edge that takes longer is over, wherever the object is [s]."""
    astray: float = 0.8
    """A grasp further than this from where an edge should have led, by the tree's metric, goes on
    from the nearest node."""
    misplaced: float = 0.02
    """Where a hand goes on from another node, fingers further than this from their places there,
    on the object, are put there first [m]."""

    def __post_init__(self) -> None:
        check_kind(self, macro=MacroConfig)
        check_numbers(
            self,
            positive=("rotation", "speed", "gain", "tolerance", "time_limit", "misplaced"),
            not_negative=("astray",),
        )

    @classmethod
    def suiting(cls, hand: HandModel) -> PlannedGaitConfig:
        """With the grip and the switches that suit the hand in a coordinated gait."""
        gait = CoordinatedGaitConfig.suiting(hand)
        return cls(macro=MacroConfig(in_grasp=gait.in_grasp, switch=gait.switch))


class PlannedGaitChanges(TypedDict, total=False):
    """`PlannedGaitConfig`'s fields as keywords, for type checkers."""

    macro: MacroConfig
    rotation: float
    speed: float
    gain: float
    tolerance: float
    time_limit: float
    astray: float
    misplaced: float
