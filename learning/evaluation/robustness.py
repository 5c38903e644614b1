"""Robustness: how much worse it gets with noisy sensors and with forces on the object.

The thesis (chapter 3, fig. robustness) adds white noise of growing variance to each sensor's
feedback, and growing forces on the object. Its noise of normals is of their coordinates; here
they are tilted, by angles of the same numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

from dexctl.controller import Controller
from dexctl.exceptions import UnknownName
from dexctl.settings import changed, get, leaves
from dexctl.sim.sensing import NOISES
from learning.evaluation.figures import Evaluation
from learning.evaluation.protocol import Protocol
from learning.evaluation.rollout import Run, evaluate
from learning.evaluation.subject import Subject

KINDS = (*NOISES, "push_force")
"""Kinds of disturbance, by the names of their settings."""
LEVELS: Mapping[str, tuple[float, ...]] = {
    "joint_noise": (0.025, 0.05, 0.075, 0.1),  # [rad]
    "position_noise": (0.0025, 0.005, 0.0075, 0.01),  # [m]
    "normal_noise": (0.125, 0.25, 0.375, 0.5),  # [rad]
    "force_noise_share": (0.125, 0.25, 0.375, 0.5),
    "push_force": (0.5, 1.0, 1.5, 2.0),  # [N]
}
"""What the thesis's figure goes up to, in four steps."""


class Disturbance(NamedTuple):
    """One kind of disturbance at one level.

    Attributes:
        kind: one of `KINDS`; "" for none.
        level: in the unit of that setting.
    """

    kind: str
    level: float


def levels_of(protocol: Protocol) -> dict[str, float]:
    """The level of every kind of disturbance."""
    return {kind: get(protocol, leaves(Protocol)[kind]) for kind in KINDS}


def disturbance(protocol: Protocol, base: Protocol) -> Disturbance:
    """What `protocols` has made of ``base`` in ``protocol``: none in ``base`` itself."""
    own = levels_of(base)
    found = (Disturbance(*one) for one in levels_of(protocol).items() if one[1] != own[one[0]])
    return next(found, Disturbance("", 0.0))


def protocols(base: Protocol, levels: Mapping[str, tuple[float, ...]] = LEVELS) -> list[Protocol]:
    """``base`` as it is, then with each kind of disturbance at each level.

    What ``base`` has of a kind is replaced where that is disturbed, and stays where another is;
    levels that are no more than it has itself are left out.

    Raises:
        UnknownName: no such kind of disturbance.
        InvalidInput: a level below zero.
    """
    for kind in levels:
        if kind not in KINDS:
            raise UnknownName("disturbance", kind, KINDS)
    own = levels_of(base)
    every = [(k, changed(base, {k: level})) for k, row in levels.items() for level in row]
    return [base, *(one for kind, one in every if levels_of(one)[kind] > own[kind])]


def robustness(
    who: Subject | Controller,
    protocol: Protocol | None = None,
    levels: Mapping[str, tuple[float, ...]] = LEVELS,
    *,
    object: str | None = None,  # noqa: A002 (the setting's name)
    run: Run = evaluate,
    progress: Callable[[int, int], None] | None = None,
) -> list[Evaluation]:
    """Evaluations by the protocol as it is, then with each kind of disturbance at each level.

    Args:
        who, protocol, object: as `rollout`'s; see `protocols`.
        levels: by kind, see `Disturbance`.
        run: evaluates; a `learning.evaluation.store.EvaluationStore` keeps what is finished.
        progress: called after each evaluation with how many are done, and of how many.

    Raises:
        UnknownName: no such kind of disturbance, or no such object.
    """
    every = protocols(protocol or Protocol(), levels)
    found = []
    for one in every:
        found.append(run(who, one, object=object))
        if progress is not None:
            progress(len(found), len(every))
    return found
