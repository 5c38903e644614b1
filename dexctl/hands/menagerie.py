"""Files of the MuJoCo menagerie: from a folder of one's own, else from its package."""

from __future__ import annotations

import os
from pathlib import Path

from dexctl.exceptions import HandModelError


def find(hand: str, file: str, folder: str | Path | None = None) -> Path:
    """Where ``file`` (``leap_hand/right_hand.xml``) of the menagerie is.

    Args:
        hand: the hand's name, for messages.
        file: in the menagerie's folder.
        folder: see `dexctl.hands.load`.

    Raises:
        HandModelError: it is not to be had; the message says how to get it.
    """
    chosen = folder if folder is not None else os.environ.get("DEXCTL_MENAGERIE")
    if chosen:
        path = Path(chosen).expanduser() / file
        if not path.is_file():
            raise HandModelError(f"{hand}: {path} is not there; expected {file} in the folder")
        return path
    model, _, below = file.partition("/")
    how = (
        f"give the folder that holds {model}/ (a clone of "
        "https://github.com/google-deepmind/mujoco_menagerie) as `folder` or in DEXCTL_MENAGERIE"
    )
    try:
        import mujoco_menagerie  # an extra, and it downloads: only where it is asked for
    except ImportError:
        raise HandModelError(
            f"{hand}: the hand's files are not part of dexctl; pip install "
            f"mujoco-menagerie, or {how}"
        ) from None
    try:
        path = mujoco_menagerie.get(model).path(progress=None) / below
    except (mujoco_menagerie.MenagerieError, OSError, ValueError, LookupError) as error:
        reason = " ".join(str(error).split())
        raise HandModelError(f"{hand}: mujoco-menagerie cannot get it ({reason}); {how}") from None
    if not path.is_file():
        raise HandModelError(f"{hand}: {path} is not there; {how}")
    return path
