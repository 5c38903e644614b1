"""GuidanceConfig: how controllers guide the exploration."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple, Self, get_args

from dexctl import controllers
from dexctl.exceptions import InvalidInput
from dexctl.validation import check_name, check_numbers, check_whole

Method = Literal["rl", "rl+bc", "fge", "vge", "vge+bc"]
METHODS: tuple[str, ...] = get_args(Method)


@dataclass(frozen=True, kw_only=True)
class GuidanceConfig:
    """How the controllers guide the exploration.

    Raises:
        UnknownName, InvalidInput: a setting is wrong; the message names it.
    """

    method: Method = "vge"
    """rl: no controllers. rl+bc: they label the states that the policy visits. fge: chosen on a
    fixed schedule (fixed guided exploration). vge: chosen by value (value guided exploration).
    vge+bc: and the policy imitates what they did."""
    alone: float = 0.0
    """Share of the environments in which the policy acts by itself from the first step on, as it
    will at last: critics learn from its own drops before the hard stop, and a curriculum has
    something to judge by. None in the thesis."""
    horizon: int | None = None
    """Steps that a choice of who acts holds for (H); none: as long as the controller's own motion,
    and as the longest of them for the policy."""
    hard_stop: int | None = 4_000_000
    """Controllers are asked no more from this environment step on; 4 million in the thesis; none:
    they are asked to the end."""
    temperature: float = 1.0
    """Temperature of VGE's choice by value; 1 is the thesis's."""
    fixed_start: float = 1.0
    """FGE's share of the controllers at step 0; it falls linearly to 0 at the hard stop, and stays
    where there is none. The thesis gives no numbers."""
    beta: float = 0.1
    """Weight of behaviour cloning at step 0; it falls linearly."""
    beta_end: float = 0.0
    """What the weight of behaviour cloning falls to; 0 in the thesis."""
    beta_stop: int | None = None
    """The step at which the weight has fallen; none: the hard stop."""
    cloned: Literal["acted", "visited"] | None = None
    """What the methods with bc imitate: acted, the controllers' actions in the steps that they did
    (the thesis's VGE+BC); visited, what the first controller would do in every state that comes
    about, whoever acts (as in dataset aggregation; Ross et al. 2011), the only one that RL+BC
    knows; none: the method's."""
    cloning: Literal["likelihood", "squared"] = "likelihood"
    """likelihood, the thesis's; or the squared distance between the policy's mean action and the
    controller's, the only one that TD3 knows."""
    cloning_weight: Literal["value", "equal", "better"] = "value"
    """Of each imitated action: value, max(Q, 0) as in the thesis; equal, 1, with the actor's own
    loss divided by the mean |Q| (Fujimoto and Gu 2021), so that beta means the same however large
    values are; better, 1 where the critics prefer the controller's action to the policy's, else 0
    (Nair et al. 2018)."""

    def __post_init__(self) -> None:
        for name, known in (
            ("method", METHODS),
            ("cloned", (None, "acted", "visited")),
            ("cloning", ("likelihood", "squared")),
            ("cloning_weight", ("value", "equal", "better")),
        ):
            check_name(name, getattr(self, name), known)
        if self.cloned == "acted" and self.method == "rl+bc":
            raise InvalidInput("cloned is 'acted', and no controller acts in the method 'rl+bc'")
        if self.horizon is not None:
            check_whole(self, horizon=1)
        if self.beta_stop is not None:
            check_whole(self, beta_stop=1)
        if self.hard_stop is not None:
            check_whole(self, hard_stop=0)
        check_numbers(
            self,
            positive=("temperature",),
            not_negative=("beta", "beta_end"),
            fractions=("fixed_start", "alone"),
        )

    @property
    def labels_all(self) -> bool:
        """Whether every state is labelled with what the first controller would do."""
        return self.imitates and (self.method == "rl+bc" or self.cloned == "visited")

    @property
    def follows(self) -> bool:
        """Whether controllers act."""
        return self.method in ("fge", "vge", "vge+bc")

    @property
    def imitates(self) -> bool:
        """Whether the policy is cloned from them."""
        return self.method.endswith("+bc")


class Guiding(NamedTuple):
    """Who guides, and with which objects: ``NAME``, or ``OBJECT,...=NAME``.

    Attributes:
        controller: its name, or that of a policy.
        objects: that it guides with; empty: with all.
    """

    controller: str
    objects: tuple[str, ...] = ()

    @classmethod
    def of(cls, text: str) -> Self:
        """What ``text`` says."""
        found = re.fullmatch(r"(\w+(?:,\w+)*)=(.+)", text)
        return cls(text) if found is None else cls(found[2], tuple(found[1].split(",")))

    def __str__(self) -> str:
        return f"{','.join(self.objects)}={self.controller}" if self.objects else self.controller


def absolute_guides(names: tuple[str, ...], folder: Path) -> tuple[str, ...]:
    """Who guides, with absolute paths for the files in it, which are meant from ``folder``."""
    guides = [Guiding.of(name) for name in names]
    return tuple(
        str(guide._replace(controller=controllers.absolute(guide.controller, folder)))
        for guide in guides
    )


def check_controllers(method: str, names: Sequence[str]) -> None:
    """Raise InvalidInput where a method has more or fewer controllers than it can use."""
    if method != "rl" and not names:
        raise InvalidInput(f"method {method!r} got no controllers; expected one or more")
    guides = [Guiding.of(name) for name in names]
    if method == "rl+bc" and len(guides) > 1:
        counts = Counter(name for one in guides for name in one.objects)
        if not all(one.objects for one in guides) or max(counts.values()) > 1:
            raise InvalidInput(
                f"method 'rl+bc' has the controllers {', '.join(names)} at once; it takes one, or "
                "one for each object (OBJECT,...=NAME)"
            )
