"""A folder that one process at a time works in."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dexctl.exceptions import InvalidInput

_LOCK = ".lock"
_HERE: set[Path] = set()  # folders that this process holds


@contextmanager
def locked(folder: Path, wait: float = 0.0) -> Iterator[None]:
    """Hold ``folder`` in this block; the system takes the lock back when its holder is gone.

    What this process holds already it may hold once more: a sweep's worker, and the training in it.

    Args:
        folder: that is there.
        wait: for whom holds it to let go [s].

    Raises:
        InvalidInput: another process holds it.
    """
    place = folder.resolve()
    if place in _HERE:
        yield
        return
    file = _taken(folder, time.monotonic() + wait)
    _HERE.add(place)
    try:
        yield
    finally:
        _HERE.discard(place)
        (folder / _LOCK).unlink(missing_ok=True)  # while it is held, so nobody else's is meant
        os.close(file)


def _taken(folder: Path, deadline: float) -> int:
    """The lock's file, open and held."""
    import fcntl  # not every system has it, and only here is it needed

    while True:
        file = os.open(folder / _LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if _is_at(folder / _LOCK, file):
                return file
            os.close(file)  # whom it was waited for took it away; there is another one by now
            continue
        except BlockingIOError:
            os.close(file)
        if time.monotonic() >= deadline:
            raise InvalidInput(f"another process is at work in {folder}")
        time.sleep(0.1)


def _is_at(path: Path, file: int) -> bool:
    try:
        return os.path.samestat(path.stat(), os.fstat(file))
    except FileNotFoundError:
        return False
