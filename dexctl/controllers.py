"""The controllers by name, for the command line, benchmarks and configuration files.

dexctl's own stand in a table. Other packages add theirs through the entry-point group
``dexctl.controllers``: the name is the controller's, the object is called as ``object(hand,
control_period=..., **options)``, without ``control_period`` where the controller may choose, and
returns the `Controller`. One that names a keyword ``axis`` can be told about which axis to turn the
object; any other turns about z. It is loaded when it is made, not before.

A controller that needs a file, or another controller, has it after its name:
``planned:tree.npz``, ``steered:goal``, ``sequence:dex5-cube-z,dex5-cube-x``. A policy has its pace
there, where it is to go slower than it was trained to: ``dex5-robust@0.8``.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from inspect import Parameter, signature
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike

from dexctl.controller import Controller, check_state
from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.hand import HandModel
from dexctl.rooms import check_room
from dexctl.state import Floats, GraspState
from dexctl.validation import unit_axis


@final
class Hold(Controller):
    """Leaves the set-points where they are: what the grasp does by itself, for comparison.

    Args:
        hand: the hand.
        control_period: [s].
        axis: whichever; it does not turn.
    """

    def __init__(
        self, hand: HandModel, *, control_period: float = 0.05, axis: ArrayLike | None = None
    ) -> None:
        super().__init__(hand, control_period=control_period)

    def reset(self, seed: ArrayLike | None = None, mask: ArrayLike | None = None) -> None:
        """Nothing to forget."""

    def state_dict(self) -> dict[str, Any]:
        return self._signed()

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        self._parts(saved)

    def act(self, state: GraspState) -> Floats:
        check_state(self.hand, state)
        return np.zeros_like(state.q_target)


@dataclass(frozen=True, kw_only=True)
class ControllerEntry:
    """A controller that has a name.

    Attributes:
        name: what `make` takes.
        title: what people read.
        description: one line.
        module, attribute: where the class is.
        keyword: that takes what stands after the name and a colon; "": none does.
        wanted: what that is, ...
        others: ... and whether it is other controllers, with commas between.
        follows: what of a state tells it what is wanted, beside the axis that it is made for; None:
            nobody knows.
    """

    name: str
    title: str
    description: str
    module: str
    attribute: str
    keyword: str = ""
    wanted: str = "FILE"
    others: bool = False
    follows: tuple[str, ...] | None = None

    def load(self) -> Callable[..., Controller]:
        """The controller's class, or what another package registered in its place.

        Raises:
            RoomShadowed: it is of a package of dexctl's that another one shadows.
        """
        check_room(self.module)
        return getattr(import_module(self.module), self.attribute)


_CONTROLLERS = {
    entry.name: entry
    for entry in (
        ControllerEntry(
            name="igm",
            title="in-grasp manipulation",
            description="turns the object with all fingers, without letting go (psi_IGM)",
            module="dexctl.igm",
            attribute="InGraspManipulation",
            follows=(),
        ),
        ControllerEntry(
            name="switch",
            title="contact switching",
            description="lifts one finger after the other and puts it back (psi_CS)",
            module="dexctl.switch",
            attribute="ContactSwitch",
            follows=(),
        ),
        ControllerEntry(
            name="gait",
            title="gaiting, random finger",
            description="the thesis gait: both at once, the finger chosen at random (psi_FG)",
            module="dexctl.gait",
            attribute="FingerGaiting",
            follows=(),
        ),
        ControllerEntry(
            name="coordinated",
            title="coordinated gait",
            description="gaiting that chooses finger and moment, and keeps the grasp closed",
            module="dexctl.gait",
            attribute="CoordinatedGait",
            follows=(),
        ),
        ControllerEntry(
            name="goal",
            title="gait to a goal",
            description="brings the object to a goal orientation: gaits about one axis, then tilts",
            module="dexctl.gait",
            attribute="GoalGait",
            follows=("goal_quaternion", "goal_angular_velocity"),
        ),
        ControllerEntry(
            name="steered",
            title="steered to a goal",
            description="has another controller, steered:NAME, turn the object to a goal",
            module="dexctl.controllers",
            attribute="steered",
            keyword="turner",
            wanted="NAME",
            others=True,
            follows=("goal_quaternion",),
        ),
        ControllerEntry(
            name="sequence",
            title="sequence to a goal",
            description="has two controllers, sequence:ABOUT,ACROSS, turn the object to a goal",
            module="dexctl.controllers",
            attribute="sequence",
            keyword="turners",
            wanted="ABOUT,ACROSS",
            others=True,
            follows=("goal_quaternion",),
        ),
        ControllerEntry(
            name="commanded",
            title="turning as commanded",
            description="turns about any axis told, by commanded:NAME,... made for one axis each",
            module="dexctl.controllers",
            attribute="commanded",
            keyword="turners",
            wanted="NAME,...",
            others=True,
            follows=("goal_angular_velocity",),
        ),
        ControllerEntry(
            name="planned",
            title="planned gait",
            description="follows a tree of grasps, planned:FILE, that dexctl plan has grown",
            module="dexctl.planning.following",
            attribute="PlannedGait",
            keyword="tree",
            follows=(),
        ),
        ControllerEntry(
            name="hold",
            title="hold still",
            description="keeps the set-points, for comparison",
            module="dexctl.controllers",
            attribute="Hold",
            follows=(),
        ),
    )
}


GROUP = "dexctl.controllers"
Z = (0.0, 0.0, 1.0)  # the axis of every controller that is not told another one

POLICIES = "learned"
"""The name whose object takes policies: ``object(hand, policy=NAME, FILE or FOLDER)``."""
_FUNCTION = "module:function"
_PACE = re.compile(r"\d+(\.\d*)?|\.\d+")

# words for a name that comes with dexctl, whose object is of another room
_WORDS = {
    POLICIES: ("learned gait", "a policy that was trained with the controllers as its guides")
}


@cache
def _known() -> dict[str, ControllerEntry]:
    """All controllers; a name of dexctl's own cannot be taken over by another package."""
    found = dict(_CONTROLLERS)
    for point in sorted(entry_points(group=GROUP), key=lambda point: point.name):
        package = point.module.partition(".")[0]
        words = point.name.replace("_", " "), f"of the package {package}"
        title, description = _WORDS.get(point.name, words) if package == "learning" else words
        found.setdefault(
            point.name,
            ControllerEntry(
                name=point.name,
                title=title,
                description=description,
                module=point.module,
                attribute=point.attr,
            ),
        )
    return found


