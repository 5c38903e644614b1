"""Ctrl-C and SIGTERM as a wish to stop, so that a run can save itself first."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol


class Stoppable(Protocol):
    """What looks at ``stop`` where it can stop."""

    stop: bool


@contextmanager
def interruptible(keeper: Stoppable) -> Iterator[None]:
    """Ctrl-C and SIGTERM save a checkpoint first; a second one does not wait for it."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    previous = {}

    def stop(number: int, frame: object) -> None:
        keeper.stop = True
        signal.signal(number, previous[number])

    for number in (signal.SIGINT, signal.SIGTERM):
        previous[number] = signal.signal(number, stop)
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
