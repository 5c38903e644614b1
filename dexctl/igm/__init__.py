"""In-grasp manipulation: turns a held object without letting go of it."""

from dexctl.igm.controller import InGraspManipulation, InGraspManipulationConfig

__all__ = ["InGraspManipulation", "InGraspManipulationConfig"]
