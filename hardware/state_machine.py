"""The states of a run and the fault table, as data.

A run moves through IDLE, ARMED, RUN, HOLD and FAULT. What may happen is a closed list of events;
`TABLE` says for each state and event which state follows, what is done with the torque and what
the user is told. The runner looks up and obeys; it has no rules of its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from types import MappingProxyType
from typing import NamedTuple


class State(Enum):
    """Where a run is."""

    IDLE = "idle"
    """Torque off, nothing wrong."""
    ARMED = "armed"
    """Torque on, set-points where the joints stand."""
    RUN = "run"
    """The controller's set-points are sent."""
    HOLD = "hold"
    """Torque on, set-points frozen; the controller is not asked any more."""
    FAULT = "fault"
    """Torque off (or unknown, where the message says so) until somebody looks and arms again."""


class Torque(Enum):
    """What is known of the servos' torque."""

    OFF = "off"
    ON = "on"
    UNKNOWN = "unknown"


class Event(Enum):
    """What may happen; the value is what the log says."""

    ARM = "armed"
    START = "started"
    FINISHED = "time is up"
    INTERRUPT = "interrupted"
    INTERRUPT_AGAIN = "interrupted twice"
    HELD = "held long enough"
    READ_MISSED = "read missed"
    READS_LOST = "reads lost"
    ALERT = "hardware alert"
    CLAMPED = "set-point clamped"
    GOAL_NOT_FINITE = "set-point not finite"
    COMMAND_STALE = "controller stalled"
    CONTROLLER_FAILED = "controller failed"
    HEALTH_WARNING = "temperature or voltage"
    HEALTH_LASTS = "temperature or voltage for a second"
    WATCHDOG = "bus watchdog tripped"
    OVERRUNS_WARNING = "overruns above 5 %"
    OVERRUNS = "overruns above 20 %"
    TACTILE_STALE = "tactile readings stale"
    LOG_LOST = "log message lost"
    TACTILE_NEEDED = "tactile readings stale, and the controller needs them"
    POSE_STALE = "object's pose stale"
    UNPLUGGED = "bus lost"


class Action(Enum):
    """What the runner does on a transition."""

    NONE = "none"
    FREEZE = "keep the last set-points"
    FREEZE_THEN_RELEASE = "keep the last set-points for 0.2 s, then torque off"
    RELEASE = "torque off at once"
    RELEASE_BLIND = "try torque off, then close the port"


class Transition(NamedTuple):
    """What follows a state and an event.

    Attributes:
        state: the next state; of FREEZE_THEN_RELEASE until the 0.2 s are over.
        action: what is done.
        torque: what is known of it once the action is done and was confirmed.
        final: the state once the action is done.
        advice: what the user should do, "" for nothing.
    """

    state: State
    action: Action
    torque: Torque
    final: State
    advice: str = ""


_CABLE = "check the cable and the power of these servos, and the USB latency timer"
_UNKNOWN = "torque state UNKNOWN: cut power"

_LIVE = (State.ARMED, State.RUN, State.HOLD)
_ROWS: tuple[tuple[tuple[State, ...], Event, Transition], ...] = (
    ((State.IDLE,), Event.ARM, Transition(State.ARMED, Action.NONE, Torque.ON, State.ARMED)),
    ((State.ARMED,), Event.START, Transition(State.RUN, Action.NONE, Torque.ON, State.RUN)),
    (
        (State.ARMED, State.RUN),
        Event.FINISHED,
        Transition(State.HOLD, Action.FREEZE_THEN_RELEASE, Torque.OFF, State.IDLE),
    ),
    (
        _LIVE,
        Event.INTERRUPT,
        Transition(State.HOLD, Action.FREEZE_THEN_RELEASE, Torque.OFF, State.IDLE),
    ),
    (
        _LIVE,
        Event.INTERRUPT_AGAIN,
        Transition(State.IDLE, Action.RELEASE, Torque.OFF, State.IDLE),
    ),
    (
        _LIVE,
        Event.READS_LOST,
        Transition(State.HOLD, Action.FREEZE_THEN_RELEASE, Torque.OFF, State.FAULT, _CABLE),
    ),
    (
        _LIVE,
        Event.ALERT,
        Transition(
            State.HOLD,
            Action.FREEZE_THEN_RELEASE,
            Torque.OFF,
            State.FAULT,
            "remove the cause, then: dexctl hardware check --reboot ID",
        ),
    ),
    (
        _LIVE,
        Event.WATCHDOG,
        Transition(
            State.FAULT, Action.RELEASE, Torque.OFF, State.FAULT, "arm again by starting a new run"
        ),
    ),
    (
        _LIVE,
        Event.UNPLUGGED,
        Transition(State.FAULT, Action.RELEASE_BLIND, Torque.UNKNOWN, State.FAULT, _UNKNOWN),
    ),
    *(
        ((State.ARMED, State.RUN), event, Transition(
            State.HOLD, Action.FREEZE, Torque.ON, State.HOLD, "Ctrl-C releases"
        ))
        for event in (
            Event.GOAL_NOT_FINITE,
            Event.COMMAND_STALE,
            Event.CONTROLLER_FAILED,
            Event.HEALTH_LASTS,
            Event.OVERRUNS,
            Event.TACTILE_NEEDED,
            Event.POSE_STALE,
        )
    ),
)  # fmt: skip

COUNTED = frozenset(
    {
        Event.READ_MISSED,
        Event.CLAMPED,
        Event.HEALTH_WARNING,
        Event.OVERRUNS_WARNING,
        Event.TACTILE_STALE,
        Event.LOG_LOST,
    }
)
"""Events that change nothing: they are counted, and told the first time."""

TABLE: Mapping[tuple[State, Event], Transition] = MappingProxyType(
    {(state, event): row for states, event, row in _ROWS for state in states}
)


def transition(state: State, event: Event) -> Transition | None:
    """What follows; None where the event changes nothing in this state."""
    return TABLE.get((state, event))
