"""TaskConfig: what hands are to do with their objects, and when one is lost."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np

from dexctl.settings import NESTED, Vector
from dexctl.validation import check_name, check_numbers
from learning.envs.goals import GOALS
from learning.envs.reorientation import Reorientation, ReorientationConfig
from learning.envs.turning import Turning, TurningConfig

if TYPE_CHECKING:
    from dexctl.sim import Simulation
    from learning.envs.task import Task

NO_GOALS = "none"


@dataclass(frozen=True, kw_only=True)
class TaskConfig:
    """What hands are to do: turn an object about an axis, or bring it to goal orientations.

    Raises:
        UnknownName, InvalidInput: a setting is wrong; the message names it.
    """

    goals: Literal["none", "root", "yaw", "cube", "uniform"] = "none"
    """Orientations that the object is to be brought to, each drawn when the one before is reached:
    root, that of the settled grasp; yaw, that turned about the axis; cube, the 24 in which a cube
    looks as it does there; uniform, any. none: it is turned about the axis, without end."""
    drop_distance: float = 0.05
    """The object is lost when its centre is this far from where it started [m]."""
    turning: Annotated[TurningConfig, NESTED] = TurningConfig()
    reorientation: Annotated[ReorientationConfig, NESTED] = ReorientationConfig()

    def __post_init__(self) -> None:
        check_name("goals", self.goals, (NO_GOALS, *GOALS))
        check_numbers(self, positive=("drop_distance",))

    @property
    def axis(self) -> Vector:
        """That the object is turned about, as given."""
        return self.turning.axis

    @property
    def direction(self) -> tuple[float, float, float]:
        """``axis`` as a unit vector."""
        return self.turning.direction

    def build(self, simulation: Simulation) -> Task:
        """The task in these environments."""
        if self.goals == NO_GOALS:
            return Turning(self.turning, simulation, self.drop_distance)
        return Reorientation(
            self.reorientation,
            self.goals,
            simulation,
            axis=np.array(self.direction),
            drop_distance=self.drop_distance,
        )
