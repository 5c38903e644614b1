"""Contact switching: one finger lets go of the object and touches it again elsewhere."""

from dexctl.switch.config import ContactSwitchChanges, ContactSwitchConfig, GuardedSwitchConfig
from dexctl.switch.controller import ContactSwitch
from dexctl.switch.finger_ik import FingerIK, IKResult
from dexctl.switch.guarded import GuardedSwitch, Phase
from dexctl.switch.planner import SwingPlan, SwingPlanner
from dexctl.switch.profile import SwitchProfile

__all__ = [
    "ContactSwitch",
    "ContactSwitchChanges",
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
