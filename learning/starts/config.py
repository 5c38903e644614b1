"""StartsConfig: where the episodes of a training begin, by name."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal, get_args

from dexctl.planning import ControllerMacros, Expansion, Kinematic, RandomActions, Stability
from dexctl.settings import BY_PATH
from dexctl.validation import check_kind, check_name, check_numbers, check_whole

Name = Literal["fixed", "grasps", "paths", "explored", "gravity"]
NAMES: tuple[Name, ...] = get_args(Name)
Expand = Literal["kinematic", "controllers", "random"]
EXPANDS: tuple[Expand, ...] = get_args(Expand)


@dataclass(frozen=True, kw_only=True)
class TreeConfig:
    """The settings of each way that the tree of paths can be expanded."""

    kinematic: Kinematic = Kinematic()
    controllers: ControllerMacros = ControllerMacros()
    random: RandomActions = RandomActions()


@dataclass(frozen=True, kw_only=True)
class StartsConfig:
    """The reset distribution of a training (thesis chapters 3 and 5).

    Raises:
        UnknownName, InvalidInput: a setting is wrong; the message names it.
    """

    start_from: Name = "fixed"
    """fixed (FI): the settled grasp, or the states of the environments' file. grasps (SGS): sampled
    grasps all over the object. paths (RxR): grasps on the paths of a tree that turns it. explored
    (ER): states that the training has been in. gravity (GC): fixed, with gravity that grows."""
    start_count: int = 20_000
    """How many states there are of grasps, paths and explored; 20,000 in the thesis."""
    start_seconds: float = 120.0
    """Longest time that the tree or the sampled grasps are looked for before the training [s]."""
    tree_expand: Expand = "kinematic"
    """How the tree of paths is expanded: kinematic (contacts without physics; those that do not
    hold are left out), controllers or random (in simulation)."""
    tree_nodes: int = 100_000
    """Nodes of that tree; 100,000 in the thesis."""
    tree: Annotated[TreeConfig, BY_PATH] = TreeConfig()
    stability: Annotated[Stability, BY_PATH] = Stability()
    explored_share: float = 0.5
    """Share of the episodes that begin in an explored state; the others begin fixed."""
    gravity_steps: int = 1_000_000
    """Environment steps over which gravity grows from 0; 50 million in the thesis."""

    def __post_init__(self) -> None:
        check_name("start_from", self.start_from, NAMES)
        check_name("tree_expand", self.tree_expand, EXPANDS)
        check_kind(self, tree=TreeConfig, stability=Stability)
        check_whole(self, start_count=1, tree_nodes=1, gravity_steps=1)
        check_numbers(self, positive=("start_seconds",), fractions=("explored_share",))

    @property
    def expansion(self) -> Expansion:
        """How the tree of paths is expanded, with its settings."""
        known: dict[Expand, Expansion] = {
            "kinematic": self.tree.kinematic,
            "controllers": self.tree.controllers,
            "random": self.tree.random,
        }
        return known[self.tree_expand]
