"""Finger gaiting: in-grasp manipulation and contact switching superposed, at random or by plan."""

from dexctl.gait.commanded import CommandedTurning
from dexctl.gait.coordinated import CoordinatedGait, CoordinatedGaitChanges, CoordinatedGaitConfig
from dexctl.gait.goal import GoalGait, GoalGaitChanges, GoalGaitConfig
from dexctl.gait.macro import Macro, MacroConfig
from dexctl.gait.pursuit import GoalPursuit, GoalPursuitChanges, GoalPursuitConfig
from dexctl.gait.regulated import (
    RegulatedTurning,
    RegulatedTurningChanges,
    RegulatedTurningConfig,
)
from dexctl.gait.sequence import GoalSequence, GoalSequenceChanges, GoalSequenceConfig
from dexctl.gait.steering import GoalSteering, GoalSteeringChanges, GoalSteeringConfig
from dexctl.gait.thesis import FingerGaiting, FingerGaitingChanges, FingerGaitingConfig
from dexctl.gait.tracked import TrackedByTouch

__all__ = [
    "CommandedTurning",
    "CoordinatedGait",
    "CoordinatedGaitChanges",
    "CoordinatedGaitConfig",
    "FingerGaiting",
    "FingerGaitingChanges",
    "FingerGaitingConfig",
    "GoalGait",
    "GoalGaitChanges",
    "GoalGaitConfig",
    "GoalPursuit",
    "GoalPursuitChanges",
    "GoalPursuitConfig",
    "GoalSequence",
    "GoalSequenceChanges",
    "GoalSequenceConfig",
    "GoalSteering",
    "GoalSteeringChanges",
    "GoalSteeringConfig",
    "Macro",
    "MacroConfig",
    "RegulatedTurning",
    "RegulatedTurningChanges",
    "RegulatedTurningConfig",
    "TrackedByTouch",
]
