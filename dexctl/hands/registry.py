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
        open_q: joints of the open hand, by name [rad]; one left out is at the middle of its range.
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
            # above the palm: three fingers in front of the object, the thumb behind it
            grasp_centre=(0.015, -0.018, 0.09),
            object_radius=0.035,
            open_q={
                **{
                    f"{finger}j{k}": angle
                    for finger in ("ff", "mf", "rf")
                    for k, angle in enumerate((0.0, 0.6, 0.6, 0.6))
                },
                **{f"thj{k}": angle for k, angle in enumerate((1.3, 0.2, 0.35, 0.35))},
            },
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
            raise HandModelError(
                f"{hand.name}: {path} is not there; expected {hand.file} in the folder"
            )
        return path
    model, file = Path(hand.file).parts
    how = (
        f"give the folder that holds {model}/ (a clone of "
        "https://github.com/google-deepmind/mujoco_menagerie) as `folder` or in DEXCTL_MENAGERIE"
    )
    try:
        import mujoco_menagerie  # an extra, and it downloads: only where it is asked for
    except ImportError:
        raise HandModelError(
            f"{hand.name}: the hand's files are not part of dexctl; pip install "
            f"mujoco-menagerie, or {how}"
        ) from None
    try:
        path = mujoco_menagerie.get(model).path(progress=None) / file
    except (mujoco_menagerie.MenagerieError, OSError, ValueError, LookupError) as error:
        reason = " ".join(str(error).split())
        raise HandModelError(
            f"{hand.name}: mujoco-menagerie cannot get it ({reason}); {how}"
        ) from None
    if not path.is_file():
        raise HandModelError(f"{hand.name}: {path} is not there; {how}")
    return path
