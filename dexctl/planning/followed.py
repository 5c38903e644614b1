"""FollowedEdges: a tree whose edges are those of another one, carried out in simulation."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dexctl.exceptions import InvalidInput
from dexctl.planning.expansion import Expander, Expansion, Problem
from dexctl.planning.following import PlannedGait
from dexctl.planning.nodes import Nodes
from dexctl.planning.route import Indices, Route
from dexctl.planning.simulated import Driven, SimulatedExpander
from dexctl.planning.tree import Tree
from dexctl.state import Bools, Floats, GraspState
from dexctl.validation import check_numbers, check_whole

if TYPE_CHECKING:
    from dexctl.sim import BatchSimulator, Scene

_LONGEST = 6.0  # an edge that is not over by then is given up [s]


@dataclass(frozen=True, kw_only=True)
class FollowedEdges(Expansion):
    """Edges of a kinematic tree, verified: controllers carry them out, and what holds is kept.

    From a node, which is a state of the simulation, the edges of the other tree's nearest nodes
    are tried as `PlannedGait` follows them. What is kept has set-points, has passed the check,
    and is expanded again: its paths are ways that controllers have gone.
    """

    tree: Path = Path("out/plan/tree.npz")
    """File of the tree whose edges are tried, of the same hand, object, gravity and axis."""
    candidates: int = 1
    """How many edges are tried from a node."""
    direct: float = 0.7
    """Share of the edge of the nearest node on the way to the greatest rotation; the rest are those
    of nodes drawn from the nearest ones, whatever they lead to: ways round an edge that fails."""
    nearest: int = 8
    """How many nodes those are drawn from."""
    within: float = 0.025
    """An edge has led where it should if the fingertips that should touch do, and no others, each
    nearer than this to its place on the object [m]; fingers roll on it on the way."""
    lazy: bool = True
    """As in `RandomActions`."""
    batch: int = 32
    """How many nodes are expanded at a time."""

    def __post_init__(self) -> None:
        check_whole(self, candidates=1, nearest=1, batch=1)
        check_numbers(self, positive=("within",), fractions=("direct",))

    def check(self, scene: Scene, axis: Floats) -> None:
        self.load(scene, axis)

    def load(self, scene: Scene, axis: Floats) -> Tree:
        """The tree whose edges are tried.

        Args:
            scene: in which.
            axis: of the rotation, unit ``(3,)``.

        Raises:
            InvalidInput: the file is no tree, or one of another object, gravity or axis.
        """
        tree = Tree.load(self.tree)
        header = tree.header
        same = header.object == scene.object and np.allclose(header.gravity, scene.gravity)
        if not (same and np.allclose(header.axis, axis)):
            raise InvalidInput(
                f"the edges are of {tree!r} under {header.gravity} about {header.axis}; the scene "
                f"is {scene!r} about {tuple(np.asarray(axis).tolist())}"
            )
        return tree

    def open(self, problem: Problem) -> Expander:
        return SimulatedExpander(
            problem,
            _EdgeDrive(self, problem),
            batch=self.batch,
            candidates=self.candidates,
            lazy=self.lazy,
        )


class _EdgeDrive:
    action_names = ("node", "finger", "seconds")

    def __init__(self, config: FollowedEdges, problem: Problem) -> None:
        self._config, self._problem = config, problem
        hand, tree = problem.scene.hand, config.load(problem.scene, problem.frame.axis)
        self._gait = PlannedGait(hand, tree, control_period=problem.stepping.control_period)
        self._route = Route(tree, hand, self._gait.config.rotation, every=True)
        self._gait.route = self._route

    def __call__(self, sim: BatchSimulator, nodes: Nodes, rng: np.random.Generator) -> Driven:
        gait, frame, count = self._gait, self._problem.frame, len(nodes)
        gait.reset()
        state = sim.read()
        goal = self._route.following[self._choose(state, nodes, rng)]
        gait.follow(state, goal)
        finger = gait.route.finger[goal].astype(float)
        period, steps = sim.control_period, 0
        active, lost, seconds = np.ones(count, bool), np.zeros(count, bool), np.zeros(count)
        while True:
            change = gait.act(state)
            active &= ~np.asarray(gait.diagnostics["arrived"])
            if not active.any():
                break
            sim.write(np.where(active[:, None], state.q_target + change, state.q_target))
            sim.step(active)
            seconds[active] += period
            steps += int(active.sum())
            state = sim.read()
            assert state.object_position is not None
            away = np.linalg.norm(frame.displacement(state.object_position), axis=-1)
            gone = active & ~(away <= 2 * self._problem.bounds.displacement)
            lost |= gone | (active & (seconds > _LONGEST))
            active &= ~lost
        lost |= ~self._as_planned(state, goal)
        node = self._route.node[goal].astype(float)
        return Driven(np.column_stack([node, finger, seconds]), seconds, lost, steps)

    def _as_planned(self, state: GraspState, goal: Indices) -> Bools:
        """Whether fingers are where the other tree has them: no node may hide another gait."""
        route = self._route
        assert state.object_position is not None
        assert state.object_quaternion is not None
        tip = route.in_object(
            self._gait.hand.fingertip_positions(state.q),
            state.object_position,
            state.object_quaternion,
        )
        apart = np.linalg.norm(tip - route.tip[goal], axis=-1)
        touch = route.touch[goal]
        near = (apart < self._config.within) | ~touch
        right: Bools = np.asarray((near & (state.in_contact == touch)).all(axis=1))
        return right

    def _choose(self, state: GraspState, nodes: Nodes, rng: np.random.Generator) -> Indices:
        """Places on the route whose edges are tried, one for each candidate, ``(N,)``."""
        config, route = self._config, self._route
        assert state.object_position is not None
        assert state.object_quaternion is not None
        distance = route.distance(
            state.q, state.object_position, state.object_quaternion, nodes.rotation
        )
        # whole turns do count here: the tree has an end
        distance += (
            2.0 * np.pi * np.round(np.abs(nodes.rotation[:, None] - route.rotation) / (2.0 * np.pi))
        )
        distance[:, route.following < 0] = np.inf
        best = np.where(route.far, distance, np.inf).argmin(axis=1)
        many = min(config.nearest, int((route.following >= 0).sum()))
        near = np.argpartition(distance, many - 1, axis=1)[:, :many]
        drawn = near[np.arange(len(near)), rng.integers(many, size=len(near))]
        direct = rng.uniform(size=len(near)) < config.direct
        return np.where(direct, best, drawn)
