"""Curriculum: how far the scene's ranges reach in training, widened as the policy holds."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dexctl.exceptions import InvalidInput
from dexctl.settings import NamedRanges
from dexctl.sim.randomisation import WIDENED
from dexctl.validation import check_name, check_numbers, check_whole


@dataclass(frozen=True, kw_only=True)
class CurriculumConfig:
    """How the ranges of `dexctl.sim.randomisation.Randomisation` widen in training.

    The thesis (chapter 5, "Sim-to-real transfer") widens them one after the other, which
    ``level_schedule`` can say; without it all of them widen together, gravity's direction among
    them, as far as the policy keeps up.

    Raises:
        UnknownName, InvalidInput: a setting is wrong; the message names it.
    """

    level_start: float = 1.0
    """How much of the ranges is drawn from at step 0: 0, nothing, to 1, all; they then widen as
    the policy holds. 1: no curriculum."""
    level_step: float = 0.05
    """By how much the level goes up or down at a time."""
    level_schedule: NamedRanges = field(default_factory=dict)
    """From which level on a range widens and at which all of it is used, by its name:
    mass_range=0.5,1 is not drawn before the level is 0.5, and 0,0 all of it from step 0 on. What
    is not named is used as far as the level itself, as by 0,1."""
    level_steps: int = 10_000
    """Steps of the policy by itself between two judgements."""
    widen_above: float = 0.8
    """The level goes up where at least this share of episodes would hold to their end."""
    narrow_below: float = 0.2
    """It goes down, not below its start, where less than this share would."""

    def __post_init__(self) -> None:
        shares = ("level_start", "widen_above", "narrow_below")
        check_numbers(self, positive=("level_step",), fractions=shares)
        check_whole(self, level_steps=1)
        # by the words of the command line, too: mass-range
        named = {name.replace("-", "_"): part for name, part in self.level_schedule.items()}
        object.__setattr__(self, "level_schedule", named)
        for name, part in self.level_schedule.items():
            check_name("range of level_schedule", name, WIDENED)
            if not 0.0 <= part[0] <= part[1] <= 1.0:
                raise InvalidInput(
                    f"level_schedule of {name} is {part}; expected two levels from 0 to 1, the "
                    "lower one first"
                )
        if self.level_schedule and not self:
            raise InvalidInput(
                f"level_schedule is of {', '.join(self.level_schedule)} and level_start 1; "
                "expected a level_start below 1, or no level_schedule"
            )
        if self.narrow_below > self.widen_above:
            raise InvalidInput(
                f"narrow_below is {self.narrow_below} and widen_above {self.widen_above}; "
                "expected the lower one first"
            )

    def __bool__(self) -> bool:
        """Whether the level changes."""
        return self.level_start < 1.0


class Curriculum:
    """Judges how well the policy holds by itself, and how hard it shall have it.

    Episodes that hold take longer to end than those that do not, so it goes by drops a step: the
    share that would hold an episode of T steps is exp(-T drops / steps), the maximum likelihood
    where drops come at any time alike.

    Args:
        config: the settings.
        episode_steps: T, of an episode that is held.

    Attributes:
        level: of the episodes that begin from now on.
        held: share of the policy's own episodes that would hold, as last judged; None before.
    """

    def __init__(self, config: CurriculumConfig, episode_steps: int) -> None:
        self.config = config
        self.level = float(config.level_start)
        self.held: float | None = None
        self._episode_steps = episode_steps
        self._steps = self._drops = 0

    def add(self, own: np.ndarray, lost: np.ndarray) -> bool:
        """A step of N environments; whether it brought a judgement.

        Args:
            own: where the policy acts by itself, ``(N,)`` bool.
            lost: where the object was dropped, ``(N,)`` bool.
        """
        config = self.config
        self._steps += int(own.sum())
        self._drops += int((own & lost).sum())
        if self._steps < config.level_steps:
            return False
        self.held = float(np.exp(-self._episode_steps * self._drops / self._steps))
        self._steps = self._drops = 0
        if config:
            up, down = self.held >= config.widen_above, self.held < config.narrow_below
            level = self.level + config.level_step * (float(up) - float(down))
            self.level = min(max(level, config.level_start), 1.0)
        return True

    def row(self) -> dict[str, float]:
        """For the log."""
        return {"level": self.level} | ({} if self.held is None else {"held": self.held})

    def save(self) -> dict[str, Any]:
        """All that decides what is to come, to be given to `restore`."""
        return {
            "level": self.level,
            "held": self.held,
            "steps": self._steps,
            "drops": self._drops,
        }

    def restore(self, saved: dict[str, Any]) -> None:
        """Go on from what `save` returned."""
        self.level, self.held = float(saved["level"]), saved["held"]
        self._steps, self._drops = int(saved["steps"]), int(saved["drops"])
