"""The packages that come with dexctl beside it, and whether others shadow them.

``learning`` and ``hardware`` are words that other people use too: a project's own folder in the
working directory, or one on PYTHONPATH, comes before ours. Where that happens, an import finds the
other package, and fails with an error that explains nothing.
"""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path

from dexctl.exceptions import RoomShadowed

ROOMS = ("learning", "hardware")
_HOME = Path(__file__).resolve().parents[1]


def home(package: str) -> Path | None:
    """The folder of our own room ``package``; None where it is none of ours or not installed."""
    folder = _HOME / package
    return folder if package in ROOMS and (folder / "__init__.py").is_file() else None


def check_room(module: str) -> None:
    """Raise RoomShadowed where ``module`` is of a room of ours that another package shadows.

    Args:
        module: dotted name; a module of none of our rooms is fine.
    """
    package = module.partition(".")[0]
    folder = home(package)
    if folder is None:
        return
    found = _found(package)
    if found is None or found.resolve() == folder:
        return
    raise RoomShadowed(
        f"{found} shadows dexctl's own package {package!r}, which is in {folder}: rename it, or "
        f"keep {found.parent} out of PYTHONPATH and run from another working directory"
    )


def _found(package: str) -> Path | None:
    """The folder, or the file, that ``import package`` takes; None where it finds nothing."""
    loaded = sys.modules.get(package)
    spec = find_spec(package) if loaded is None else loaded.__spec__
    if spec is None:
        return None
    places = list(spec.submodule_search_locations or ())
    where = places[0] if places else spec.origin
    return None if where is None else Path(where)
