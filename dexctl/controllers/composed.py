"""Controllers that are made of others by name: steered, regulated, in sequence, as commanded."""

from __future__ import annotations

from typing import Any

import numpy as np

from dexctl.controller import Controller
from dexctl.controllers.making import resolve
from dexctl.controllers.table import ignores
from dexctl.controllers.words import several
from dexctl.exceptions import InvalidInput
from dexctl.hand import HandModel


def steered(
    hand: HandModel,
    *,
    turner: str,
    control_period: float | None = None,
    axis: tuple[float, float, float] | None = None,
    **changes: Any,
) -> Controller:
    """The controller of the name "steered": a `dexctl.gait.GoalSteering` of another one.

    Args:
        hand: the hand.
        turner: who turns the object, as `resolve` takes it.
        control_period, axis: of that one.
        **changes: settings of `GoalSteeringConfig`.

    Raises:
        UnknownName, InvalidInput: no such turner, or a setting is wrong.
    """
    from dexctl.gait import GoalSteering  # the others are loaded when they are made, too

    found = resolve(turner, hand, control_period=control_period, axis=axis)
    return GoalSteering(hand, turner=found, control_period=found.control_period, **changes)


def pursuing(
    hand: HandModel,
    *,
    reacher: str,
    control_period: float | None = None,
    axis: tuple[float, float, float] | None = None,
    **changes: Any,
) -> Controller:
    """The controller of the name "pursuing": a `dexctl.gait.GoalPursuit` of another one.

    Args:
        hand: the hand.
        reacher: who brings the object to a goal, as `resolve` takes it.
        control_period: of that one.
        axis: turned about where a state tells none.
        **changes: settings of `GoalPursuitConfig`.

    Raises:
        UnknownName, InvalidInput: no such controller, one that goes to no goals, or a setting is
            wrong.
    """
    from dexctl.gait import GoalPursuit

    if ignores(reacher, "goal_quaternion"):
        raise InvalidInput(
            f"got {reacher!r}, which goes to no goals; expected a controller that does, "
            "pursuing:NAME, such as pursuing:dex5-cube-goals"
        )
    found = resolve(reacher, hand, control_period=control_period)
    return GoalPursuit(hand, reacher=found, axis=axis, **changes)


def regulated(
    hand: HandModel,
    *,
    turner: str,
    control_period: float | None = None,
    axis: tuple[float, float, float] | None = None,
    **changes: Any,
) -> Controller:
    """The controller of the name "regulated": a `dexctl.gait.RegulatedTurning` of another one.

    Args:
        hand: the hand.
        turner: who turns the object, as `resolve` takes it.
        control_period, axis: of that one.
        **changes: settings of `RegulatedTurningConfig`.

    Raises:
        UnknownName, InvalidInput: no such turner, one that turns about no axis, or a setting is
            wrong.
    """
    from dexctl.gait import RegulatedTurning

    found = resolve(turner, hand, control_period=control_period, axis=axis)
    return RegulatedTurning(hand, turner=found, **changes)


def centred(hand: HandModel, *, height_gain: float = 0.0, **options: Any) -> Controller:
    """The controller of the name "centred": as `regulated`, without the height.

    Touch tells how high an object is less surely than all else of its pose.
    """
    return regulated(hand, height_gain=height_gain, **options)


def sequence(
    hand: HandModel,
    *,
    turners: str,
    control_period: float | None = None,
    **changes: Any,
) -> Controller:
    """The controller of the name "sequence": a `dexctl.gait.GoalSequence` of two other ones.

    Args:
        hand: the hand.
        turners: who turns about the palm's axis, and who across it, as `resolve` takes them, with a
            comma between.
        control_period: of both.
        **changes: settings of `GoalSequenceConfig`.

    Raises:
        UnknownName, InvalidInput: no such controllers, not two, or a setting is wrong.
    """
    from dexctl.gait import GoalSequence

    expected = "two controllers, sequence:ABOUT,ACROSS"
    about, across = _resolved(turners, expected, hand, control_period, count=2)
    axis, other = (getattr(one, "axis", None) for one in (about, across))
    if axis is not None and other is not None and abs(np.dot(axis, other)) > 1e-3:
        # by itself it turns about the same: it is told another one
        least = np.eye(3)[np.abs(axis).argmin()]
        across = resolve(
            several(turners)[1],
            hand,
            control_period=control_period,
            axis=tuple(least - (least @ axis) * np.asarray(axis)),
        )
    return GoalSequence(
        hand, about=about, across=across, control_period=about.control_period, **changes
    )


def commanded(
    hand: HandModel,
    *,
    turners: str,
    control_period: float | None = None,
    axis: tuple[float, float, float] | None = None,
) -> Controller:
    """The controller of the name "commanded": a `dexctl.gait.CommandedTurning` of other ones.

    Args:
        hand: the hand.
        turners: who turns, each about an axis of its own, as `resolve` takes them, with commas
            between.
        control_period: of all.
        axis: told where a state tells none; None: the first turner's.

    Raises:
        UnknownName, InvalidInput: no such controllers, or one that turns about no axis.
    """
    from dexctl.gait import CommandedTurning

    made = _resolved(turners, "controllers, commanded:NAME,...", hand, control_period)
    return CommandedTurning(hand, made, axis=axis)


def _resolved(
    turners: str,
    expected: str,
    hand: HandModel,
    control_period: float | None,
    count: int | None = None,
) -> list[Controller]:
    """The controllers of a list of names with commas between, ``count`` of them where it is set."""
    names = several(turners)
    if "" in names or count not in (None, len(names)):
        raise InvalidInput(f"got {turners!r}; expected {expected}")
    return [resolve(name, hand, control_period=control_period) for name in names]
