"""A tracker's poses: datagrams, which of them count, and what the hand's states have of them."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import dexctl
from dexctl.exceptions import InvalidInput
from dexctl.rotations import from_rotation_vector
from hardware.bus import Bus
from hardware.hand import ServoHand
from hardware.tracking import (
    TrackedPose,
    UdpTracker,
    parse_place,
    parse_pose,
    pose_line,
    wait_for_pose,
)

P, Q = np.array([0.01, -0.02, 0.13]), np.array([0.6, 0.0, 0.0, 0.8])


@pytest.fixture
def tracker() -> Iterator[UdpTracker]:
    opened = UdpTracker("0", most_age=0.5)
    yield opened
    opened.close()


def send(tracker: UdpTracker, *lines: bytes) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for line in lines:
            sender.sendto(line, ("127.0.0.1", tracker.port))


def test_a_datagram_by_hand() -> None:
    line = b"O,0.04,0.01,-0.02,0.13,0.6,0,0,0.8"
    assert pose_line(P, Q, 0.04) == line
    found = parse_pose(line + b"\n")
    assert found is not None and found[0] == 0.04
    np.testing.assert_allclose(found[1], P)
    np.testing.assert_allclose(found[2], Q)


@given(
    st.lists(st.floats(-1, 1), min_size=3, max_size=3),
    st.lists(st.floats(-3, 3), min_size=3, max_size=3),
    st.floats(0, 10),
)
def test_there_and_back(place: list[float], turn: list[float], age: float) -> None:
    q = from_rotation_vector(np.array(turn))
    found = parse_pose(pose_line(np.array(place), q, age))
    assert found is not None
    np.testing.assert_allclose(found[1], place, atol=1e-5)
    np.testing.assert_allclose(found[2], q, atol=1e-5)
    assert np.linalg.norm(found[2]) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize(
    "line",
    [
        b"",
        b"O",
        b"T,0,0,0,0,1,0,0,0",
        b"O,0,0,0,0,1,0,0",
        b"O,0,0,0,0,1,0,0,0,0",
        b"O,0,0,0,0,2,0,0,0",
        b"O,0,0,0,0,0,0,0,0",
        b"O,nan,0,0,0,1,0,0,0",
        b"O,0,inf,0,0,1,0,0,0",
        b"O,-1,0,0,0,1,0,0,0",
        b"O,0,0,0,x,1,0,0,0",
        b"\xff\xfe",
    ],
)
def test_what_is_no_pose(line: bytes) -> None:
    assert parse_pose(line) is None


@given(st.binary(max_size=300))
def test_any_bytes_are_survived(data: bytes) -> None:
    parse_pose(data)


def test_the_newest_counts_and_grows_stale(tracker: UdpTracker) -> None:
    assert tracker.read() is None
    # the picture of the first was taken last; the third comes of another one, too late
    send(tracker, pose_line(P, Q, 0.01), b"hello", pose_line(2 * P, Q, 0.2))
    pose = tracker.read()
    assert pose is not None and not pose.stale and tracker.bad == 1
    np.testing.assert_allclose(pose.position, P)
    assert 0.01 <= time.monotonic() - pose.time < 0.4
    send(tracker, pose_line(3 * P, Q))
    pose = tracker.read()
    assert pose is not None
    np.testing.assert_allclose(pose.position, 3 * P)
    time.sleep(0.6)
    pose = tracker.read()
    assert pose is not None and pose.stale


def test_a_quick_tracker_is_made_as_late_as_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Poses 40 ms apart, each told when it is 100 ms old; the oldest one until there is such."""
    tracker = UdpTracker("0", least_age=0.1)
    clock = [time.monotonic()]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    told = []
    for i in range(8):
        clock[0] += 0.04
        send(tracker, pose_line((i + 1) * P, Q, 0.01))
        pose = tracker.read()
        assert pose is not None and not pose.stale
        told.append(round(float(pose.position[0] / P[0])))
        # the third is told 90 ms after its picture: when it is read next it is 130 ms old
        assert clock[0] - pose.time < 0.14
    assert told == [1, 1, 1, 1, 2, 3, 4, 5]
    clock[0] += 0.25  # nothing has come: the newest that is old enough
    pose = tracker.read()
    assert pose is not None and round(float(pose.position[0] / P[0])) == 8 and not pose.stale
    tracker.close()


def test_what_has_waited_is_as_old_as_the_last_look(tracker: UdpTracker) -> None:
    tracker.read()
    send(tracker, pose_line(P, Q))
    time.sleep(0.6)  # longer than a pose may be old: nobody knows when it came
    pose = tracker.read()
    assert pose is not None and pose.stale


def test_a_flood_does_not_keep_the_bus_waiting(
    tracker: UdpTracker, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Flood:
        def recv(self, size: int) -> bytes:
            return pose_line(P, Q)

        def close(self) -> None:
            pass

    tracker.close()
    monkeypatch.setattr(tracker, "_socket", Flood())
    pose = tracker.read()
    assert pose is not None and not pose.stale


@pytest.mark.parametrize("where", ["", "port", "70000", "-1", "1.5", "here:"])
def test_bad_places(where: str) -> None:
    with pytest.raises(InvalidInput, match=r"the tracker's port is .*; expected \[HOST:\]PORT"):
        parse_place(where)
    with pytest.raises(InvalidInput):
        UdpTracker(where)


def test_places() -> None:
    assert parse_place("5005") == ("127.0.0.1", 5005)
    assert parse_place("0.0.0.0:5005") == ("0.0.0.0", 5005)


def test_a_place_that_is_taken(tracker: UdpTracker) -> None:
    with pytest.raises(InvalidInput, match=f"cannot listen for a tracker at {tracker.port}: Addr"):
        UdpTracker(str(tracker.port))
    with pytest.raises(InvalidInput, match="cannot listen for a tracker at nowhere.invalid:7"):
        UdpTracker("nowhere.invalid:7")


def test_waiting_for_the_first(tracker: UdpTracker) -> None:
    send(tracker, b"hello")
    with pytest.raises(InvalidInput, match=r"no pose for 0.05 s, and 1 datagrams that are no pose"):
        wait_for_pose(tracker, 0.05)
    send(tracker, pose_line(P, Q))
    np.testing.assert_allclose(wait_for_pose(tracker, 5.0).position, P)


class Told:
    """A tracker that says what it is told to say."""

    def __init__(self, pose: TrackedPose | None = None) -> None:
        self.pose = pose

    def read(self) -> TrackedPose | None:
        return self.pose

    def close(self) -> None:
        pass


def test_states_have_the_pose_unless_it_is_stale(bus: Bus, dex5: dexctl.HandModel) -> None:
    told = Told()
    hand = ServoHand(bus, dex5, tracker=told)
    hand.configure()
    state = hand.read()
    assert state.object_position is None and hand.pose is None and state.goal_quaternion is None
    told.pose = TrackedPose(P, Q, time.monotonic(), False)
    hand.goal = np.array([1.0, 0.0, 0.0, 0.0])
    state = hand.read()
    assert state.object_position is not None and state.goal_quaternion is not None
    np.testing.assert_array_equal(state.object_position, P)
    np.testing.assert_array_equal(state.object_quaternion, Q)
    np.testing.assert_array_equal(state.goal_quaternion, hand.goal)
    told.pose = told.pose._replace(stale=True)
    assert hand.read().object_position is None
    assert hand.pose is told.pose  # of which the log says how old it is
