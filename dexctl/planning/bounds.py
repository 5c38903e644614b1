"""Bounds: which grasps a tree takes in, and where its targets are drawn."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dexctl.exceptions import InvalidInput
from dexctl.planning.metric import Metric
from dexctl.planning.nodes import Frame, Nodes
from dexctl.state import Bools, Floats
from dexctl.validation import check_numbers, check_pair


@dataclass(frozen=True, kw_only=True)
class Bounds:
    """Limits along each dimension of the state space (thesis chapter 5)."""

    displacement: float = 0.02
    """How far the object may be from where it was at the root [m]."""
    tilt: float = 0.4
    """How far it may lean [rad]."""
    rotation: tuple[float, float] = (-0.5, 7.0)
    """Least and greatest rotation of the object [rad]; targets are drawn between 0 and the
    greatest."""
    joints: float = 0.5
    """Targets are drawn this far around the joints at the root [rad]."""

    def __post_init__(self) -> None:
        check_numbers(self, positive=("displacement", "tilt", "joints"))
        wanted = "(least <= 0, greatest > 0), in radians"
        low, high = check_pair("rotation", self.rotation, wanted)
        if not low <= 0 < high:
            raise InvalidInput(f"rotation is {self.rotation}; expected {wanted}")

    def hold(self, frame: Frame, nodes: Nodes) -> Bools:
        """Which nodes are within the bounds, ``(N,)``."""
        away = np.linalg.norm(frame.displacement(nodes.object_position), axis=-1)
        lean = np.linalg.norm(frame.tilt(nodes.object_quaternion), axis=-1)
        low, high = self.rotation
        # comparisons with NaN are False: what is not finite is out
        return (
            (away <= self.displacement)
            & (lean <= self.tilt)
            & (nodes.rotation >= low)
            & (nodes.rotation <= high + 1.0)
        )

    def targets(
        self,
        frame: Frame,
        metric: Metric,
        root_q: Floats,
        limits: tuple[Floats, Floats],
        rng: np.random.Generator,
        count: int,
    ) -> NDArray[np.float32]:
        """Random points of the state space, as the metric sees them, ``(count, d + 6)``."""
        spread = rng.uniform(-self.joints, self.joints, (count, len(root_q)))
        q = np.clip(root_q + spread, *limits)
        return metric.features(
            q,
            _in_ball(rng, count, 3, self.displacement),
            _in_ball(rng, count, 2, self.tilt),
            rng.uniform(0.0, self.rotation[1], count),
        )


def _in_ball(rng: np.random.Generator, count: int, width: int, radius: float) -> Floats:
    """Uniform points of a ball, ``(count, width)``."""
    direction = rng.normal(size=(count, width))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return direction * (radius * rng.uniform(size=(count, 1)) ** (1.0 / width))
