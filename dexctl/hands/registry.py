"""Hands by name: where the file is, which bodies are fingertips, where the hand holds things."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

from dexctl.exceptions import HandModelError, UnknownName
from dexctl.hand import HandModel

_DEX5_OPEN = (0.0, 1.0, -1.2)


@dataclass(frozen=True, kw_only=True)
class HandEntry:
    """What must be known of a hand beyond its file.

    Attributes:
        name: the name that `load` takes.
        description: one line for people.
        file: MJCF relative to the package ("" folder) or to a menagerie folder.
        menagerie: whether the file belongs to the MuJoCo menagerie and is not shipped.
        fingertips: body name -> where the tip is in that body's frame [m].
        grasp_centre: where the hand holds an object, world frame [m].
        object_radius: half the width of the objects that suit the hand [m].
        open_q: joints of the open hand, by name [rad]; a name left out is at the middle of its range.
    """

    name: str
    description: str
    file: str
    menagerie: bool = False
    fingertips: dict[str, tuple[float, float, float]]
    grasp_centre: tuple[float, float, float]
    object_radius: float
    open_q: dict[str, float] = field(default_factory=dict)


_HANDS = {
    hand.name: hand
    for hand in (
        HandEntry(
            name="dex5",
            description="five fingers, 15 joints, built in",
            file="dex5.xml",
            fingertips={f"f{i}_tip": (0.0, 0.0, 0.0) for i in range(1, 6)},
            grasp_centre=(0.0, 0.0, 0.13),
            object_radius=0.05,
            open_q={
                f"f{i}_{joint}": angle
                for i in range(1, 6)
                for joint, angle in zip(("roll", "flexion1", "flexion2"), _DEX5_OPEN, strict=True)
            },
        ),
        HandEntry(
            name="wonik_allegro",
            description="Wonik Allegro right hand, four fingers, 16 joints, from the menagerie",
            file="wonik_allegro/right_hand.xml",
            menagerie=True,
            fingertips={
                "ff_tip": (0.0, 0.0, 0.0267),
                "mf_tip": (0.0, 0.0, 0.0267),
                "rf_tip": (0.0, 0.0, 0.0267),
                "th_tip": (0.0, 0.0, 0.0423),
            },
            grasp_centre=(0.06, 0.0, 0.08),
            object_radius=0.03,
        ),
    )
}


def names() -> tuple[str, ...]:
    """The names that `load` takes."""
    return tuple(_HANDS)


def entry(name: str) -> HandEntry:
    """What is known of a hand by name.

    Raises:
        UnknownName: no such hand.
    """
    if name not in _HANDS:
        raise UnknownName("hand", name, _HANDS)
    return _HANDS[name]


def load(name: str, *, folder: str | Path | None = None) -> HandModel:
    """Load a hand by name.

    Args:
        name: one of `names`.
        folder: for hands of the menagerie, the folder that holds their folders. Default: the
            environment variable DEXCTL_MENAGERIE, else the `mujoco-menagerie` package.

    Raises:
        UnknownName: no such hand.
        HandModelError: its file is not to be had; the message says how to get it.
    """
    hand = entry(name)
    path = _menagerie_file(hand, folder) if hand.menagerie else Path(__file__).parent / hand.file
    return HandModel.from_mjcf(path, hand.fingertips)


def _menagerie_file(hand: HandEntry, folder: str | Path | None) -> Path:
    chosen = folder if folder is not None else os.environ.get("DEXCTL_MENAGERIE")
    if chosen:
        path = Path(chosen).expanduser() / hand.file
        if not path.is_file():
            raise HandModelError(f"{hand.name}: {path} is not there; expected {hand.file} in the folder")
        return path
    raise HandModelError(f"{hand.name}: no folder")
