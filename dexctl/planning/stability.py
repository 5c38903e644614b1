"""Stability: when a grasp counts as one that holds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from dexctl.exceptions import InvalidInput
from dexctl.grasp import DynamicStability, check_stable
from dexctl.state import Bools
from dexctl.validation import check_numbers, check_whole

if TYPE_CHECKING:
    from dexctl.sim import BatchSimulator


@dataclass(frozen=True, kw_only=True)
class Stability:
    """The check of a new grasp: its set-points are held for a while (thesis chapter 5, Stable).

    The thesis asks only that the object is not dropped; that lets grasps pass which are about to
    fall (with a grip of 0.15 N, nearly nine of ten). The defaults ask that nothing moves much and
    that three fingertips hold, and nothing else.
    """

    seconds: float = 0.5
    """How long the set-points are held [s]."""
    max_distance: float = 0.005
    """How far the object may move meanwhile [m]."""
    max_rotation: float | None = 0.1
    """How far it may turn or tilt meanwhile [rad]; none: as far as it will."""
    min_contacts: int = 3
    """Fewest fingertips that touch it at the end."""
    fingertips_only: bool = True
    """Whether it may touch nothing but fingertips."""

    def __post_init__(self) -> None:
        check_numbers(self, positive=("seconds", "max_distance"), optional=("max_rotation",))
        check_whole(self, min_contacts=0)
        if not isinstance(self.fingertips_only, bool):
            raise InvalidInput(f"fingertips_only is {self.fingertips_only!r}; expected a bool")

    @classmethod
    def thesis(cls) -> Stability:
        """Not dropped after 2 s; a drop is a distance, which also serves with the palm down."""
        return cls(
            seconds=2.0,
            max_distance=0.05,
            max_rotation=None,
            min_contacts=0,
            fingertips_only=False,
        )

    def check(
        self, sim: BatchSimulator, mask: Bools | None = None, *, early: bool = True
    ) -> DynamicStability:
        """Hold the environments of ``mask`` (None: all) and say which hold.

        They are left where the hold ended: what passes is also what is kept, so it passes again.
        """
        return check_stable(
            sim,
            self.seconds,
            max_distance=self.max_distance,
            max_rotation=self.max_rotation,
            min_contacts=self.min_contacts,
            fingertips_only=self.fingertips_only,
            restore=False,
            early=early,
            mask=mask,
        )
