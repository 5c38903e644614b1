"""In-grasp manipulation: turns a held object without letting go of it."""

from dexctl.igm.config import InGraspManipulationChanges, InGraspManipulationConfig
from dexctl.igm.controller import InGraspManipulation, Share
from dexctl.igm.stability import StableForces, push_directions, stable_forces

__all__ = [
    "InGraspManipulation",
    "InGraspManipulationChanges",
    "InGraspManipulationConfig",
    "Share",
    "StableForces",
    "push_directions",
    "stable_forces",
]
