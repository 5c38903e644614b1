"""Expansions by simulation: candidates are carried out, and the nearest that holds is kept.

Algorithm "General-purpose non-holonomic RRT" of thesis chapter 5, for B nodes at once: K
candidates each start from a node, and of those that hold the one nearest to the target becomes a
new node. The thesis holds all K; holding the nearest first, and the next only where that one does
not hold, gives the same node for a fraction of the steps.
"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from dexctl.planning.expansion import Offspring, Problem
from dexctl.planning.nodes import Nodes, children, put
from dexctl.state import Bools, Floats

if TYPE_CHECKING:
    from dexctl.sim import BatchSimulator


class Driven(NamedTuple):
    """What was done with N candidates.

    Attributes:
        action: ``(N, A)``.
        seconds: how long each took, ``(N,)`` [s].
        lost: those that were given up on the way, ``(N,)``.
        steps: control steps of all of them together.
    """

    action: Floats
    seconds: Floats
    lost: Bools
    steps: int


class Drive(Protocol):
    """Carries out an action in every environment of a simulator."""

    @property
    def action_names(self) -> tuple[str, ...]:
        """What the columns of its actions are."""
        ...

    def __call__(self, sim: BatchSimulator, nodes: Nodes, rng: np.random.Generator) -> Driven:
        """From ``nodes`` ``(N,)``, where the simulator stands."""
        ...


class SimulatedExpander:
    """B times K candidates in one batch.

    Args:
        problem: what is planned.
        drive: what candidates do.
        batch: B.
        candidates: K.
        lazy: hold the nearest candidate first; False: all of them, to the end, as the thesis does.
    """

    def __init__(
        self, problem: Problem, drive: Drive, *, batch: int, candidates: int, lazy: bool
    ) -> None:
        from dexctl.sim import BatchSimulator

        self.batch, self.action_names = batch, drive.action_names
        self._problem, self._drive, self._candidates, self._lazy = problem, drive, candidates, lazy
        self._sim = BatchSimulator(
            problem.scene, batch * candidates, disturbance=0.0, threads=problem.threads,
            **problem.stepping._asdict(),
        )  # fmt: skip

    def close(self) -> None:
        self._sim.close()

    def __call__(
        self, nodes: Nodes, targets: NDArray[np.float32], rng: np.random.Generator
    ) -> Offspring:
        problem, sim = self._problem, self._sim
        shape = self.batch, self._candidates
        parents = nodes.take(np.repeat(np.arange(self.batch), self._candidates))
        put(sim, parents)
        driven = self._drive(sim, parents, rng)
        tried = children(problem.frame, sim, parents, driven.seconds)
        broken = sim.diverged
        within = problem.bounds.hold(problem.frame, tried) | broken  # its last state says nothing
        lost = within & (driven.lost | broken)
        within &= ~lost
        touching = tried.in_contact.sum(axis=1) >= problem.stability.min_contacts
        hopeful = within & touching
        refused = Counter(
            bounds=int((~within & ~lost).sum()),
            lost=int(lost.sum()),
            contacts=int((within & ~touching).sum()),
        )
        points = problem.metric.of(problem.frame, tried).reshape(*shape, -1)
        distance = np.linalg.norm(points - targets[:, None], axis=-1)
        distance = np.where(hopeful.reshape(shape), distance, np.inf)
        order = np.argsort(distance, axis=1, kind="stable")
        if self._lazy:
            chosen, held = self._nearest_first(order, np.isfinite(distance), refused)
        else:
            chosen, held = self._every(order, hopeful, refused)
        kept = children(problem.frame, sim, parents.take(chosen), driven.seconds[chosen], chosen)
        good = problem.bounds.hold(problem.frame, kept)
        refused["bounds"] += int((~good).sum())
        return Offspring(
            kept.take(good),
            chosen[good] // self._candidates,
            driven.action[chosen[good]],
            refused,
            (driven.steps + held) * sim.substeps,
        )

    def _nearest_first(
        self, order: NDArray[np.intp], possible: Bools, refused: Counter[str]
    ) -> tuple[NDArray[np.intp], int]:
        """The nearest candidate of each node that holds; and how many steps it took to know."""
        first = np.arange(self.batch) * self._candidates
        open_, found, steps = np.ones(self.batch, bool), [], 0
        for rank in range(self._candidates):
            place = order[:, rank]
            ask = np.flatnonzero(open_ & possible[np.arange(self.batch), place])
            if not len(ask):
                break
            rows = first[ask] + place[ask]
            stable, used = self._hold(rows, early=True)
            refused["stability"] += int((~stable).sum())
            steps += used
            found.append(rows[stable])
            open_[ask[stable]] = False
        return np.sort(np.concatenate([*found, np.empty(0, np.intp)])), steps

    def _every(
        self, order: NDArray[np.intp], hopeful: Bools, refused: Counter[str]
    ) -> tuple[NDArray[np.intp], int]:
        """The same node, as the thesis finds it: every candidate is held to the end."""
        rows = np.arange(len(hopeful))
        stable, steps = self._hold(rows, early=False)
        good = stable & hopeful
        refused["stability"] += int((hopeful & ~stable).sum())
        ranked = np.take_along_axis(good.reshape(order.shape), order, axis=1)
        best = order[np.arange(self.batch), ranked.argmax(axis=1)]
        chosen = np.arange(self.batch) * self._candidates + best
        return chosen[ranked.any(axis=1)], steps

    def _hold(self, rows: NDArray[np.intp], *, early: bool) -> tuple[Bools, int]:
        """Which of the environments ``rows`` hold; and how many control steps that took."""
        mask = np.zeros(self.batch * self._candidates, bool)
        mask[rows] = True
        before = self._sim.time
        stable = self._problem.stability.check(self._sim, mask, early=early).stable[rows]
        steps = round(float((self._sim.time - before).sum()) / self._sim.control_period)
        return stable, steps
