"""Route: the nodes of a tree that lead on, and what carries a hand from each to the next."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dexctl.exceptions import InvalidInput
from dexctl.hand import HandModel
from dexctl.planning.metric import Metric
from dexctl.planning.tree import Tree
from dexctl.rotations import inverse, rotate, shortest
from dexctl.settings import from_plain
from dexctl.state import Bools, Floats
from dexctl.switch.landing import Landing

Indices = NDArray[np.intp]
_MOVED = 0.004  # a finger that is put down nearer than this to where it was is not moved [m]


class Route:
    """The K nodes of a tree on paths that end far enough, each with the one that follows it.

    Where a node has several children, the one that leads furthest follows, of equal ones that
    which gets there in the least time.

    Args:
        tree: of a kind whose actions name the finger that is put down anew.
        hand: its hand.
        rotation: paths that end before it do not count, where others do not [rad].
        every: take the other nodes in too, with whatever follows them.

    Attributes:
        tree: as given.
        node: numbers of the nodes in the tree, ascending, ``(K,)``.
        following: which of the K comes after each, -1 at the ends, ``(K,)``.
        far: which are on paths that end far enough, ``(K,)``.
        finger: that is put down anew on the way *to* each, -1 for none, ``(K,)``.
        touch: which fingertips touch, ``(K, m)``.
        tip: places of the fingertips in the object's frame, ``(K, m, 3)`` [m].
        position, quaternion, rotation: of the object, ``(K, 3)``, ``(K, 4)``, ``(K,)``.

    Raises:
        InvalidInput: a tree of another hand, of one node, or whose actions name no finger.
    """

    def __init__(
        self,
        tree: Tree,
        hand: HandModel,
        rotation: float = 2.0 * np.pi,
        *,
        every: bool = False,
    ) -> None:
        header = tree.header
        tree.check_hand(hand)
        if "finger" not in header.action_names:
            raise InvalidInput(
                f"the actions of a tree by {header.expansion} name no finger; expected one by "
                "Kinematic or ControllerMacros"
            )
        if len(tree) < 2:
            raise InvalidInput("the tree has one node; expected a path")
        self.tree, self.frame = tree, tree.frame
        far, following = _ahead(tree, rotation)
        self.node = np.arange(len(tree)) if every else np.flatnonzero(far)
        place = np.full(len(tree) + 1, -1)  # the last one is that of no node, -1
        place[self.node] = np.arange(len(self.node))
        self.far, self.following = far[self.node], place[following[self.node]]
        nodes = tree.nodes.take(self.node)
        self.position, self.quaternion = nodes.object_position, nodes.object_quaternion
        self.rotation, self.touch = nodes.rotation, nodes.in_contact
        self.tip = self.in_object(
            hand.fingertip_positions(nodes.q), nodes.object_position, nodes.object_quaternion
        )
        from dexctl.sim.shapes import Shape

        shape = Shape.of_body(tree.build_scene().model)
        self._inward = -shape.nearest(self.tip)[1]
        self.finger = self._fingers(hand)
        settings = header.settings.get("metric")
        self._metric = Metric() if settings is None else from_plain(Metric, settings)
        self._grasp = self._metric.of(self.frame, nodes)[:, :-1].astype(float)

    def _fingers(self, hand: HandModel) -> Indices:
        tree = self.tree
        column = tree.action[self.node, tree.header.action_names.index("finger")]
        finger = np.where(np.isfinite(column), column, -1).astype(np.intp)
        parents = tree.nodes.take(np.maximum(tree.parent[self.node], 0))
        before = self.in_object(
            hand.fingertip_positions(parents.q),
            parents.object_position,
            parents.object_quaternion,
        )
        rows, own = np.arange(len(finger)), np.maximum(finger, 0)
        moved = np.linalg.norm(self.tip - before, axis=-1)[rows, own] > _MOVED
        return np.where(moved & self.touch[rows, own], finger, -1)

    @staticmethod
    def in_object(tip: Floats, position: Floats, quaternion: Floats) -> Floats:
        """Places in the world ``(N, m, 3)`` as the objects see them."""
        turn = np.broadcast_to(inverse(quaternion)[:, None], (*tip.shape[:2], 4))
        return rotate(turn, tip - position[:, None])

    def landing(
        self, place: Indices, finger: Indices, position: Floats, quaternion: Floats
    ) -> Landing:
        """Where ``finger`` ``(N,)`` touches at nodes ``place`` ``(N,)``, on objects elsewhere."""
        return Landing(
            position + rotate(quaternion, self.tip[place, finger]),
            rotate(quaternion, self._inward[place, finger]),
        )

    def distance(self, q: Floats, position: Floats, quaternion: Floats, angle: Floats) -> Floats:
        """By the tree's metric, but whole turns do not count, ``(N, K)``.

        Args:
            q: joints ``(N, d)``.
            position, quaternion: of the object, ``(N, 3)``, ``(N, 4)``.
            angle: its rotation, ``(N,)`` [rad].
        """
        frame, metric = self.frame, self._metric
        here = metric.features(q, frame.displacement(position), frame.tilt(quaternion), angle)
        apart = here[:, None, :-1] - self._grasp
        turn = metric.rotation * shortest(angle[:, None] - self.rotation)
        return np.sqrt((apart * apart).sum(axis=-1) + turn * turn)


def _ahead(tree: Tree, rotation: float) -> tuple[Bools, Indices]:
    """Which nodes are on paths that get to ``rotation``, or as far as any; what follows each."""
    reach, time = tree.rotation.copy(), tree.nodes.cost.copy()
    least = min(rotation, float(reach.max()))
    best = np.full(len(tree), -1)
    # children come after their parents: from the last one on, each is known when it is asked
    for child in range(len(tree) - 1, 0, -1):
        parent = tree.parent[child]
        far, so_far = min(reach[child], least), min(reach[parent], least)
        sooner = far == so_far and time[child] < time[parent]
        if far > so_far or (sooner and best[parent] >= 0):
            reach[parent], time[parent], best[parent] = reach[child], time[child], child
    return np.asarray(reach >= least), best
