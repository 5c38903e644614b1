"""``dexctl hands``: the hands that are known by name."""

from __future__ import annotations

import os
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from dexctl import hands
from dexctl.cli.hands_add import Add
from dexctl.cli.hands_check import Check
from dexctl.cli.parsing import Switch
from dexctl.description.xml_text import parse_xml
from dexctl.exceptions import DexctlError
from dexctl.hand_config import MENAGERIE


@dataclass(kw_only=True)
class Hands:
    """List the hands that are known by name, and whether their files are here.

    Hands that are not built in are looked for in the folder that DEXCTL_MENAGERIE names, else in
    the package mujoco-menagerie, which downloads them when they are first loaded; this command
    downloads nothing.
    """

    json: Switch = False
    """Print one JSON object instead of the table."""

    def run(self) -> int:
        from dexctl.cli.output import print_json, results, table

        found = {name: describe(name) for name in hands.names()}
        if self.json:
            print_json({"hands": found})
            return 0
        numbers = ("fingers", "joints in file")
        listed = table("hand", *numbers, "files", "description", right=numbers)
        for name, about in found.items():
            unknown = "not downloaded" if about["files"] in ("missing", "on demand") else "?"
            counts = (
                unknown if about[key] is None else str(about[key]) for key in ("fingers", "joints")
            )
            listed.add_row(name, *counts, about["files"], about["description"])
        results().print(listed)
        return 0


def describe(name: str) -> dict[str, Any]:
    """What the table says of a hand; loads neither MuJoCo nor the hand.

    ``files`` is "built in", "here", "missing", "on demand" where a download would come first, or
    "broken" where the description is what is wrong. ``joints`` are those of the file, with those
    that are held, follow others or move no fingertip.
    """
    try:
        return _described(name)
    except DexctlError as error:  # of one hand; the others are listed all the same
        wrong = {"fingers": None, "joints": None, "files": "broken", "path": None}
        return {"description": str(error), **wrong}


def _described(name: str) -> dict[str, Any]:
    hand = hands.config(name)
    folder = os.environ.get("DEXCTL_MENAGERIE")
    of_menagerie = str(hand.description).startswith(MENAGERIE)
    path, files = None, "missing"
    if not of_menagerie:
        path, files = hand.description, "built in" if hands.is_own(name) else "here"
    elif folder:
        path = Path(folder).expanduser() / str(hand.description).removeprefix(MENAGERIE)
        files = "here"
    elif find_spec("mujoco_menagerie") is not None:
        files = "on demand"
    if path is not None and not path.is_file():
        path, files = None, "missing"
    return {
        "description": hand.about,
        "fingers": len(hand.fingertips),
        "joints": None if path is None else _count_joints(path),
        "files": files,
        "path": None if path is None else str(path),
    }


def _count_joints(path: Path) -> int | None:
    """Joints that move, as the file writes them; None where an MJCF file includes others."""
    root = parse_xml(path)
    if root.tag == "robot":
        return sum(joint.get("type") != "fixed" for joint in root.findall("joint"))
    if root.find(".//include") is not None:
        return None
    return sum(len(list(world.iter("joint"))) for world in root.findall("worldbody"))


COMMANDS = {"": Hands, "list": Hands, "add": Add, "check": Check}
