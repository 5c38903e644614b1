"""What may stand behind a controller's name or a policy's: files, others, a pace."""

from __future__ import annotations

import re
from pathlib import Path

from dexctl.controllers.table import entry, is_named, split

_PACE = re.compile(r"\d+(\.\d*)?|\.\d+")


def keeps_period(name: str) -> bool:
    """Whether it may have a control period of its own, or is of others that may.

    Policies have that of their training, and nobody knows of other packages' controllers; those of
    this package take any.
    """
    if not is_named(name):
        return True
    found = entry(name)
    if found.others:
        return any(keeps_period(one) for one in several(split(name)[1]))
    return not found.module.startswith("dexctl.")


def paced(name: str, folder: Path | None = None) -> tuple[str, float]:
    """A policy's name, file or folder without the pace behind it, and the pace; 1 without one.

    It may be out of range: who makes the policy says so.

    Args:
        name: the word; what is there by all of it, a folder ``run@1``, has no pace.
        folder: where it is meant from; None: the current one.
    """
    plain, _, pace = name.rpartition("@")
    if not plain or not _PACE.fullmatch(pace) or _place(name, folder).exists():
        return name, 1.0
    return plain, float(pace)


def is_policy_file(name: str, folder: Path | None = None) -> bool:
    """Whether a word is a policy file, or a folder that is there, and no other name.

    Args:
        name: the word, with a pace or without.
        folder: where it is meant from; None: the current one.
    """
    plain = paced(name, folder)[0]
    return plain.endswith(".npz") or _place(plain, folder).is_dir()


def absolute(name: str, folder: Path) -> str:
    """A word that `resolve` takes, with absolute paths for the files in it, meant from ``folder``.

    So what is written down holds wherever it is read.
    """

    def place(file: str) -> str:
        return str(_place(file, folder).resolve())

    if not is_named(name):
        plain = paced(name, folder)[0]
        return place(plain) + name[len(plain) :] if is_policy_file(name, folder) else name
    found, (plain, after) = entry(name), split(name)
    if not after:
        return name
    if found.others:
        return f"{plain}:{','.join(absolute(one, folder) for one in several(after))}"
    return f"{plain}:{place(after)}"


def label(name: str) -> str:
    """A controller's name as part of a folder's: what stands after it may have slashes."""
    return re.sub(r"[^\w.-]+", "-", name)


def several(after: str) -> list[str]:
    """Names with commas between them."""
    return [name.strip() for name in after.split(",")]


def _place(name: str, folder: Path | None) -> Path:
    return (folder or Path()) / Path(name).expanduser()
