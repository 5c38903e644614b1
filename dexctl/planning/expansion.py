"""Expansion: how a tree's nodes are brought nearer to targets, behind one protocol."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from dexctl.planning.bounds import Bounds
from dexctl.planning.metric import Metric
from dexctl.planning.nodes import Frame, Nodes
from dexctl.planning.scene_settings import Stepping
from dexctl.planning.stability import Stability
from dexctl.state import Floats

if TYPE_CHECKING:
    from dexctl.sim import Scene


@dataclass(frozen=True, kw_only=True, eq=False)
class Problem:
    """What a tree is grown for.

    Attributes:
        scene: hand, object and gravity.
        root: the grasp it starts from, a row of one.
        frame: what rotation and tilt are measured from.
        metric, bounds, stability: as `grow` was given them.
        threads: of the physics.
        stepping: of the physics, too.
    """

    scene: Scene
    root: Nodes
    frame: Frame
    metric: Metric = field(default_factory=Metric)
    bounds: Bounds = field(default_factory=Bounds)
    stability: Stability = field(default_factory=Stability)
    threads: int | None = None
    stepping: Stepping = field(default_factory=lambda: Stepping.of(None))


class Offspring(NamedTuple):
    """What came of expanding B nodes.

    Attributes:
        nodes: those that hold, ``(K,)``.
        source: which of the B each came from, ``(K,)``.
        action: what was done, ``(K, A)``.
        refused: why candidates were not taken in, and how many.
        physics_steps: that it took.
    """

    nodes: Nodes
    source: NDArray[np.intp]
    action: Floats
    refused: Mapping[str, int]
    physics_steps: int


class Expander(Protocol):
    """An expansion at work on one problem.

    Attributes:
        batch: B, how many nodes are expanded at a time.
        action_names: what the columns of its actions are.
    """

    batch: int
    action_names: tuple[str, ...]

    def __call__(
        self, nodes: Nodes, targets: NDArray[np.float32], rng: np.random.Generator
    ) -> Offspring:
        """Expand ``nodes`` ``(B,)``, each towards its target ``(B, d + 6)`` (see `Metric`)."""
        ...

    def close(self) -> None:
        """Let go of what it holds."""
        ...


class Expansion(ABC):
    """The settings of a way to expand, a frozen dataclass."""

    def check(self, scene: Scene, axis: Floats) -> None:  # noqa: B027 - most need nothing else
        """Raise InvalidInput where what it needs beside its numbers is missing or does not fit."""

    @abstractmethod
    def open(self, problem: Problem) -> Expander:
        """It, at work on a problem."""
