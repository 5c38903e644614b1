"""The grasp kernel: contact models, grasp map, stability QP, closure, quality, checks."""

from dexctl.grasp.contacts import grasp_map, hand_jacobian, tangent_basis
from dexctl.grasp.stability import StabilitySolution, stability_forces

__all__ = [
    "StabilitySolution",
    "grasp_map",
    "hand_jacobian",
    "stability_forces",
    "tangent_basis",
]
