"""Tree: grasps that lead from one to the next, in arrays that grow, in one file."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dexctl.exceptions import InvalidInput, MissingExtra
from dexctl.files import DAMAGED, aside, read_arrays
from dexctl.planning.header import TreeHeader
from dexctl.planning.nodes import NODE_FIELDS, Frame, Nodes
from dexctl.planning.parts import part_files
from dexctl.rotations import angle_between
from dexctl.sim.grasp_states import GraspStates, states_file
from dexctl.state import Floats
from dexctl.validation import numbers, shown, shown_numbers, unit_quaternions

if TYPE_CHECKING:
    import networkx

    from dexctl.hand import HandModel
    from dexctl.sim import Scene

Indices = NDArray[np.intp]
_BEYOND = 0.5  # goals further than this from every node are none of the tree's [rad]
_COLUMNS = (*NODE_FIELDS, "parent", "action", "expansion")


class Tree:
    """N grasps, the settled one first, each but that with the parent it was reached from.

    Arrays are append-only: a node keeps its number, and its parent has a smaller one. The file is
    a numpy ``.npz`` that `GraspStates` reads too, so episodes can start from its nodes.

    Args:
        header: what the tree is of, and how it was grown.
        root: a row of one.

    Attributes:
        header: as given; what has happened since is counted in it.
    """

    def __init__(self, header: TreeHeader, root: Nodes) -> None:
        self.header = header
        self._size = 0
        width = len(header.action_names)
        self._columns: dict[str, np.ndarray] = {
            **{name: np.empty((0, *getattr(root, name).shape[1:]), getattr(root, name).dtype)
               for name in NODE_FIELDS},
            "parent": np.empty(0, np.int64),
            "action": np.empty((0, width)),
            "expansion": np.empty(0, np.int64),
        }  # fmt: skip
        self.append(root, np.array([-1]), np.full((1, width), np.nan), np.array([0]))

    def __len__(self) -> int:
        return self._size

    def __repr__(self) -> str:
        header = self.header
        return (
            f"Tree({header.hand!r}, {header.object!r}, {len(self)} nodes, "
            f"{self.rotation.max():.2f} rad)"
        )

    def append(
        self, nodes: Nodes, parent: ArrayLike, action: ArrayLike, expansion: ArrayLike
    ) -> None:
        """Add nodes ``(K,)``, with the numbers of their parents, the actions that led to them,
        ``(K, A)``, and how many expansions had been tried by then ``(K,)``.
        """
        if not len(nodes):
            return
        parents, end = np.asarray(parent), self._size + len(nodes)
        later = parents >= np.arange(self._size, end)  # they may stand in the same block
        if later.any() or (self._size and (parents < 0).any()):
            raise InvalidInput(f"parents are {parents}; expected numbers of the {len(self)} nodes")
        new = {
            **{name: getattr(nodes, name) for name in NODE_FIELDS},
            "parent": parents,
            "action": np.asarray(action, float),
            "expansion": np.asarray(expansion),
        }
        for name, column in self._columns.items():
            if end > len(column):
                grown = np.empty((max(1024, 2 * end), *column.shape[1:]), column.dtype)
                grown[: self._size] = column[: self._size]
                self._columns[name] = column = grown
            column[self._size : end] = new[name]
        self._size = end

    def _column(self, name: str) -> np.ndarray:
        view = self._columns[name][: self._size]
        view.flags.writeable = False
        return view

    @property
    def rotation(self) -> Floats:
        """Of the object about the axis since the root, unwrapped ``(N,)`` [rad]."""
        return self._column("rotation")

    @property
    def parent(self) -> NDArray[np.int64]:
        """The node that each was reached from, ``(N,)``; -1 at the root."""
        return self._column("parent")

    @property
    def action(self) -> Floats:
        """What led from the parent to each, ``(N, A)``, see ``header.action_names``."""
        return self._column("action")

    @property
    def expansion(self) -> NDArray[np.int64]:
        """How many expansions had been tried when each was found, ``(N,)``."""
        return self._column("expansion")

    @property
    def nodes(self) -> Nodes:
        """All of them; the arrays are read-only views."""
        return Nodes(**{name: self._column(name) for name in NODE_FIELDS})

    @property
    def frame(self) -> Frame:
        """What position, tilt and rotation are measured from."""
        root = Nodes(**{name: self._column(name)[:1] for name in NODE_FIELDS})
        return Frame.of(self.header.axis, root)

    def check_hand(self, hand: HandModel) -> None:
        """Raise InvalidInput where the tree is not of this hand, its joints and its fingers."""
        header, fingers = self.header, self._columns["in_contact"].shape[1]
        if header.joint_names != tuple(hand.joint_names):
            raise InvalidInput(
                f"the tree is of the hand {header.hand!r} with joints "
                f"{shown(', '.join(header.joint_names))}; the hand {hand.name!r} has others"
            )
        if fingers != hand.n_fingers:
            raise InvalidInput(
                f"the tree has contacts of {fingers} fingers; expected {hand.n_fingers}, as the "
                f"hand {hand.name!r} has"
            )

    def build_scene(self) -> Scene:
        """The scene that the tree is of, see `TreeHeader.build_scene`.

        Raises:
            InvalidInput, UnknownName: it cannot be built, or the tree does not fit it.
        """
        scene = self.header.build_scene()
        self.check_hand(scene.hand)
        return scene

    def states(self, index: ArrayLike | None = None) -> GraspStates:
        """Nodes as grasp states, at rest, with parents: all of them, or those of ``index``.

        Raises:
            InvalidInput: ``index`` has neither numbers of nodes nor a mask of them, or none.
        """
        header, nodes = self.header, self.nodes
        if index is not None:
            index = self.chosen(index)
        states = GraspStates(
            hand=header.hand,
            q=nodes.q.copy(),
            q_target=nodes.q_target.copy(),
            object_position=nodes.object_position.copy(),
            object_quaternion=nodes.object_quaternion.copy(),
            object=np.full(len(nodes), header.object),
            joint_names=np.array(header.joint_names),
            parent=self.parent,
            meta=json.dumps(header.to_plain()),
        )
        return states if index is None else states.take(index)

    def chosen(self, index: ArrayLike) -> Indices | NDArray[np.bool_]:
        """``index``, which has numbers of nodes, those from the end negative, or is a mask.

        Raises:
            InvalidInput: it has neither, or none.
        """
        count = len(self)
        try:
            found = np.asarray(index)
        except ValueError:  # rows of several lengths
            found = np.empty(0, object)
        if not found.size and found.dtype != object:
            raise InvalidInput("no nodes are chosen; expected at least one")
        if found.dtype == bool:
            good = found.shape == (count,)
            if good and not found.any():
                raise InvalidInput("no nodes are chosen; expected at least one")
        else:
            good = found.dtype.kind in "iu" and bool(((found >= -count) & (found < count)).all())
        if not good:
            raise InvalidInput(
                f"index is {shown(index)}; expected numbers of nodes, 0 to {count - 1}, or a mask "
                f"of shape ({count},)"
            )
        return np.atleast_1d(found)

    def path_to(self, node: int) -> Indices:
        """The nodes from the root to ``node``.

        Raises:
            InvalidInput: no such node.
        """
        whole = isinstance(node, (int, np.integer)) and not isinstance(node, bool)
        if not (whole and 0 <= node < len(self)):
            raise InvalidInput(f"node is {shown(node)}; expected 0 to {len(self) - 1}")
        found, parent = [int(node)], self.parent
        while parent[found[-1]] >= 0:
            found.append(int(parent[found[-1]]))
        return np.array(found[::-1], np.intp)

    def paths(
        self,
        n: int,
        goal: ArrayLike | None = None,
        *,
        goal_quaternion: ArrayLike | None = None,
        whole: bool = True,
    ) -> list[Indices]:
        """Paths from the root to the nodes nearest to goals (thesis chapter 5, Alg. R x R).

        The nodes of a path are taken out of the choice, so each path ends elsewhere.

        Args:
            n: how many; fewer are found where the nodes run out.
            goal: rotation to be nearest to [rad], one number or ``(n,)``; None: the greatest.
            goal_quaternion: orientation to be nearest to instead, wxyz, one ``(4,)`` or ``(n, 4)``;
                see `GoalOrientations`.
            whole: a path runs from the root, through nodes of earlier ones where they share them;
                False: it begins after the last node that an earlier one has taken, as in the
                thesis, where what is deleted is gone.

        Raises:
            InvalidInput: not a whole number of paths, both kinds of goal, or one that is beyond the
                tree.
        """
        if not isinstance(n, (int, np.integer)) or isinstance(n, bool) or n < 1:
            raise InvalidInput(f"n is {n!r}; expected a whole number of paths above 0")
        if goal_quaternion is not None:
            if goal is not None:
                raise InvalidInput("goal and goal_quaternion are both given; expected one of them")
            away = self._away(n, goal_quaternion)
        else:
            away = self._rotation_left(n, goal)
        free = np.ones(len(self), bool)
        free[0] = len(self) == 1
        found: list[Indices] = []
        for each in away:
            left = np.flatnonzero(free)
            if not len(left):
                break
            path = self.path_to(int(left[each[left].argmin()]))
            if not whole:
                # every path may have the root; after that, only what no other has had
                last = max(np.flatnonzero(~free[path]), default=0)
                path = path[last + 1 if last else 0 :]
            free[path] = False
            found.append(path)
        return found

    def _rotation_left(self, n: int, goal: ArrayLike | None) -> Iterator[Floats]:
        """How far each node is from each of n rotations, or from the greatest."""
        wanted = f"a rotation in radians, or {n} of them"
        given = numbers("goal", np.inf if goal is None else goal, wanted)
        if given.shape not in ((), (n,)):
            raise InvalidInput(f"goal has shape {given.shape}; expected {wanted}")
        goals = np.broadcast_to(given, (n,))
        least, most = float(self.rotation.min()), float(self.rotation.max())
        beyond = np.isnan(goals) | (
            np.isfinite(goals) & ((goals > most + _BEYOND) | (goals < least - _BEYOND))
        )
        if beyond.any():
            raise InvalidInput(
                f"goal is {goals[beyond][0]:g} rad; the tree reaches {least:.2f} to {most:.2f}"
            )
        turned = self.rotation
        return (-turned if np.isinf(one) else np.abs(turned - one) for one in goals)

    def _away(self, n: int, goal: ArrayLike) -> Iterator[Floats]:
        """How far each node is from each of n orientations [rad]."""
        goals = unit_quaternions("goal_quaternion", goal)
        if goals.shape not in ((4,), (n, 4)):
            raise InvalidInput(
                f"goal_quaternion has shape {goals.shape}; expected (4,) or ({n}, 4)"
            )
        own = self._column("object_quaternion")
        for one in np.atleast_2d(goals):
            least = float(angle_between(own, one).min())
            if least > _BEYOND:
                raise InvalidInput(
                    f"goal_quaternion {shown_numbers(one)} is {least:.2f} rad from the nearest of "
                    f"{len(self)} nodes; expected {_BEYOND} at most"
                )
        return (angle_between(own, one) for one in np.broadcast_to(goals, (n, 4)))

    def to_networkx(self) -> networkx.DiGraph:
        """A directed graph from parents to children; nodes have their rotation and cost.

        Raises:
            MissingExtra: networkx is not installed.
        """
        try:
            import networkx
        except ImportError:
            raise MissingExtra("a tree as a graph", "planning") from None
        graph = networkx.DiGraph()
        nodes = self.nodes
        for i in range(len(self)):
            graph.add_node(i, rotation=float(nodes.rotation[i]), cost=float(nodes.cost[i]))
        graph.add_edges_from((int(p), i) for i, p in enumerate(self.parent) if p >= 0)
        return graph

    def save(self, path: str | Path) -> None:
        """Write the file, whole or not at all: numpy alone reads it."""
        header = self.header
        arrays: dict[str, Any] = {name: self._column(name) for name in _COLUMNS}
        with aside(Path(path)) as part, part.open("wb") as stream:
            np.savez(
                stream,
                hand=np.asarray(header.hand),
                object=np.full(len(self), header.object),
                joint_names=np.array(header.joint_names),
                meta=np.asarray(json.dumps(header.to_plain())),
                **arrays,
            )

    @classmethod
    def load(cls, path: str | Path) -> Tree:
        """Read what `save` wrote; of a folder, its tree.npz.

        Raises:
            InvalidInput: no such file, not a tree, or one that was cut or changed.
        """
        path = states_file(path)
        what = f"tree {str(path)!r}"
        parts = [] if path.exists() else part_files(path)
        if parts:
            raise InvalidInput(
                f"{what} is not there yet: {path.parent} has the trees of {len(parts)} processes; "
                "the `dexctl plan` that grew them makes one of them with --resume"
            )
        values = read_arrays(path, what)
        missing = [name for name in (*_COLUMNS, "meta") if name not in values]
        if missing:
            raise InvalidInput(f"{what} lacks {', '.join(missing)}; it is no tree")
        try:
            return cls._of(TreeHeader.from_plain(json.loads(str(values["meta"]))), values)
        except DAMAGED as error:  # InvalidInput is a ValueError
            raise InvalidInput(f"{what}: {' '.join(str(error).split())[:200]}") from None

    @classmethod
    def _of(cls, header: TreeHeader, values: Mapping[str, np.ndarray]) -> Tree:
        count, d = values["parent"].size, len(header.joint_names)
        fingers = values["in_contact"].shape[-1:]
        widths = {
            "q": (d,), "q_target": (d,), "joint_velocity": (d,), "object_position": (3,),
            "object_quaternion": (4,), "object_velocity": (6,), "in_contact": fingers,
            "action": (len(header.action_names),),
        }  # fmt: skip
        for name in _COLUMNS:
            expected = (count, *widths.get(name, ()))
            if values[name].shape != expected or not count:
                raise InvalidInput(f"{name} has shape {values[name].shape}; expected {expected}")
            kinds = {"parent": "iu", "expansion": "iu", "in_contact": "b"}.get(name, "iuf")
            if values[name].dtype.kind not in kinds:
                raise InvalidInput(f"{name} is of {values[name].dtype}; it is no tree")
            if name != "action" and not np.isfinite(values[name]).all():
                raise InvalidInput(f"{name} has numbers that are not finite")
        norm = np.linalg.norm(values["object_quaternion"], axis=1)
        if (np.abs(norm - 1.0) > 1e-3).any():
            bad = float(norm[np.argmax(np.abs(norm - 1.0))])
            raise InvalidInput(f"object_quaternion has norm {bad:.4g}; expected 1")
        parent = values["parent"]
        if parent[0] != -1 or (parent[1:] < 0).any() or (parent >= np.arange(count)).any():
            raise InvalidInput("parents do not stand before their children; it is no tree")
        nodes = Nodes(**{name: values[name] for name in NODE_FIELDS})
        tree = cls(header, nodes.take([0]))
        rest = np.arange(1, count)
        tree.append(nodes.take(rest), parent[1:], values["action"][1:], values["expansion"][1:])
        return tree

    @classmethod
    def merge(cls, trees: Sequence[Tree]) -> Tree:
        """One tree of several with the same root, grown by several processes.

        `expansion` then counts those of all trees together, as if all had been equally quick.

        Raises:
            InvalidInput: none, or trees that do not belong together: of another hand, object,
                gravity or root, or grown with other settings.
        """
        if not trees:
            raise InvalidInput("merge got no trees; expected at least one")
        first = trees[0]
        header = first.header
        merged = cls(header, first.nodes.take([0]))
        for tree in trees:
            tree.header.check_same(first.header)
            tree.header.check_same_settings(first.header)
            if not np.allclose(tree.nodes.q[0], first.nodes.q[0], atol=1e-9):
                raise InvalidInput("the trees have different roots; expected one")
            rest = np.arange(1, len(tree))
            shift = len(merged) - 1
            parent = tree.parent[1:]
            if len(rest):
                merged.append(
                    tree.nodes.take(rest),
                    np.where(parent > 0, parent + shift, 0),
                    tree.action[1:],
                    tree.expansion[1:] * len(trees),
                )
        merged.header = TreeHeader.sum([tree.header for tree in trees])
        return merged
