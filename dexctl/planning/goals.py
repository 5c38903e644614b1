"""GoalOrientations: orientations of the object that a tree is grown to reach."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dexctl.exceptions import InvalidInput
from dexctl.planning.bounds import Bounds
from dexctl.planning.metric import Metric
from dexctl.planning.nodes import Frame
from dexctl.rotations import angle_between
from dexctl.settings import Quaternions
from dexctl.state import Floats
from dexctl.validation import check_numbers, shown_numbers, unit_quaternion

_UPSIDE_DOWN = 2.9  # an axis that leans so far has no rotation about it that means anything [rad]


@dataclass(frozen=True, kw_only=True)
class GoalOrientations:
    """Orientations in SO(3) that a tree is to reach (thesis chapter 5, arbitrary reorientation).

    Some targets are goals, the others lie around the way there, and `Bounds` become as wide as
    goals ask for. A goal is gone to the short way round about the tree's axis.
    """

    orientations: Quaternions = ()
    """That the object is to have, each wxyz in the world's frame; none: it is only turned."""
    angle: float = 0.2
    """A goal is reached where a node is no further from it than this [rad]."""
    share: float = 0.3
    """Share of the targets that are goals, each as likely."""
    margin: float = 0.3
    """Nodes may lean and turn this much further than goals ask for [rad]."""

    def __post_init__(self) -> None:
        check_numbers(self, positive=("angle",), not_negative=("margin",), fractions=("share",))
        for goal in self.orientations:
            unit_quaternion("a goal", goal)

    def __len__(self) -> int:
        return len(self.orientations)

    @property
    def quaternion(self) -> Floats:
        """The goals, ``(G, 4)``."""
        return np.array(self.orientations, float).reshape(-1, 4)

    def away(self, quaternion: Floats) -> Floats:
        """How far the nearest of orientations ``(N, 4)`` is from each goal, ``(G,)`` [rad]."""
        return angle_between(quaternion[:, None], self.quaternion).min(axis=0, initial=np.pi)

    def widened(self, bounds: Bounds, frame: Frame) -> Bounds:
        """Bounds that let the object lean and turn as far as goals ask for.

        Raises:
            InvalidInput: a goal has the axis upside down.
        """
        if not len(self):
            return bounds
        lean, turn = self._seen(frame)
        over = np.linalg.norm(lean, axis=1)
        if over.max() > _UPSIDE_DOWN:
            worst = int(over.argmax())
            raise InvalidInput(
                f"goal {shown_numbers(self.orientations[worst])} leans {over[worst]:.2f} rad from "
                f"the axis {tuple(frame.axis.tolist())}; expected {_UPSIDE_DOWN} at most, or an "
                "axis that it turns about"
            )
        low, high = bounds.rotation
        return replace(
            bounds,
            tilt=max(bounds.tilt, float(over.max()) + self.margin),
            rotation=(
                min(low, float(turn.min()) - self.margin),
                max(high, float(turn.max()) + self.margin),
            ),
        )

    def drawn(
        self,
        frame: Frame,
        metric: Metric,
        targets: NDArray[np.float32],
        rng: np.random.Generator,
    ) -> NDArray[np.float32]:
        """Targets ``(B, d + 6)`` of `Bounds.targets`, some of them goals, others on the way."""
        if not len(self):
            return targets
        lean, turn = self._seen(frame)
        count, targets = len(targets), targets.copy()
        low, high = min(0.0, turn.min()) - self.margin, max(0.0, turn.max()) + self.margin
        targets[:, -1] = metric.rotation * rng.uniform(low, high, count)
        chosen = rng.uniform(size=count) < self.share
        goal = rng.integers(len(self), size=count)
        there = np.column_stack(
            [np.zeros((count, 3)), metric.tilt * lean[goal], metric.rotation * turn[goal]]
        )
        targets[chosen, -6:] = there[chosen]
        return targets

    def _seen(self, frame: Frame) -> tuple[Floats, Floats]:
        """Tilt ``(G, 2)`` and rotation ``(G,)`` of the goals, the latter from -pi to pi."""
        goal = self.quaternion
        return frame.tilt(goal), frame.rotation(goal, np.zeros(len(goal)))
