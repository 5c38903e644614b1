"""Hands by name, or from a file of one's own.

dexctl's own stand beside this module, one toml each. Other packages add theirs through the
entry-point group ``dexctl.hands``: the name is the hand's, the object is the path of its toml, or a
`HandConfig`. It is loaded when the hand is, not before.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from dexctl.exceptions import HandModelError, InvalidInput, UnknownName
from dexctl.files import is_path
from dexctl.hand import HandModel
from dexctl.hand_config import HandConfig
from dexctl.validation import shown

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
    """Raise UnknownName where there is no hand of that name; files are not looked for.

    Raises:
        InvalidInput: neither a name nor a path, or what is in a file.
        UnknownName: no such name.
    """
    text = isinstance(hand, str) and (hand.lstrip("\ufeff \t\r\n").startswith("<") or "\n" in hand)
    if text or not isinstance(hand, str | Path):
        raise InvalidInput(
            f"hand is {shown(hand)}; expected a name ({', '.join(names())}) or the path of a file "
            "(.toml, .xml, .urdf)"
        )
    if not is_path(hand) and hand not in names():
        raise UnknownName("hand", hand, [*names(), "a file (.toml, .xml, .urdf)"])


def config(hand: str | Path) -> HandConfig:
    """What is known of a hand, by name or from its file.

    Args:
        hand: one of `names`, a toml file, or a bare MJCF or URDF file, for which what
            `dexctl.hands.proposals` proposes has to do.

    Raises:
        UnknownName: no such name.
        HandModelError, InvalidInput: the file is not there or not well made, what another package
            adds cannot be loaded, or it is neither a name nor a path.
    """
    check(hand)
    if is_path(hand):
        if not _is_file(Path(hand).expanduser()):
            raise HandModelError(f"{hand}: no such file; a hand is a .toml, .xml or .urdf file")
        if Path(hand).suffix.lower() == ".toml":
            return HandConfig.read(hand)
        from dexctl.hands.proposals import propose  # needs MuJoCo for an MJCF

        return propose(hand).config
    if hand in _OWN:
        return HandConfig.read(_OWN[str(hand)])
    point = _added()[str(hand)]
    try:
        found = point.load()
    except Exception as error:  # whatever the other package raises
        raise HandModelError(
            f"the hand {hand!r} cannot be loaded from {point.value}: {type(error).__name__}: "
            f"{' '.join(str(error).split())}"
        ) from error
    if isinstance(found, str | Path):
        return HandConfig.read(found)
    if not isinstance(found, HandConfig):
        raise HandModelError(
            f"the hand {hand!r} of {point.value} is {found!r}; expected the path of its toml, or a "
            "HandConfig"
        )
    return found


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # a name that is too long
        return False


def load(hand: str | Path, *, folder: str | Path | None = None) -> HandModel:
    """Load a hand by name, or from a file.

    Args:
        hand: as `config` takes it.
        folder: for hands of the menagerie, the folder that holds their folders. Default: the
            environment variable DEXCTL_MENAGERIE, else the `mujoco-menagerie` package.

    Raises:
        UnknownName: no such name.
        InvalidInput: neither a name nor a path.
        HandModelError: its file is not to be had; the message says how to get it.
    """
    return config(hand).build(folder=folder)
