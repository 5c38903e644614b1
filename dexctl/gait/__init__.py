"""Finger gaiting: in-grasp manipulation and contact switching superposed, at random or by plan."""

from dexctl.gait.coordinated import CoordinatedGait, CoordinatedGaitConfig
from dexctl.gait.thesis import FingerGaiting, FingerGaitingConfig

__all__ = ["CoordinatedGait", "CoordinatedGaitConfig", "FingerGaiting", "FingerGaitingConfig"]
