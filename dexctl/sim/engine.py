"""Loads MuJoCo for this room, or says in one line why it cannot be loaded.

The package imports this module before any other of its own, so nothing else here has to ask.
"""

from __future__ import annotations

import sys

from dexctl.description import load_mujoco

MUJOCO_VERSION: str = load_mujoco().__version__

_TOLD = "The simulation is unstable"  # by whoever steps: `diverged`, `SettleFailure`


def warned(text: str) -> None:
    """Say a warning of MuJoCo's on stderr, but for one that a simulation has diverged.

    By itself MuJoCo says that for every environment, and writes a file into the working directory.
    """
    if _TOLD not in text:
        print(f"MuJoCo: {text}", file=sys.stderr)


if load_mujoco().get_mju_user_warning() is None:  # else somebody else listens
    load_mujoco().set_mju_user_warning(warned)
