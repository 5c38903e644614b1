"""HoldingConfig: when an object is lost, and what it costs to hold it badly, whatever is wanted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dexctl.validation import check_numbers

if TYPE_CHECKING:
    from dexctl.state import Bools, Floats
    from learning.envs.task import Step


@dataclass(frozen=True, kw_only=True)
class HoldingConfig:
    """When an object is lost, and what holding it badly costs.

    Costs are taken off the task's reward in each step, and are off by default: the thesis has none.

    Raises:
        InvalidInput: a setting is wrong; the message names it.
    """

    drop_distance: float = 0.05
    """The object is lost when its centre is this far from where it started [m]."""
    end_on_links: bool = False
    """Whether the object counts as lost where it touches anything but fingertips."""
    drop_cost: float = 0.0
    """Taken off the reward of the step in which the object is lost [rad/s]."""
    drift_cost: float = 0.0
    """Taken off for how far the object's centre is from where it started [rad/s per m]."""
    links_cost: float = 0.0
    """Taken off in every step in which the object touches anything but fingertips [rad/s]."""

    def __post_init__(self) -> None:
        check_numbers(
            self,
            positive=("drop_distance",),
            not_negative=("drop_cost", "drift_cost", "links_cost"),
        )

    def lost(self, away: Floats, step: Step) -> Bools:
        """Whose object is lost in a step that brought it ``away`` ``(N,)`` from its start [m]."""
        lost: Bools = away > self.drop_distance
        if self.end_on_links:
            lost = lost | ~step.fingertips_only
        return lost & ~step.diverged

    def charged(self, worth: Floats, *, away: Floats, lost: Bools, links: Bools) -> Floats:
        """``worth`` less all costs, ``(...)`` [rad/s].

        Args:
            worth: what the step did for the task.
            away: how far the object is from its start [m].
            lost: whose object is lost in it.
            links: whose object touches anything but fingertips.
        """
        for cost, amount in (
            (self.drop_cost, lost),
            (self.drift_cost, away),
            (self.links_cost, links),
        ):
            if cost:
                worth = worth - cost * amount
        return np.asarray(worth)


def distance_from_start(step: Step) -> Floats:
    """How far each object's centre is from where it started, ``(N,)`` [m]."""
    assert step.state.object_position is not None
    away: Floats = np.linalg.norm(step.state.object_position - step.start_position, axis=-1)
    return away
