"""path_states: grasps of a tree's paths, for episodes to start from (thesis chapter 5, R x R)."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dexctl.exceptions import InvalidInput
from dexctl.planning.holding import holding
from dexctl.planning.tree import Tree
from dexctl.sim.checks import gravity_vector
from dexctl.sim.grasp_states import GraspStates
from dexctl.state import Floats
from dexctl.validation import check_name, check_seed, check_vector, shown_numbers

if TYPE_CHECKING:
    from dexctl.sim import Scene, Simulation


Goals = Literal["greatest", "even"]
Weights = Literal["rotation", "equal"]
GOALS: tuple[Goals, ...] = ("greatest", "even")
WEIGHTS: tuple[Weights, ...] = ("rotation", "equal")
_SAME_GRAVITY = 0.5  # [m/s^2]; 3 degrees
_BIN = 0.1  # rotations that count as one where they are to be even [rad]


def path_states(
    tree: Tree,
    count: int = 20_000,
    *,
    goals: Goals = "greatest",
    weights: Weights = "rotation",
    scene: Scene | None = None,
    threads: int | None = None,
    seed: int = 0,
) -> GraspStates:
    """The grasps on paths from the root to goals, path after path until there are enough.

    Thesis chapter 5, Alg. R x R, lines "extract top trajectories". There, nodes of a path are
    deleted from the tree, which leaves others without parents: here a path ends at the node that an
    earlier one has taken, which leads on to the root, so the parent of each state is a state too.
    The algorithm counts paths (P_max, one of which it never extracts); the thesis's text counts
    states, 2 * 10^4, and so does this.

    Args:
        tree: whose.
        count: how many states are wanted. The last path is taken whole; a tree may have fewer.
        goals: where paths lead, the greatest rotations first (finger gaiting in the thesis) or
            rotations drawn evenly.
        weights: of the states. Trees have many more nodes at one rotation than at another:
            "rotation" makes every rotation as likely to be started from, "equal" every state (the
            thesis's).
        scene: of the tree; states that do not hold in it for 2 s are left out, with what else is
            then without a parent left in. None: all are taken.
        threads: of the physics of that; None: every core.
        seed: of the even goals.

    Raises:
        InvalidInput: no such number, seed, goals or weights; a scene that is not the tree's; or no
            state holds.
    """
    if not isinstance(count, (int, np.integer)) or isinstance(count, bool) or count < 1:
        raise InvalidInput(f"count is {count!r}; expected a whole number above 0")
    check_name("goals", goals, GOALS)
    check_name("weights", weights, WEIGHTS)
    seed = check_seed(seed, 0)
    rows = _rows(tree, int(count), _ends(tree.rotation, goals, np.random.default_rng(seed)))
    tried = len(rows)
    if scene is not None:
        rows = rows[holding(scene, tree, rows, threads=threads)]
        if not len(rows):
            raise InvalidInput(f"none of {tried} states of {tree!r} holds in {scene!r}")
    found = tree.states(rows)
    about = {"tree": json.loads(found.meta), "goals": goals, "weights": weights, "tried": tried}
    weight = _rarity(tree.rotation[rows]) if weights == "rotation" else None
    return replace(found, weight=weight, meta=json.dumps(about))


def begins_under_another(simulation: Simulation) -> str | None:
    """What to know where episodes begin in states that were planned under another gravity."""
    states, config = simulation.starts, simulation.config
    if states is None or config.randomisation.draws_gravity:
        return None
    return other_gravity(states, gravity_vector(config.gravity))


def other_gravity(states: GraspStates, gravity: ArrayLike) -> str | None:
    """What to know where states were planned under another gravity than they are to begin in.

    Args:
        states: whose ``meta`` says it, where they are of a tree, its paths or `sample_grasps`.
        gravity: of the scene, ``(3,)`` [m/s^2].
    """
    given = np.asarray(gravity, float)
    for own in _gravities(states.meta):
        if np.linalg.norm(given - own) > _SAME_GRAVITY:
            return (
                f"the starts were planned under gravity {shown_numbers(own + 0.0)} m/s²; "
                f"this is {shown_numbers(given + 0.0)}"  # no -0
            )
    return None


def _gravities(meta: str) -> list[Floats]:
    """Of the trees and samples that states are from; none where others wrote what they liked."""
    try:
        left, found = [json.loads(meta)], list[Floats]()
    except (ValueError, RecursionError):
        return []
    while left:
        about = left.pop()
        if isinstance(about, list):
            left += about
        elif isinstance(about, dict):
            left += [about.get(name) for name in ("tree", "parts", "meta")]
            with suppress(InvalidInput):
                found.append(check_vector("gravity", about.get("gravity"), 3))
    return found


def _ends(rotation: Floats, goals: Goals, rng: np.random.Generator) -> NDArray[np.intp]:
    """All nodes, in the order that paths are to lead to them."""
    if goals == "greatest":
        return np.argsort(-rotation, kind="stable")
    shuffled = rng.permutation(len(rotation))
    place = np.floor(rotation[shuffled] / _BIN)
    order = np.argsort(place, kind="stable")
    # the first of every bin, then the second of every bin, ...
    starts = np.searchsorted(place[order], place[order])
    turn = np.arange(len(order)) - starts
    return shuffled[order[np.lexsort((rng.uniform(size=len(order)), turn))]]


def _rows(tree: Tree, count: int, ends: NDArray[np.intp]) -> NDArray[np.intp]:
    """Nodes of the paths to ``ends``, parents first, until there are ``count``."""
    parent, taken = tree.parent, np.zeros(len(tree), bool)
    found: list[int] = []
    for end in ends:
        if len(found) >= count:
            break
        path, node = [], int(end)
        while node >= 0 and not taken[node]:
            path.append(node)
            node = int(parent[node])
        taken[path] = True
        found += path[::-1]
    return np.array(found, np.intp)


def _rarity(rotation: Floats) -> Floats:
    """1 / how many have this rotation, ``(S,)``, with a mean of 1."""
    _, place, sizes = np.unique(np.floor(rotation / _BIN), return_inverse=True, return_counts=True)
    weight = 1.0 / sizes[place]
    return weight / weight.mean()