def names() -> tuple[str, ...]:
    """The names that `make` takes."""
    return tuple(_known())


def entry(name: str) -> ControllerEntry:
    """What is known of a controller by name, with what stands after it or not.

    Raises:
        UnknownName: no such controller.
    """
    known = _known()
    if not is_named(name):
        raise UnknownName("controller", name, known)
    return known[_split(name)[0]]


def is_named(name: str) -> bool:
    """Whether it is one of `names`, with what stands after it where that controller takes it."""
    found = _known().get(_split(name)[0])
    return found is not None and (found.name == name or bool(found.keyword))


def keeps_period(name: str) -> bool:
    """Whether it may have a control period of its own, or is of others that may.

    Policies have that of their training, and nobody knows of other packages' controllers; those of
    this package take any.
    """
    if not is_named(name):
        return True
    found = entry(name)
    if found.others:
        return any(keeps_period(one) for one in _several(_split(name)[1]))
    return not found.module.startswith("dexctl.")


def paced(name: str, folder: Path | None = None) -> tuple[str, float]:
    """A policy's name, file or folder without the pace behind it, and the pace; 1 without one.

    It may be out of range: who makes the policy says so.

    Args:
        name: the word; what is there by all of it, a folder ``run@1``, has no pace.
        folder: where it is meant from; None: the current one.
    """
    plain, _, pace = name.rpartition("@")
    if not plain or not _PACE.fullmatch(pace) or _place(name, folder).exists():
        return name, 1.0
    return plain, float(pace)


def _place(name: str, folder: Path | None) -> Path:
    return (folder or Path()) / Path(name).expanduser()


def is_policy_file(name: str, folder: Path | None = None) -> bool:
    """Whether a word is a policy file, or a folder that is there, and no other name.

    Args:
        name: the word, with a pace or without.
        folder: where it is meant from; None: the current one.
    """
    plain = paced(name, folder)[0]
    return plain.endswith(".npz") or _place(plain, folder).is_dir()


def absolute(name: str, folder: Path) -> str:
    """A word that `resolve` takes, with absolute paths for the files in it, meant from ``folder``.

    So what is written down holds wherever it is read.
    """

    def place(file: str) -> str:
        return str(_place(file, folder).resolve())

    if not is_named(name):
        plain = paced(name, folder)[0]
        return place(plain) + name[len(plain) :] if is_policy_file(name, folder) else name
    found, (plain, after) = entry(name), _split(name)
    if not after:
        return name
    if found.others:
        return f"{plain}:{','.join(absolute(one, folder) for one in _several(after))}"
    return f"{plain}:{place(after)}"


def label(name: str) -> str:
    """A controller's name as part of a folder's: what stands after it may have slashes."""
    return re.sub(r"[^\w.-]+", "-", name)


def _split(name: str) -> tuple[str, str]:
    """The name of a controller, and what stands after it."""
    plain, _, after = str(name).partition(":")
    return plain, after


def _several(after: str) -> list[str]:
    """Names with commas between them."""
    return [name.strip() for name in after.split(",")]


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
    after = _split(name)[1]
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
        elif unit != Z:
            raise InvalidInput(
                f"controller {name!r} cannot be turned to the axis {axis}: it takes no keyword axis"
            )
    unknown = [option for option in options if option not in taken]
    if unknown and not more:
        raise InvalidInput(
            f"controller {name!r} does not take {', '.join(unknown)}; known: {', '.join(taken)}"
        )
    return kind(hand, **options)


def _keywords(kind: Callable[..., Controller]) -> tuple[list[str], bool]:
    """The keywords that a controller's class or function names, and whether it takes others too."""
    parameters = list(signature(kind).parameters.values())[1:]  # the first is the hand
    named = (Parameter.POSITIONAL_OR_KEYWORD, Parameter.KEYWORD_ONLY)
    return (
        [one.name for one in parameters if one.kind in named],
        any(one.kind is Parameter.VAR_KEYWORD for one in parameters),
    )


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
            _several(turners)[1],
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
    names = _several(turners)
    if "" in names or count not in (None, len(names)):
        raise InvalidInput(f"got {turners!r}; expected {expected}")
    return [resolve(name, hand, control_period=control_period) for name in names]


def other_object(name: str, controller: Controller, objects: Sequence[str]) -> str | None:
    """What to know where a controller that was made for one object is given another."""
    others = [one for one in objects if controller.object not in (None, one)]
    if not others:
        return None
    return f"{name} is made for the object {controller.object}; this is {', '.join(others)}"


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
        if axis is not None and tuple(axis) != (0.0, 0.0, 1.0):
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
