"""Loads MuJoCo for this room, or says in one line why it cannot be loaded.

The package imports this module before any other of its own, so nothing else here has to ask.
"""

from __future__ import annotations

from dexctl.description import load_mujoco

MUJOCO_VERSION: str = load_mujoco().__version__
