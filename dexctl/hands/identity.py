"""Which hand it is: a digest over everything that a hand is built from."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from dexctl.description.files import files_of
from dexctl.hand_config import MENAGERIE, HandConfig, HeldObject
from dexctl.hand_toml import to_toml

if TYPE_CHECKING:
    from dexctl.hand import HandModel


def digest(config: HandConfig, description: Path) -> str:
    """SHA-256 over the settings, the description file, what it includes, and its meshes.

    Names, places of files and comments do not count, nor does the mass of objects, which runs and
    policies name themselves, nor how wide single ones are, nor how far gaits let fingers go with
    them: none of that is the hand that somebody was trained with.
    """
    held = replace(config.object, mass=HeldObject.mass, sizes={}, travel=None)
    settings = replace(config, description=Path("description"), name="hand", about="", object=held)
    found = hashlib.sha256(to_toml(settings, {}).encode())
    for file in files_of(description):
        found.update(hashlib.sha256(file.read_bytes()).digest())
    return found.hexdigest()


def identity(hand: HandModel) -> dict[str, str]:
    """What a card or a run folder says of the hand: name, files and digest.

    Files of this package are told by their names, those of the menagerie as a toml tells them:
    where they lie differs from machine to machine.
    """
    source, description = hand.config.source, str(hand.config.description)
    return {
        "name": hand.name,
        **({} if source is None else {"toml": _place(source)}),
        "description": description if description.startswith(MENAGERIE) else _place(hand.path),
        "sha256": hand.digest,
    }


def _place(path: Path) -> str:
    own = Path(__file__).resolve().parent
    return path.name if path.resolve().parent == own else str(path)
