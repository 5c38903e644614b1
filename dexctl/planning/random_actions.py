"""RandomActions: random changes of the set-points, G-RRT of thesis chapter 5."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dexctl.planning.expansion import Expander, Expansion, Problem
from dexctl.planning.nodes import Nodes
from dexctl.planning.simulated import Driven, SimulatedExpander
from dexctl.validation import check_numbers, check_whole

if TYPE_CHECKING:
    from dexctl.sim import BatchSimulator


@dataclass(frozen=True, kw_only=True)
class RandomActions(Expansion):
    """G-RRT: set-points are moved at random, and the nearest candidate that holds is kept.

    ``RandomActions.thesis()`` with ``Stability.thesis()`` is the literal algorithm.
    """

    actions: int = 4
    """How many are tried from a node (K_max)."""
    scale: float = 0.15
    """Standard deviation of the change of each set-point [rad] (alpha; the thesis prints
    N(0, alpha I), and the value only makes sense as a standard deviation)."""
    action_time: float = 0.1
    """Simulated time of an action [s]."""
    lazy: bool = True
    """Hold the nearest candidate first and the others only where it falls; the same node is
    found. Off: all of them are held to the end."""
    batch: int = 32
    """How many nodes are expanded at a time."""

    def __post_init__(self) -> None:
        check_numbers(self, positive=("scale", "action_time"))
        check_whole(self, actions=1, batch=1)

    @classmethod
    def thesis(cls) -> RandomActions:
        """The literal loop: every candidate is held."""
        return cls(lazy=False)

    def open(self, problem: Problem) -> Expander:
        names = tuple(f"change_{name}" for name in problem.scene.hand.joint_names)
        return SimulatedExpander(
            problem,
            _RandomDrive(names, self.scale, self.action_time),
            batch=self.batch,
            candidates=self.actions,
            lazy=self.lazy,
        )


class _RandomDrive:
    def __init__(self, action_names: tuple[str, ...], scale: float, action_time: float) -> None:
        self.action_names = action_names
        self._scale, self._time = scale, action_time

    def __call__(self, sim: BatchSimulator, nodes: Nodes, rng: np.random.Generator) -> Driven:
        count = len(nodes)
        wanted = nodes.q_target + self._scale * rng.normal(size=nodes.q_target.shape)
        sent = sim.write(wanted)
        steps = max(1, round(self._time / sim.control_period))
        for _ in range(steps):
            sim.step()
        seconds = np.full(count, steps * sim.control_period)
        return Driven(sent - nodes.q_target, seconds, np.zeros(count, bool), steps * count)
