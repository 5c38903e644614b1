"""Contact switching: one finger lets go of the object and touches it again elsewhere."""

from dexctl.switch.controller import ContactSwitch, ContactSwitchConfig
from dexctl.switch.finger_ik import FingerIK, IKResult
from dexctl.switch.guarded import GuardedSwitch, GuardedSwitchConfig, Phase
from dexctl.switch.planner import SwingPlan, SwingPlanner
from dexctl.switch.profile import SwitchProfile

__all__ = [
    "ContactSwitch",
    "ContactSwitchConfig",
    "FingerIK",
    "GuardedSwitch",
    "GuardedSwitchConfig",
    "IKResult",
    "Phase",
    "SwingPlan",
    "SwingPlanner",
    "SwitchProfile",
]
