"""Trees of grasps for people: a picture of one, and a film of a path."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dexctl.planning import Tree
from dexctl.planning.nodes import put
from dexctl.report.film import Moment
from dexctl.report.style import FAINT, INK, drawing, finger_colour, new_figure
from dexctl.sim import BatchSimulator, Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_EDGES = 20_000  # of larger trees, that many are drawn
_SHORTEST = 0.15  # a step of a film lasts at least this long [s]


def draw(tree: Tree, path: NDArray[np.intp]) -> bytes:
    """A picture of a tree as the content of a PNG file.

    Args:
        tree: what is drawn: rotation over the time that its actions take, rotation over the number
            of expansions, and which fingertips touch along ``path``.
        path: numbers of nodes, the root first.
    """
    header = tree.header
    with drawing():
        figure = new_figure(11.0, 6.0)
        figure.suptitle(
            f"{header.hand} turns a {header.object}: {len(tree)} nodes by {header.expansion}",
            x=0.012, ha="left", weight="bold", fontsize=13,
        )  # fmt: skip
        grid = figure.add_gridspec(2, 2, width_ratios=(1.5, 1.0))
        _edges(figure.add_subplot(grid[:, 0]), tree, path)
        _growth(figure.add_subplot(grid[0, 1]), tree)
        _contacts(figure.add_subplot(grid[1, 1]), tree, path)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=130)
    return buffer.getvalue()


def _edges(axes: Axes, tree: Tree, path: NDArray[np.intp]) -> None:
    from matplotlib.collections import LineCollection

    rotation, cost = tree.rotation, tree.nodes.cost
    child = np.arange(1, len(tree))
    if len(child) > _EDGES:
        child = np.random.default_rng(0).choice(child, _EDGES, replace=False)
    ends = np.stack([tree.parent[child], child], axis=1)
    lines = np.stack([cost[ends], rotation[ends]], axis=-1)
    axes.add_collection(LineCollection(list(lines), colors=FAINT, linewidths=0.4, alpha=0.6))
    axes.plot(cost[path], rotation[path], color="#0072b2", lw=2.0, marker="o", ms=3)
    axes.set(xlabel="time of the actions [s]", ylabel="rotation [rad]", title="Tree and path")
    axes.axhline(2 * np.pi, color=INK, lw=0.8, ls=(0, (2, 2)))
    axes.autoscale_view()


def _growth(axes: Axes, tree: Tree) -> None:
    order = np.argsort(tree.expansion, kind="stable")
    best = np.maximum.accumulate(tree.rotation[order])
    axes.step(np.maximum(tree.expansion[order], 1), best, where="post", color="#0072b2", lw=2.0)
    axes.set(xscale="log", xlabel="expansions", ylabel="[rad]", title="Greatest rotation")


def _contacts(axes: Axes, tree: Tree, path: NDArray[np.intp]) -> None:
    touch = tree.nodes.in_contact[path]
    for finger in range(touch.shape[1]):
        runs = np.flatnonzero(touch[:, finger])
        axes.broken_barh(
            [(int(i) - 0.5, 1.0) for i in runs], (finger + 0.6, 0.8), color=finger_colour(finger)
        )
    names = tree.header.action_names
    moved = ""
    if "finger" in names:  # the action that led to a node moved a finger
        finger = tree.action[path, names.index("finger")]
        at = np.flatnonzero(finger >= 0)
        axes.plot(at, finger[at] + 1, "D", color="white", mec=INK, ms=4)
        moved = " (diamonds: put down anew)"
    axes.set(
        xlabel="node of the path", ylabel="finger", title=f"Fingertips in touch{moved}",
        yticks=range(1, touch.shape[1] + 1), xlim=(-0.5, len(path) - 0.5),
    )  # fmt: skip


def film(
    scene: Scene,
    tree: Tree,
    path: NDArray[np.intp],
    target: Path,
    progress: Callable[[int], None] | None = None,
) -> None:
    """A film of the grasps of a path, one after the other; between them joints are interpolated.

    Args:
        scene: of the tree.
        tree, path: what is filmed.
        target: the mp4 file.
        progress: called with the number of grasps drawn.

    Raises:
        MissingExtra, SimulationError: nothing to draw with.
    """
    from dexctl.sim.record import Recorder

    nodes = tree.nodes.take(path)
    with BatchSimulator(scene, len(path), disturbance=0.0, threads=1) as sim:
        put(sim, nodes)
        qpos = sim.qpos
    pause = np.maximum(np.diff(nodes.cost, prepend=nodes.cost[:1]), _SHORTEST)
    time = np.cumsum(pause) - pause[0]
    with Recorder(scene, target, width=640, height=480) as recorder:
        for i in range(len(path)):
            recorder.caption = f"{tree.header.object}   {nodes.rotation[i]:5.2f} rad"
            recorder(Moment(float(time[i]), qpos[i], nodes.in_contact[i]))
            if progress is not None:
                progress(i + 1)
