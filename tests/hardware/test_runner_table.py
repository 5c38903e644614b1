"""The fault table, row by row: state and event, then state, action, torque and where it ends."""

from __future__ import annotations

from hardware.state_machine import COUNTED, TABLE, Action, Event, State, Torque, transition

I, A, R, H, F = State.IDLE, State.ARMED, State.RUN, State.HOLD, State.FAULT  # noqa: E741
FREEZE, SOON = Action.FREEZE, Action.FREEZE_THEN_RELEASE

ROWS = [
    (I, Event.ARM, A, Action.NONE, Torque.ON, A),
    (A, Event.START, R, Action.NONE, Torque.ON, R),
    (R, Event.FINISHED, H, SOON, Torque.OFF, I),
    (R, Event.INTERRUPT, H, SOON, Torque.OFF, I),
    (R, Event.INTERRUPT_AGAIN, I, Action.RELEASE, Torque.OFF, I),
    (H, Event.INTERRUPT_AGAIN, I, Action.RELEASE, Torque.OFF, I),
    (R, Event.READS_LOST, H, SOON, Torque.OFF, F),
    (H, Event.READS_LOST, H, SOON, Torque.OFF, F),
    (R, Event.ALERT, H, SOON, Torque.OFF, F),
    (H, Event.ALERT, H, SOON, Torque.OFF, F),
    (R, Event.WATCHDOG, F, Action.RELEASE, Torque.OFF, F),
    (R, Event.GOAL_NOT_FINITE, H, FREEZE, Torque.ON, H),
    (R, Event.COMMAND_STALE, H, FREEZE, Torque.ON, H),
    (R, Event.CONTROLLER_FAILED, H, FREEZE, Torque.ON, H),
    (R, Event.HEALTH_LASTS, H, FREEZE, Torque.ON, H),
    (R, Event.OVERRUNS, H, FREEZE, Torque.ON, H),
    (R, Event.TACTILE_NEEDED, H, FREEZE, Torque.ON, H),
    (R, Event.POSE_STALE, H, FREEZE, Torque.ON, H),
    (R, Event.UNPLUGGED, F, Action.RELEASE_BLIND, Torque.UNKNOWN, F),
]


def test_rows() -> None:
    for state, event, *expected in ROWS:
        found = transition(state, event)
        assert found is not None, (state, event)
        assert found[:4] == tuple(expected), (state, event)


def test_counted_events_change_nothing() -> None:
    for state in State:
        for event in COUNTED:
            assert transition(state, event) is None


def test_every_event_is_in_the_table_or_counted() -> None:
    met = {event for _, event in TABLE}
    assert met | COUNTED | {Event.HELD} == set(Event)
    assert not met & COUNTED


def test_every_live_state_ends_without_torque_when_it_must() -> None:
    for state in (A, R, H):
        for event in (Event.INTERRUPT, Event.INTERRUPT_AGAIN, Event.ALERT, Event.UNPLUGGED):
            found = transition(state, event)
            assert found is not None and found.torque is not Torque.ON


def test_faults_are_left_by_hand_only() -> None:
    assert not [event for state, event in TABLE if state is F]


def test_torque_on_is_only_said_of_live_states() -> None:
    for row in TABLE.values():
        assert (row.torque is Torque.ON) == (row.final in (A, R, H))
        if row.torque is Torque.UNKNOWN:
            assert "cut power" in row.advice
