"""One at a time in a folder: a lock that the system takes back when its holder is gone."""

from __future__ import annotations

import fcntl
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dexctl.exceptions import InvalidInput

NAME = ".lock"


@contextmanager
def locked(folder: Path, wait: float = 0.0) -> Iterator[None]:
    """Hold ``folder`` in this block.

    Args:
        folder: where the lock is.
        wait: for whom holds it to let go [s].

    Raises:
        InvalidInput: another process holds it.
    """
    deadline = time.monotonic() + wait
    with (folder / NAME).open("a") as file:
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() >= deadline:
                    raise InvalidInput(f"another process is at work in {folder}") from None
            time.sleep(0.1)
        yield
