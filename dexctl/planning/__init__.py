"""Planning in the space of grasps: trees of grasps, and three ways to grow them."""

from dexctl.planning.bounds import Bounds
from dexctl.planning.cluster import grow_on_cluster
from dexctl.planning.contacts import Clearance, link_clearance
from dexctl.planning.expansion import Expander, Expansion, Offspring, Problem
from dexctl.planning.followed import FollowedEdges
from dexctl.planning.following import PlannedGait
from dexctl.planning.following_config import PlannedGaitChanges, PlannedGaitConfig
from dexctl.planning.goals import GoalOrientations
from dexctl.planning.grow import Progress, grow
from dexctl.planning.header import TreeHeader
from dexctl.planning.holding import holding
from dexctl.planning.kinematic import Kinematic
from dexctl.planning.macros import ControllerMacros
from dexctl.planning.metric import Metric
from dexctl.planning.nodes import Frame, Nodes
from dexctl.planning.processes import grow_in_processes
from dexctl.planning.random_actions import RandomActions
from dexctl.planning.route import Route
from dexctl.planning.sampling import GraspSampling, SampledGrasps, sample_grasps
from dexctl.planning.stability import Stability
from dexctl.planning.starts import path_states
from dexctl.planning.tree import Tree

__all__ = [
    "Bounds",
    "Clearance",
    "ControllerMacros",
    "Expander",
    "Expansion",
    "FollowedEdges",
    "Frame",
    "GoalOrientations",
    "GraspSampling",
    "Kinematic",
    "Metric",
    "Nodes",
    "Offspring",
    "PlannedGait",
    "PlannedGaitChanges",
    "PlannedGaitConfig",
    "Problem",
    "Progress",
    "RandomActions",
    "Route",
    "SampledGrasps",
    "Stability",
    "Tree",
    "TreeHeader",
    "grow",
    "grow_in_processes",
    "grow_on_cluster",
    "holding",
    "link_clearance",
    "path_states",
    "sample_grasps",
]
