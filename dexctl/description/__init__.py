"""Hand descriptions: reads MJCF and URDF into one tree of bodies and joints."""

from __future__ import annotations

from pathlib import Path

from dexctl.description.mjcf import load_mujoco, read_mjcf
from dexctl.description.tree import Body, Description, Joint, Mimic
from dexctl.description.urdf import read_urdf
from dexctl.description.xml_text import root_tag

__all__ = [
    "Body",
    "Description",
    "Joint",
    "Mimic",
    "load_mujoco",
    "read",
    "read_mjcf",
    "read_urdf",
    "root_tag",
]


def read(path: Path) -> Description:
    """Read a URDF, which has <robot> as its root, or an MJCF file.

    Raises:
        HandModelError: it is neither, or not well made.
    """
    return read_urdf(path) if root_tag(path) == "robot" else read_mjcf(path)
