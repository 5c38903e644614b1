"""How a run went: its events, and the report at its end."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from hardware.state_machine import Event, State, Torque


@dataclass(frozen=True, kw_only=True)
class RunEvent:
    """Something that happened.

    Attributes:
        time: since the run began [s].
        event: what.
        detail: servo or joint, value, what to do.
        state: the state after it.
    """

    time: float
    event: Event
    detail: str
    state: State


@dataclass(kw_only=True)
class RunReport:
    """How a run went.

    Attributes:
        outcome: where it ended: IDLE as wanted, HOLD or FAULT by `cause`. After HOLD, too, the
            torque was taken off before the run returned.
        cause: of HOLD or FAULT.
        signal: name of the first that asked to end the run (SIGINT is Ctrl-C); none: no signal.
        torque: what is known of it now, and in words.
        events: in order; what is only counted appears once.
        counts: of every event.
        ticks, skipped: done, and left out because their time had passed.
        real_time: whether real-time scheduling was granted.
        figures: lateness, cycle and controller times [s]: p50, p99 and max of each.
        bus: the bus's own counts.
        dropped: log messages that found the queue full.
    """

    outcome: State = State.IDLE
    cause: Event | None = None
    signal: str | None = None
    torque: Torque = Torque.UNKNOWN
    torque_message: str = "torque state UNKNOWN: cut power"
    events: list[RunEvent] = field(default_factory=list)
    counts: Counter[Event] = field(default_factory=Counter)
    ticks: int = 0
    skipped: int = 0
    real_time: bool = False
    figures: dict[str, dict[str, float]] = field(default_factory=dict)
    bus: dict[str, Any] = field(default_factory=dict)
    dropped: int = 0

    def as_dict(self) -> dict[str, Any]:
        """For JSON and logs."""
        return {
            "outcome": self.outcome.value,
            "cause": self.cause.value if self.cause else None,
            "signal": self.signal,
            "torque": self.torque.value,
            "torque_message": self.torque_message,
            "ticks": self.ticks,
            "skipped_ticks": self.skipped,
            "real_time_scheduling": self.real_time,
            "counts": {event.value: count for event, count in self.counts.items()},
            "figures_s": self.figures,
            "bus": self.bus,
            "log_messages_dropped": self.dropped,
        }
