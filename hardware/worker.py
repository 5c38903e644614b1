"""The controller in a thread of its own, so that one that stalls cannot stall the bus."""

from __future__ import annotations

import contextlib
import threading
import time
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple

import numpy as np

from dexctl import Controller, GraspState
from dexctl.state import Floats
from hardware.ticker import hurry


class Command(NamedTuple):
    """What the controller answered.

    Attributes:
        change: set-point change ``(d,)`` [rad]; None where it failed.
        asked: when it was asked, on the clock of ``time.monotonic`` [s].
        seconds: how long it took [s].
        diagnostics: those of the controller that are numbers.
        error: what went wrong, "" if nothing.
    """

    change: Floats | None
    asked: float
    seconds: float
    diagnostics: dict[str, Any]
    error: str


class ControllerThread:
    """Asks a controller for one command at a time.

    The bus's thread hands over a state and waits for the answer as long as it can afford. While
    both take turns like this Python's lock is never fought over, and the same states in the same
    order give the same commands as without a thread.

    Args:
        controller: is used by this thread only until :meth:`close`.
    """

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self._states: SimpleQueue[tuple[GraspState, float] | None] = SimpleQueue()
        self._commands: SimpleQueue[Command] = SimpleQueue()
        self._asked: float | None = None
        self._thread = threading.Thread(target=self._work, name="controller", daemon=True)
        self._thread.start()

    def ask(self, state: GraspState) -> bool:
        """Hand over a state; False where the last one has not been answered yet."""
        if self._asked is not None:
            return False
        self._asked = time.monotonic()
        self._states.put((state, self._asked))
        return True

    def answer(self, timeout: float) -> Command | None:
        """The answer, if it comes within ``timeout`` [s]."""
        try:
            command = self._commands.get(timeout=max(timeout, 0.0))
        except Empty:
            return None
        self._asked = None
        return command

    @property
    def waiting(self) -> float:
        """How long the question that is open has been open [s]; 0 without one."""
        return 0.0 if self._asked is None else time.monotonic() - self._asked

    def close(self, timeout: float = 1.0) -> bool:
        """End the thread; False where the controller does not come back."""
        self._states.put(None)
        self._thread.join(timeout)
        return not self._thread.is_alive()

    def _work(self) -> None:
        hurry()  # a command that waits for the machine's other work is as late as a slow one
        while (item := self._states.get()) is not None:
            state, asked = item
            start = time.perf_counter()
            change, error = None, ""
            try:
                change = np.asarray(self._controller.act(state), float)
                if change.shape != state.q.shape:
                    error = f"the controller answered with shape {change.shape}"
                    change = None
            except Exception as problem:  # noqa: BLE001 (whatever it is, the hand must be held)
                error = " ".join(f"{type(problem).__name__}: {problem}".split())
            seconds = time.perf_counter() - start
            found = _numbers(self._controller) if change is not None else {}
            self._commands.put(Command(change, asked, seconds, found, error))


def _numbers(controller: Controller) -> dict[str, Any]:
    """Diagnostics that are numbers or arrays of them, as they are now."""
    kept: dict[str, Any] = {}
    try:
        for name, value in controller.diagnostics.items():
            with contextlib.suppress(ValueError, TypeError):  # rows of different lengths
                array = np.asarray(value)
                if array.dtype.kind in "fiub":
                    kept[str(name)] = array.tolist()
    except Exception as problem:  # noqa: BLE001 (what is only shown must not stop a run)
        kept["diagnostics_failed"] = f"{type(problem).__name__}: {problem}"
    return kept


def warm_up(
    controller: Controller,
    q: Floats,
    seed: int | None,
    gravity: Floats | None = None,
    *,
    tracked: bool = False,
    goal: Floats | None = None,
    spin: Floats | None = None,
) -> None:
    """Let a controller load and compile what it uses, before torque is on.

    It is asked about a made-up grasp at the joints ``q`` ``(d,)`` [rad], all fingers touching,
    under ``gravity`` ``(3,)`` [m/s^2], the object ``tracked`` or not and wanted as ``goal`` or
    ``spin`` says, and reset afterwards, so that nothing of it stays.
    """
    hand = controller.hand
    tip = hand.fingertip_positions(q)
    inward = tip.mean(axis=0) - tip
    state = GraspState(
        q=q,
        q_target=q,
        in_contact=np.ones(hand.n_fingers, bool),
        contact_position=tip,
        contact_normal=inward / np.maximum(np.linalg.norm(inward, axis=1), 1e-9)[:, None],
        contact_force=np.full(hand.n_fingers, 2.0),
        object_position=tip.mean(axis=0) if tracked else None,
        object_quaternion=np.array([1.0, 0.0, 0.0, 0.0]) if tracked else None,
        goal_quaternion=goal,
        goal_angular_velocity=spin,
        gravity=gravity,
    )
    controller.reset(seed)
    for _ in range(3):
        controller.act(state)
    controller.reset(seed)
