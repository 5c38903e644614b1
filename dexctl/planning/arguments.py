"""Arguments of planning: of which classes they are, and what says when a tree is done."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dexctl.exceptions import InvalidInput
from dexctl.planning.bounds import Bounds
from dexctl.planning.expansion import Expansion
from dexctl.planning.goals import GoalOrientations
from dexctl.planning.tree import Tree
from dexctl.sim import SceneConfig
from dexctl.validation import number, shown


def check_kinds(
    *those: tuple[type, str, object], optional: Sequence[type] = (Tree, SceneConfig)
) -> None:
    """Raise InvalidInput where a value is not of its class; None is, where that is optional."""
    for kind, name, value in those:
        if not (isinstance(value, kind) or (value is None and kind in optional)):
            made = ", as Kinematic() is one" if kind is Expansion else ""
            raise InvalidInput(f"{name} is {shown(value)}; expected of class {kind.__name__}{made}")


def check_ends(
    nodes: int | None,
    seconds: float | None,
    until_rotation: float | None,
    bounds: Bounds,
    goals: GoalOrientations,
) -> None:
    """Raise InvalidInput where nothing says when a tree is done, or what does cannot be reached."""
    if nodes is None and seconds is None and until_rotation is None and not len(goals):
        raise InvalidInput(
            "grow is told no end; expected nodes, seconds, until_rotation or goals, or several"
        )
    for name, value in (("nodes", nodes), ("seconds", seconds), ("until_rotation", until_rotation)):
        if value is not None:
            number(name, value, 0.0, np.finfo(float).max, "a number above 0", above=True)
    if until_rotation is not None and until_rotation > bounds.rotation[1] + 0.5:
        raise InvalidInput(
            f"until_rotation is {until_rotation:g}; targets go up to {bounds.rotation[1]:g} rad "
            "(Bounds.rotation)"
        )
