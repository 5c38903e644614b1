"""The grasp kernel: contact models, grasp map, stability QP, closure, quality, stable grasps."""

from dexctl.grasp.closure import is_force_closure
from dexctl.grasp.contacts import CONTACT_MODELS, grasp_map, hand_jacobian, tangent_basis
from dexctl.grasp.forces import GraspForces, grasp_forces
from dexctl.grasp.quality import epsilon_quality, isotropy, smallest_singular_value
from dexctl.grasp.stability import StabilitySolution, stability_forces
from dexctl.grasp.stability_solver import solve_stability, solve_stability_batch
from dexctl.grasp.stable import (
    DynamicStability,
    HoldsSetPoints,
    StaticStability,
    check_stable,
    check_static,
)
from dexctl.grasp.touch_tracking import TouchTracking, TouchTrackingConfig

__all__ = [
    "CONTACT_MODELS",
    "DynamicStability",
    "GraspForces",
    "HoldsSetPoints",
    "StabilitySolution",
    "StaticStability",
    "TouchTracking",
    "TouchTrackingConfig",
    "check_stable",
    "check_static",
    "epsilon_quality",
    "grasp_forces",
    "grasp_map",
    "hand_jacobian",
    "is_force_closure",
    "isotropy",
    "smallest_singular_value",
    "solve_stability",
    "solve_stability_batch",
    "stability_forces",
    "tangent_basis",
]
