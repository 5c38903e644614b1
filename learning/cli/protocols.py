"""What evaluate and inspect share: protocols from arguments, and arguments from protocols."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import tyro

from dexctl.exceptions import UnknownName
from dexctl.settings import get, paths
from learning.evaluation.protocol import Protocol

C = TypeVar("C")


def said(kind: type[C], arguments: Sequence[str]) -> C | None:
    """What ``arguments`` say by themselves; None where they are not right, which shows later."""
    words = [word for word in arguments if word not in ("-h", "--help")]
    try:
        return tyro.cli(kind, args=words, console_outputs=False)
    except SystemExit:
        return None


def given(arguments: Sequence[str]) -> set[str]:
    """Names of the settings that are among ``arguments``."""
    flags = (word.partition("=")[0] for word in arguments if word.startswith("--"))
    return {flag[2:].replace("-", "_") for flag in flags}


def words(protocol: Protocol, default: Protocol) -> list[str]:
    """The options that make ``protocol`` of ``default``."""
    found = []
    for path in paths(Protocol):
        value, usual = get(protocol, path), get(default, path)
        if value == usual:
            continue
        option = f"--{path.rpartition('.')[2].replace('_', '-')}"
        if path == "scene.object":
            found += [option, *value]
        else:  # a vector may begin with a minus sign
            text = ",".join(map(str, value)) if isinstance(value, tuple) else str(value)
            found.append(f"{option}={text}")
    return found


def check_objects(names: Sequence[str]) -> None:
    """Raise UnknownName where one of them is no object."""
    from dexctl.sim import object_names
    from dexctl.sim.objects import MESH

    for name in names:
        if name not in (*object_names(), MESH):
            raise UnknownName("object", name, object_names())
