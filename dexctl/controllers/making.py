"""Controllers from their names and from the words of a command line."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib import import_module
from inspect import Parameter, signature
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dexctl.controller import Controller
from dexctl.controllers.table import POLICIES, entry, is_named, names, split
from dexctl.controllers.words import is_policy_file, paced
from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.hand import HandModel
from dexctl.validation import shown_numbers, unit_axis

_Z = (0.0, 0.0, 1.0)  # the axis of every controller that is not told another one

_SAME_GRAVITY = 0.5  # [m/s^2]; 3 degrees

_FUNCTION = "module:function"


def make(
    name: str,
    hand: HandModel,
    *,
    control_period: float | None = 0.05,
    axis: ArrayLike | None = None,
    **options: Any,
) -> Controller:
    """The controller ``name`` for ``hand``.

    Args:
        name: one of `names`, with what it takes after it (``planned:tree.npz``).
        hand: the hand.
        control_period: time between two calls of ``act`` [s]; None: what the controller's class
            takes by itself, such as the one that a policy was trained with.
        axis: hand frame, ``(3,)``, about which the object is to be turned, at the speed that the
            controller's settings have; None keeps their axis, which is z by default, and a trained
            policy's own, which other axes have to be images of (`learning.policies.load`).
        **options: what else the controller's class takes, settings among it.

    Raises:
        UnknownName: no such controller.
        InvalidInput: a setting out of range or unknown, or an axis other than z for a controller of
            another package that does not take one.
        RoomShadowed: another package shadows the one that it is of.
    """
    found = entry(name)
    kind = found.load()
    taken, more = _keywords(kind)
    after = split(name)[1]
    if after:
        options[found.keyword] = after
    elif found.keyword and found.keyword not in options:
        raise InvalidInput(f"controller {name!r} needs more; expected {found.name}:{found.wanted}")
    if control_period is not None:
        options["control_period"] = control_period
    if axis is not None:
        unit = unit_axis(axis)
        if "axis" in taken:
            options["axis"] = unit
        elif unit != _Z:
            raise InvalidInput(
                f"controller {name!r} cannot be turned to the axis {axis}: it takes no keyword axis"
            )
    unknown = [option for option in options if option not in taken]
    if unknown and not more:
        raise InvalidInput(
            f"controller {name!r} does not take {', '.join(unknown)}; known: {', '.join(taken)}"
        )
    return kind(hand, **options)


def resolve(
    name: str,
    hand: HandModel,
    *,
    control_period: float | None = None,
    axis: tuple[float, float, float] | None = None,
) -> Controller:
    """The controller that a word on the command line means.

    Args:
        name: a controller by name, as `make` takes it, a policy by name (``dex5-cylinder``), a
            policy file (``.npz``) or a run folder, these three with a pace (``dex5-cylinder@0.8``)
            or without, or ``module:function``, which is called as
            ``function(hand, control_period=..., axis=...)``, without what is None; one that takes
            no axis turns about z.
        hand: the hand.
        control_period: time between two calls of ``act`` [s]; None: what the controller's class
            takes by itself, and a policy what it was trained with.
        axis: see `make`.

    Raises:
        UnknownName: it is none of these.
        InvalidInput: a damaged or missing file, a policy for another hand or period, or a function
            that cannot be called so, takes no axis but is given one other than z, or makes
            something else than a controller.
        RoomShadowed: it needs a package of dexctl's that another one shadows.
    """
    if is_named(name) and name != POLICIES:
        return make(name, hand, control_period=control_period, axis=axis)
    is_file = is_policy_file(name)
    if ":" in name and not is_file:
        return _called(name, hand, {"control_period": control_period, "axis": axis})
    plain, pace = paced(name)
    if plain not in (name, POLICIES) and is_named(plain):
        raise InvalidInput(
            f"controller is {name!r}; expected {plain!r}: only policies have a pace, controllers "
            "have settings"
        )
    if POLICIES not in names():
        if is_file or plain == POLICIES:
            raise InvalidInput(f"{name}: policies need dexctl to be installed (pip install)")
        raise UnknownName("controller", name, (*names(), _FUNCTION))
    which = {"policy": None, "pace": pace} if plain == POLICIES else {"policy": name}
    try:
        return make(POLICIES, hand, control_period=control_period, axis=axis, **which)
    except UnknownName as error:
        if error.kind != "policy":
            raise
        raise UnknownName("controller", name, (*names(), *error.known, _FUNCTION)) from None


def made_for_another(
    name: str, controller: Controller, objects: Sequence[str], gravity: ArrayLike
) -> str | None:
    """What to know where a controller was made for another object or gravity than it is given.

    Args:
        name: what it is called.
        controller: which.
        objects: names of what it is to turn.
        gravity: under which, hand frame, ``(3,)`` [m/s^2].
    """
    others = [one for one in objects if controller.object not in (None, one)]
    if others:
        return f"{name} is made for the object {controller.object}; this is {', '.join(others)}"
    given = np.asarray(gravity, float) + 0.0  # no -0
    own = given if controller.gravity is None else np.array(controller.gravity)
    if np.linalg.norm(given - own) <= _SAME_GRAVITY:
        return None
    return f"{name} is made for gravity {shown_numbers(own)} m/s²; this is {shown_numbers(given)}"


def _keywords(kind: Callable[..., Controller]) -> tuple[list[str], bool]:
    """The keywords that a controller's class or function names, and whether it takes others too."""
    parameters = list(signature(kind).parameters.values())[1:]  # the first is the hand
    named = (Parameter.POSITIONAL_OR_KEYWORD, Parameter.KEYWORD_ONLY)
    return (
        [one.name for one in parameters if one.kind in named],
        any(one.kind is Parameter.VAR_KEYWORD for one in parameters),
    )


def _called(name: str, hand: HandModel, options: dict[str, Any]) -> Controller:
    """What ``module:function`` makes."""
    module, _, attribute = name.partition(":")
    try:
        function = getattr(import_module(module), attribute)
        takes = signature(function)
    except (ImportError, AttributeError, TypeError, ValueError) as error:
        raise InvalidInput(f"controller is {name!r}; it cannot be loaded: {error}") from None
    given = {key: value for key, value in options.items() if value is not None}
    kinds = {parameter.kind for parameter in takes.parameters.values()}
    if "axis" not in takes.parameters and Parameter.VAR_KEYWORD not in kinds:
        axis = given.pop("axis", None)
        if axis is not None and tuple(axis) != _Z:
            raise InvalidInput(f"{name} takes no axis, so it turns about z; got {axis}")
    try:
        takes.bind(hand, **given)
    except TypeError as error:
        with_what = "".join(f", {key}=..." for key in given)
        raise InvalidInput(f"{name} cannot be called as (hand{with_what}): {error}") from None
    made = function(hand, **given)
    if not isinstance(made, Controller):
        raise InvalidInput(f"{name} made a {type(made).__name__}; expected a dexctl.Controller")
    return made
