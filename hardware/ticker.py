"""A fixed rate by absolute deadlines, and what the operating system can do for it."""

from __future__ import annotations

import gc
import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import NamedTuple

import numpy as np

from dexctl.exceptions import InvalidInput
from dexctl.state import Floats

_PRIORITY = 50
_HELPER_PRIORITY = 30


class Tick(NamedTuple):
    """One tick.

    Attributes:
        deadline: when it should have begun, on the clock of ``time.monotonic`` [s].
        lateness: how much later it began [s].
        skipped: ticks left out before it because their time had passed.
    """

    deadline: float
    lateness: float
    skipped: int


class Ticker:
    """Ticks at multiples of a period: errors of sleeping do not add up.

    Where the work took longer than the period, the ticks whose time has passed are left out and
    counted, instead of being made up for in a burst.

    Args:
        period: [s].
    """

    def __init__(self, period: float) -> None:
        if not (np.isfinite(period) and period > 0):
            raise InvalidInput(f"period is {period}; expected seconds above 0")
        self.period = period
        self._next = time.monotonic()

    def restart(self) -> None:
        """The next tick is now."""
        self._next = time.monotonic()

    def wait(self) -> Tick:
        """Sleep until the next tick."""
        delay = self._next - time.monotonic()
        if delay > 0:
            time.sleep(delay)  # goes on sleeping after a signal (PEP 475)
        deadline = self._next
        late = time.monotonic() - deadline
        skipped = int(late / self.period)
        deadline += skipped * self.period
        self._next = deadline + self.period
        return Tick(deadline, late - skipped * self.period, skipped)

    @property
    def left(self) -> float:
        """Time until the next tick [s]; negative if it is overdue."""
        return self._next - time.monotonic()


@contextmanager
def undisturbed() -> Iterator[bool]:
    """Garbage collection off and, where permitted, first-in-first-out scheduling of this thread.

    Yields whether real-time scheduling was granted. Threads started inside the block do not
    inherit it.
    """
    collecting = gc.isenabled()
    gc.collect()
    gc.disable()
    before = _real_time()
    try:
        yield before is not None
    finally:
        if before is not None:
            policy, parameters = before
            os.sched_setscheduler(0, policy, parameters)
        if collecting:
            gc.enable()


def hurry() -> bool:
    """Real-time scheduling for a thread that works for the loop; False where not permitted.

    Behind the loop itself and behind emulated servos, before everything else of the machine.
    """
    return _real_time(_HELPER_PRIORITY) is not None


def _real_time(priority: int = _PRIORITY) -> tuple[int, os.sched_param] | None:
    """The scheduling before, if it could be changed."""
    if not hasattr(os, "SCHED_FIFO"):
        return None
    try:
        before = os.sched_getscheduler(0), os.sched_getparam(0)
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except OSError:
        return None
    return before


class Interrupts:
    """Counts Ctrl-C, SIGTERM, SIGHUP, SIGQUIT and SIGABRT instead of dying of them.

    A SIGABRT from outside, such as a service manager's watchdog sends, is one more way of saying
    stop. After an ``abort()`` inside this process no Python runs any more: see `hardware.guard`.

    A handler that did more than count could run between any two byte codes, in the middle of a
    packet. In a thread that is not the main one nothing is installed, and `add` is the way.
    """

    def __init__(self) -> None:
        self.count = 0
        self.signal = 0  # the first that came; 0: none, or not from outside
        self._before: dict[int, object] = {}

    def add(self, number: int = 0, frame: FrameType | None = None) -> None:
        """Count one more."""
        self.count += 1
        self.signal = self.signal or number

    def __enter__(self) -> Interrupts:
        if threading.current_thread() is threading.main_thread():
            for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGABRT"):
                number = getattr(signal, name, None)
                if number is not None:
                    self._before[number] = signal.signal(number, self.add)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)  # type: ignore[arg-type]
        self._before.clear()


def spread(values: list[float]) -> dict[str, float]:
    """Median, 99th percentile and maximum; {} of nothing."""
    if not values:
        return {}
    array: Floats = np.asarray(values)
    p50, p99 = np.percentile(array, [50, 99])
    return {"p50": float(p50), "p99": float(p99), "max": float(array.max())}
