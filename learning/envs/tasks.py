"""TaskConfig: what hands are to do with their objects, and how they are to hold them."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import numpy as np

from dexctl.exceptions import InvalidInput
from dexctl.settings import NESTED, Vector
from dexctl.validation import check_name
from learning.envs.goals import GOALS
from learning.envs.holding import HoldingConfig
from learning.envs.observation import ORIENTATIONS, TURNING
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

    MOVED: ClassVar[Mapping[str, str]] = {
        f"turning.{name}": f"holding.{name}"
        for name in ("end_on_links", "drop_cost", "drift_cost", "links_cost")
    }
    """They counted for turning alone once."""
    goals: Literal["none", "root", "yaw", "cube", "uniform"] = "none"
    """Orientations that the object is to be brought to, each drawn when the one before is reached:
    root, that of the settled grasp; yaw, that turned about the axis; cube, the 24 in which a cube
    looks as it does there; uniform, any. none: it is turned about the axis, without end."""
    holding: Annotated[HoldingConfig, NESTED] = HoldingConfig()
    turning: Annotated[TurningConfig, NESTED] = TurningConfig()
    reorientation: Annotated[ReorientationConfig, NESTED] = ReorientationConfig()

    def __post_init__(self) -> None:
        check_name("goals", self.goals, (NO_GOALS, *GOALS))

    @property
    def axis(self) -> Vector:
        """That the object is turned about, as given."""
        return self.turning.axis

    @property
    def direction(self) -> tuple[float, float, float]:
        """``axis`` as a unit vector."""
        return self.turning.direction

    @property
    def tells(self) -> tuple[str, ...]:
        """Parts of an observation, each of which tells what is wanted; () where that is one."""
        if self.goals == NO_GOALS:
            return (TURNING,) if self.turning.commands else ()
        return () if self.goals == "root" else ORIENTATIONS

    def check_told(self, parts: Collection[str], what: str = "parts is") -> None:
        """Raise InvalidInput where none of ``parts``, introduced so, tells what is wanted."""
        if not self.tells or set(self.tells) & set(parts):
            return
        turning = self.goals == NO_GOALS
        commands = ", ".join(self.turning.commands)
        why = f"commands is {commands}" if turning else f"goals is {self.goals!r}"
        raise InvalidInput(
            f"{why}, and {what} {', '.join(parts) or 'nothing'}, which does not tell what is "
            f"wanted; expected {' or '.join(self.tells)} among them"
        )

    def check_needed(self, parts: Collection[str], who: str) -> None:
        """Raise InvalidInput where ``who`` observes by ``parts`` what this task does not tell."""
        if set(parts) & set(ORIENTATIONS) and self.goals == NO_GOALS:
            raise InvalidInput(
                f"goals is 'none', and {who} is for goals; expected {', '.join(GOALS)}"
            )
        if TURNING in parts and not (self.goals == NO_GOALS and self.turning.commands):
            said = "commands is none" if self.goals == NO_GOALS else f"goals is {self.goals!r}"
            raise InvalidInput(
                f"{said}, and {who} is told what to turn about; expected goals 'none' and commands "
                "such as x,-z"
            )

    def check_starts(self, elsewhere: bool) -> None:
        """Raise InvalidInput where episodes begin where they are to come to.

        Args:
            elsewhere: whether they begin anywhere else than in the settled grasp.
        """
        if self.goals == "root" and not elsewhere:
            raise InvalidInput(
                "goals is 'root', which is the settled grasp, and there episodes begin; expected "
                "initial_states, or in a training start_from grasps, paths or explored"
            )

    def build(self, simulation: Simulation) -> Task:
        """The task in these environments."""
        if self.goals == NO_GOALS:
            return Turning(self.turning, simulation, self.holding)
        return Reorientation(
            self.reorientation,
            self.goals,
            simulation,
            axis=np.array(self.direction),
            holding=self.holding,
        )
