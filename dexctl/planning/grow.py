"""Growing trees: targets, nearest nodes, expansion, and a file that is always whole."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from dexctl.exceptions import InvalidInput
from dexctl.files import make_parent
from dexctl.planning.arguments import check_ends, check_kinds
from dexctl.planning.bounds import Bounds
from dexctl.planning.expansion import Expansion, Problem
from dexctl.planning.goals import GoalOrientations
from dexctl.planning.header import TreeHeader
from dexctl.planning.metric import Metric, Nearest
from dexctl.planning.nodes import Frame, root_of
from dexctl.planning.scene_settings import Stepping
from dexctl.planning.stability import Stability
from dexctl.planning.tree import Tree
from dexctl.settings import absolute, to_plain
from dexctl.sim import SceneConfig
from dexctl.validation import check_seed

if TYPE_CHECKING:
    from dexctl.sim import Scene

_STUCK = 3000  # expansions of the root without a node beyond it: it is given up
_BLOCK = 10.0  # the file is written anew after this long, and never for more than a tenth of it [s]


class Progress(NamedTuple):
    """How far a tree has come.

    Attributes:
        nodes: how many it has.
        expansions: how many were tried.
        rotation: the greatest of its nodes [rad].
        seconds: since `grow` began [s].
        refused: why candidates were not taken in, and how many.
        physics_steps: that were simulated.
        first: how many nodes there were when it began, or began to go on.
    """

    nodes: int
    expansions: int
    rotation: float
    seconds: float
    refused: dict[str, int]
    physics_steps: int
    first: int


def grow(
    scene: Scene,
    expansion: Expansion,
    *,
    nodes: int | None = None,
    seconds: float | None = None,
    until_rotation: float | None = None,
    goals: GoalOrientations | None = None,
    axis: ArrayLike = (0.0, 0.0, 1.0),
    seed: int = 0,
    metric: Metric | None = None,
    bounds: Bounds | None = None,
    stability: Stability | None = None,
    threads: int | None = None,
    tree: Tree | None = None,
    scene_config: SceneConfig | None = None,
    path: str | Path | None = None,
    progress: Callable[[Progress], object] | None = None,
) -> Tree:
    """Grow a tree of grasps from the settled one (thesis chapter 5, Alg. G-RRT).

    A random point of the state space is drawn, the nearest node is expanded towards it, and what
    holds becomes its child; a batch of points at a time. It stops at whichever comes first of
    ``nodes``, ``seconds``, ``until_rotation`` and a node near each of the goals.

    Args:
        scene: hand, object and gravity.
        expansion: `RandomActions`, `ControllerMacros` or `Kinematic`.
        nodes: how many are wanted.
        seconds: of wall time.
        until_rotation: of some node about the axis [rad].
        goals: orientations to be reached; None: it is only turned about the axis.
        axis: of the rotation, hand frame, ``(3,)`` or by name.
        seed: the same seed, batch and number of expansions give the same tree.
        metric, bounds, stability: None: their defaults.
        threads: of the physics; None: every core.
        scene_config: what the scene was built from, for the tree's header and for how the physics
            is stepped; None: not known, or what ``tree`` was grown in. `check_used` says which
            other settings of it are of no effect.
        tree: one to go on with, grown with the same settings; its own seed and counts are
            continued.
        path: where the tree is written, at the start, every few seconds and at the end, however
            that comes (Ctrl-C too): a killed process loses the last block of some seconds, no more.
        progress: called after every batch; where it returns True, the tree is left as it is.

    Raises:
        InvalidInput: nothing says when to stop, ``path`` cannot be written, a goal has the axis
            upside down, a tree of another hand, object or gravity, or of other settings; or no
            grasp was reached from the root in 3,000 expansions.
        SimulationError: the object does not stay in the hand.
    """
    from dexctl.sim import Scene

    path = None if path is None else make_parent(path)
    metric = Metric() if metric is None else metric
    bounds = Bounds() if bounds is None else bounds
    stability = Stability() if stability is None else stability
    goals = GoalOrientations() if goals is None else goals
    check_kinds(
        (Scene, "scene", scene), (Expansion, "expansion", expansion), (Metric, "metric", metric),
        (Bounds, "bounds", bounds), (Stability, "stability", stability),
        (GoalOrientations, "goals", goals), (Tree, "tree", tree),
        (SceneConfig, "scene_config", scene_config),
    )  # fmt: skip
    seed = check_seed(seed, 0)
    check_ends(nodes, seconds, until_rotation, bounds, goals)
    root = root_of(scene)
    frame = Frame.of(axis, root)
    bounds = goals.widened(bounds, frame)
    problem = Problem(
        scene=scene,
        root=root,
        frame=frame,
        metric=metric,
        bounds=bounds,
        stability=stability,
        threads=threads,
        stepping=Stepping.of(
            scene_config if scene_config is not None or tree is None else tree.header.scene
        ),
    )
    # one that is refused is none, and never written to the path
    expander, given, tree = expansion.open(problem), tree, None
    try:
        tree = _begin(problem, expansion, goals, expander.action_names, seed, scene_config, given)
        if path is not None and given is None:  # what is stopped at once can be resumed too
            tree.save(path)
        before, first = tree.header.expansions, len(tree)
        search = Nearest(len(scene.hand.joint_names) + 6)
        search.add(problem.metric.of(problem.frame, tree.nodes))
        limits = (np.asarray(scene.lower), np.asarray(scene.upper))
        start = saved = perf_counter()
        spent = tree.header.seconds
        wait = _BLOCK
        best = float(tree.rotation.max())
        away = goals.away(tree.nodes.object_quaternion)
        while not (
            (nodes is not None and len(tree) >= nodes)
            or (until_rotation is not None and best >= until_rotation)
            or (len(goals) and away.max() <= goals.angle)
            or (seconds is not None and perf_counter() - start >= seconds)
        ):
            # a generator of the number of expansions: a tree that is resumed goes on as it would
            header = tree.header
            rng = np.random.default_rng([header.seed % 2**63, header.expansions])
            targets = bounds.targets(
                problem.frame, problem.metric, root.q[0], limits, rng, expander.batch
            )
            targets = goals.drawn(problem.frame, problem.metric, targets, rng)
            near = search(targets)
            found = expander(tree.nodes.take(near), targets, rng)
            header.expansions += expander.batch
            header.physics_steps += found.physics_steps
            header.refused = dict(Counter(header.refused) + Counter(found.refused))
            header.seconds = spent + perf_counter() - start
            count = len(found.nodes)
            tree.append(
                found.nodes, near[found.source], found.action, np.full(count, header.expansions)
            )
            if count:
                search.add(problem.metric.of(problem.frame, found.nodes))
                best = max(best, float(found.nodes.rotation.max()))
                away = np.minimum(away, goals.away(found.nodes.object_quaternion))
            if progress is not None:
                told = progress(
                    Progress(
                        len(tree),
                        header.expansions,
                        best,
                        perf_counter() - start,
                        header.refused,
                        header.physics_steps,
                        first,
                    )
                )
                if told is True:
                    break
            if len(tree) == 1 and header.expansions - before >= _STUCK:
                raise InvalidInput(stuck(tree))
            if path is not None and perf_counter() - saved > wait:
                began = perf_counter()
                tree.save(path)
                saved = perf_counter()
                wait = max(_BLOCK, 10 * (saved - began))
        return tree
    finally:
        expander.close()
        if path is not None and tree is not None:
            tree.save(path)


def stuck(tree: Tree) -> str:
    """Of a tree that has nothing but its root: that it is so, and what was in the way."""
    header = tree.header
    most = sorted(header.refused.items(), key=lambda one: -one[1])
    why = " and ".join(f"{name} ({count})" for name, count in most[:2] if count)
    return (
        f"no grasp of the {header.object} was reached from the settled one in {header.expansions} "
        f"expansions{why and f', refused most for {why}'}; expected another way to expand, other "
        f"settings of {header.expansion}, or another object"
    )


def _begin(
    problem: Problem,
    expansion: Expansion,
    goals: GoalOrientations,
    action_names: tuple[str, ...],
    seed: int,
    scene_config: SceneConfig | None,
    tree: Tree | None,
) -> Tree:
    """A new tree, or the one that is to go on, where it is of this problem."""
    settings = {
        "expansion": expansion,
        "goals": goals,  # before the bounds, which are as wide as they ask for
        "metric": problem.metric,
        "bounds": problem.bounds,
        "stability": problem.stability,
    }
    header = TreeHeader.of(
        problem.scene,
        problem.frame.axis,
        type(expansion).__name__,
        action_names,
        {name: to_plain(value) for name, value in settings.items()},
        seed,
    )
    if scene_config is not None:  # its files are found from any folder
        header.scene = to_plain(absolute(scene_config, Path.cwd()))
    if tree is None:
        return Tree(header, problem.root)
    tree.header.check_same(header)
    tree.header.check_settings(settings)
    tree.check_hand(problem.scene.hand)
    if not np.allclose(tree.nodes.q[0], problem.root.q[0], atol=1e-6):
        raise InvalidInput("the tree has another root than the scene's settled grasp")
    tree.header.scene = header.scene or tree.header.scene
    return tree
