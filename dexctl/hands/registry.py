"""Hands by name, or from a file of one's own.

dexctl's own stand beside this module, one toml each. Other packages add theirs through the
entry-point group ``dexctl.hands``: the name is the hand's, the object is the path of its toml, or a
`HandConfig`. It is loaded when the hand is, not before.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from dexctl.exceptions import HandModelError, UnknownName
from dexctl.files import is_path
from dexctl.hand import HandModel
from dexctl.hand_config import HandConfig

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

GROUP = "dexctl.hands"
_OWN = {path.stem: path for path in sorted(Path(__file__).parent.glob("*.toml"))}


@cache
def _added() -> dict[str, EntryPoint]:
    """What other packages add; dexctl's own names come first."""
    from importlib.metadata import entry_points  # costs as much as the rest of the module

    return {one.name: one for one in entry_points(group=GROUP) if one.name not in _OWN}


def names() -> tuple[str, ...]:
    """The names that `load` takes."""
    return (*_OWN, *_added())


def is_own(hand: str) -> bool:
    """Whether the name is one of dexctl's own."""
    return hand in _OWN


def check(hand: str | Path) -> None:
    """Raise UnknownName where there is no hand of that name; files are not looked for."""
    if not is_path(hand) and hand not in names():
        raise UnknownName("hand", hand, [*names(), "a file (.toml, .xml, .urdf)"])


def config(hand: str | Path) -> HandConfig:
    """What is known of a hand, by name or from its file.

    Args:
        hand: one of `names`, a toml file, or a bare MJCF or URDF file, for which what
            `dexctl.hands.proposals` proposes has to do.

    Raises:
        UnknownName: no such name.
        HandModelError, InvalidInput: the file is not there or not well made.
    """
    check(hand)
    if is_path(hand):
        if not Path(hand).expanduser().is_file():
            raise HandModelError(f"{hand}: no such file; a hand is a .toml, .xml or .urdf file")
        if Path(hand).suffix.lower() == ".toml":
            return HandConfig.read(hand)
        from dexctl.hands.proposals import propose  # needs MuJoCo for an MJCF

        return propose(hand).config
    if hand in _OWN:
        return HandConfig.read(_OWN[str(hand)])
    point = _added()[str(hand)]
    found = point.load()
    if isinstance(found, str | Path):
        return HandConfig.read(found)
    if not isinstance(found, HandConfig):
        raise HandModelError(
            f"the hand {hand!r} of {point.value} is {found!r}; expected the path of its toml, or a "
            "HandConfig"
        )
    return found


def load(hand: str | Path, *, folder: str | Path | None = None) -> HandModel:
    """Load a hand by name, or from a file.

    Args:
        hand: as `config` takes it.
        folder: for hands of the menagerie, the folder that holds their folders. Default: the
            environment variable DEXCTL_MENAGERIE, else the `mujoco-menagerie` package.

    Raises:
        UnknownName: no such name.
        HandModelError: its file is not to be had; the message says how to get it.
    """
    return config(hand).build(folder=folder)
