"""Inspection: the controllers' tools turned on a policy, to see how it gaits and why it drops.

`inspect` does all of it: `roll_out` is the evaluation's rollout with controllers in shadow;
`examine` says how sound the grasp was at each moment; the other modules make figures of both.
``learning.inspection.report`` draws them.
"""

from learning.inspection.findings import Inspection, inspect
from learning.inspection.gait import GaitStatistics, gait_statistics
from learning.inspection.grasps import Grasps, examine, with_margin
from learning.inspection.onset import CAUSES, Drop, DropRule, find_drops
from learning.inspection.rollout import Rollouts, roll_out
from learning.inspection.shadow import action_angle
from learning.inspection.training import TrainingLog, read_training

__all__ = [
    "CAUSES",
    "Drop",
    "DropRule",
    "GaitStatistics",
    "Grasps",
    "Inspection",
    "Rollouts",
    "TrainingLog",
    "action_angle",
    "examine",
    "find_drops",
    "gait_statistics",
    "inspect",
    "read_training",
    "roll_out",
    "with_margin",
]
