"""Which nodes of a tree hold in simulation."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from dexctl.exceptions import InvalidInput
from dexctl.planning.nodes import put
from dexctl.planning.scene_settings import Stepping
from dexctl.planning.stability import Stability
from dexctl.planning.tree import Tree
from dexctl.settings import from_plain
from dexctl.state import Bools

if TYPE_CHECKING:
    from dexctl.sim import Scene

_LASTING = 2.0  # how long set-points are held at least, where nothing else is said [s]


def holding(
    scene: Scene,
    tree: Tree,
    index: ArrayLike | None = None,
    *,
    stability: Stability | None = None,
    batch: int = 128,
    threads: int | None = None,
) -> Bools:
    """Put nodes into the simulator and hold their set-points, ``(K,)``.

    For trees that were grown without physics; those of simulated expansions have been checked.

    Args:
        scene: that of the tree.
        tree: whose nodes.
        index: numbers of nodes ``(K,)``, or a mask; None: all.
        stability: None: the tree's own check, for 2 s at least.
        batch: how many at a time.
        threads: of the physics; None: every core.

    Raises:
        InvalidInput: another hand, object or gravity than the tree's, or no nodes of it.
    """
    from dexctl.sim import BatchSimulator

    header, joints = tree.header, tuple(scene.hand.joint_names)
    same = header.joint_names == joints and header.object == scene.object
    if not (same and np.allclose(header.gravity, scene.gravity)):
        raise InvalidInput(f"the tree is {tree!r} under {header.gravity}; the scene is {scene!r}")
    check = stability or _lasting(tree)
    nodes = tree.nodes if index is None else tree.nodes.take(tree.chosen(index))
    found = np.zeros(len(nodes), bool)
    stepping = Stepping.of(header.scene)._asdict()
    with BatchSimulator(scene, batch, disturbance=0.0, threads=threads, **stepping) as sim:
        for first in range(0, len(nodes), batch):
            rows = np.arange(first, min(first + batch, len(nodes)))
            mask = np.arange(batch) < len(rows)
            # the last batch is filled up with nodes that are not looked at
            put(sim, nodes.take(np.resize(rows, batch)))
            found[rows] = check.check(sim, mask).stable[: len(rows)]
    return found


def _lasting(tree: Tree) -> Stability:
    """The check that the tree was grown with, long enough to see a slow fall."""
    own = from_plain(Stability, tree.header.settings.get("stability", {}), "settings.stability")
    return replace(own, seconds=max(own.seconds, _LASTING))
