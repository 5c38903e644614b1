"""Robustness: how much worse it gets with noisy sensors and with forces on the object.

The thesis (chapter 3, fig. robustness) adds white noise of growing variance to each sensor's
feedback, and growing forces on the object.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import NamedTuple

from dexctl.controller import Controller
from dexctl.exceptions import UnknownName
from learning.envs.noise import SensorNoise
from learning.evaluate import Evaluation, Protocol, Run, evaluate

# What the thesis's figure goes up to, in four steps.
LEVELS: Mapping[str, tuple[float, ...]] = {
    "joint": (0.025, 0.05, 0.075, 0.1),  # [rad]
    "position": (0.0025, 0.005, 0.0075, 0.01),  # [m]
    "normal": (0.125, 0.25, 0.375, 0.5),
    "force": (0.125, 0.25, 0.375, 0.5),
    "push": (0.5, 1.0, 1.5, 2.0),  # [N], on the object
}


class Disturbance(NamedTuple):
    """One kind of disturbance at one level.

    Attributes:
        kind: field of `SensorNoise`, "push" for the force on the object, "" for none.
        level: standard deviation, or size of the force [N].
    """

    kind: str
    level: float


def protocols(base: Protocol, levels: Mapping[str, tuple[float, ...]] = LEVELS) -> list[Protocol]:
    """``base`` undisturbed, then with each kind of disturbance at each level.

    Raises:
        UnknownName: no such kind of disturbance.
        InvalidInput: a level below zero.
    """
    kinds = [*SensorNoise.__dataclass_fields__, "push"]
    base = replace(base, noise=SensorNoise(), push=replace(base.push, force=0.0))
    found = [base]
    for kind, row in levels.items():
        if kind not in kinds:
            raise UnknownName("disturbance", kind, kinds)
        for level in row:
            if kind == "push":
                found.append(replace(base, push=replace(base.push, force=level)))
            else:
                found.append(replace(base, noise=SensorNoise(**{kind: level})))
    return found


def disturbance(protocol: Protocol) -> Disturbance:
    """What `protocols` has changed."""
    for kind in protocol.noise.__dataclass_fields__:
        if level := getattr(protocol.noise, kind):
            return Disturbance(kind, level)
    return Disturbance("push", protocol.push.force) if protocol.push else Disturbance("", 0.0)


def robustness(
    controller: Controller,
    object: str,  # noqa: A002 (the field's name for it)
    protocol: Protocol | None = None,
    levels: Mapping[str, tuple[float, ...]] = LEVELS,
    *,
    run: Run = evaluate,
    progress: Callable[[int, int], None] | None = None,
) -> list[Evaluation]:
    """Evaluations undisturbed, then with each kind of disturbance at each level.

    Args:
        controller, object, protocol: as `evaluate`'s; the protocol's own noise and force are
            replaced.
        levels: by kind, see `Disturbance`.
        run: evaluates; a `learning.evaluation_store.EvaluationStore` keeps what is finished.
        progress: called after each evaluation with how many are done, and of how many.

    Raises:
        UnknownName: no such kind of disturbance, or no such object.
    """
    every = protocols(protocol or Protocol(), levels)
    found = []
    for one in every:
        found.append(run(controller, object, one))
        if progress is not None:
            progress(len(found), len(every))
    return found
