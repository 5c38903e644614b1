"""The table of dexctl's own controllers, and those that other packages registered."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points

from dexctl.controller import Controller
from dexctl.exceptions import UnknownName
from dexctl.rooms import check_room

GROUP = "dexctl.controllers"

POLICIES = "learned"
"""The name whose object takes policies: ``object(hand, policy=NAME, FILE or FOLDER)``."""

# words for a name that comes with dexctl, whose object is of another room
_WORDS = {
    POLICIES: ("learned gait", "a policy that was trained with the controllers as its guides")
}


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
            name="pursuing",
            title="pursuit of goals",
            description="turns about any axis told, by pursuing:NAME going after goals ahead of it",
            module="dexctl.controllers",
            attribute="pursuing",
            keyword="reacher",
            wanted="NAME",
            others=True,
            follows=("goal_quaternion", "goal_angular_velocity"),
        ),
        ControllerEntry(
            name="regulated",
            title="regulated turning",
            description="has another controller, regulated:NAME, turn the object in its place",
            module="dexctl.controllers",
            attribute="regulated",
            keyword="turner",
            wanted="NAME",
            others=True,
            follows=(),
        ),
        ControllerEntry(
            name="centred",
            title="centred turning",
            description="as regulated:NAME, without the height: for a pose told by touch",
            module="dexctl.controllers",
            attribute="centred",
            keyword="turner",
            wanted="NAME",
            others=True,
            follows=(),
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


@cache
def known_entries() -> dict[str, ControllerEntry]:
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
    return tuple(known_entries())


def entry(name: str) -> ControllerEntry:
    """What is known of a controller by name, with what stands after it or not.

    Raises:
        UnknownName: no such controller.
    """
    known = known_entries()
    if not is_named(name):
        raise UnknownName("controller", name, known)
    return known[split(name)[0]]


def is_named(name: str) -> bool:
    """Whether it is one of `names`, with what stands after it where that controller takes it."""
    found = known_entries().get(split(name)[0])
    return found is not None and (found.name == name or bool(found.keyword))


def ignores(name: str, wish: str) -> bool:
    """Whether it is known of who is named that a state's ``wish`` changes nothing.

    Args:
        name: as `dexctl.controllers.resolve` takes it.
        wish: "goal_quaternion" or "goal_angular_velocity".
    """
    follows = entry(name).follows if is_named(name) else None
    return follows is not None and wish not in follows


def split(name: str) -> tuple[str, str]:
    """The name of a controller, and what stands after it."""
    plain, _, after = str(name).partition(":")
    return plain, after
