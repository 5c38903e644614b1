"""Where a tracker says that the object is: a small interface, and a source that listens on UDP.

A tracker, such as a camera and whatever makes poses of its pictures, is a process of its own, in
any language: its work must not stall the bus. It sends a datagram for each pose, as text in SI
units::

    O,<age>,<px>,<py>,<pz>,<qw>,<qx>,<qy>,<qz>

``p`` is the centre of the object's shape and ``q`` its orientation as a unit quaternion, both in
the world (palm) frame of the hand model; ``age`` is how old the picture is when the datagram is
sent. Datagrams of any other kind are counted and left out. `pose_line` writes one.

A pose that is too old is marked stale, and a run that goes by it is held.
"""

from __future__ import annotations

import socket
import time
from typing import NamedTuple, Protocol

import numpy as np

from dexctl.exceptions import InvalidInput
from dexctl.state import Floats

MOST_AGE = 0.3
"""How old a pose may be: at 1 rad/s the object has turned by as many radians since [s]."""
LOCAL = "127.0.0.1"
_LONGEST = 1024  # bytes of a datagram that are looked at
_MOST = 1000  # datagrams that are looked at in one call, more than wait in a socket


class TrackedPose(NamedTuple):
    """Where the object is.

    Attributes:
        position: centre of its shape, world frame, ``(3,)`` [m].
        quaternion: its orientation, wxyz, unit, ``(4,)``.
        time: when it was there, on the clock of ``time.monotonic`` [s].
        stale: whether that is too long ago to be used.
    """

    position: Floats
    quaternion: Floats
    time: float
    stale: bool


class PoseSource(Protocol):
    """Anything that knows where the object is."""

    def read(self) -> TrackedPose | None:
        """The newest that is known; returns at once. None: nothing has been known so far."""
        ...

    def close(self) -> None:
        """Let go of the device."""
        ...


def pose_line(position: Floats, quaternion: Floats, age: float = 0.0) -> bytes:
    """The datagram of a pose; what `parse_pose` reads."""
    return ",".join(["O", *(f"{value:.6g}" for value in (age, *position, *quaternion))]).encode()


def parse_pose(line: bytes) -> tuple[float, Floats, Floats] | None:
    """(age, position ``(3,)``, quaternion ``(4,)``) of a datagram; None if it is not right."""
    kind, *fields = line.strip().split(b",")
    if kind != b"O" or len(fields) != 8:
        return None
    try:
        numbers = np.array([float(field) for field in fields])
    except ValueError:
        return None
    length = float(np.linalg.norm(numbers[4:]))
    if not np.isfinite(numbers).all() or numbers[0] < 0 or abs(length - 1.0) > 0.05:
        return None
    return float(numbers[0]), numbers[1:4], numbers[4:] / length


class UdpTracker:
    """Poses that a tracker sends to a UDP port.

    Datagrams are taken as they come, in :meth:`read`; nothing waits and there is no thread. So it
    is to be called more often than every ``most_age``: a datagram found after a longer pause may
    have waited since the last call, and counts as that old. A sender that never pauses does not
    keep a call from coming back.

    Args:
        where: port to listen on, or HOST:PORT; without a host only this machine is heard.
        most_age: older poses are stale [s].
        least_age: of several the newest that is as old as this is told [s], which makes a quick
            tracker as late as one that a policy has learned with.

    Attributes:
        bad: datagrams that could not be used.
        port: that is listened on.

    Raises:
        InvalidInput: no such place, or somebody else listens there.
    """

    def __init__(self, where: str, *, most_age: float = MOST_AGE, least_age: float = 0.0) -> None:
        place = parse_place(where)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._socket.bind(place)
        except OSError as error:
            self._socket.close()
            said = f"cannot listen for a tracker at {where}: {error.strerror}"
            raise InvalidInput(said) from None
        self.port = int(self._socket.getsockname()[1])
        self._most_age, self._least_age = most_age, least_age
        self._asked = time.monotonic()  # when it was read last
        # of which time, and the pose; oldest first, of those that are old enough the newest alone
        self._told: list[tuple[float, Floats, Floats]] = []
        self.bad = 0

    def read(self) -> TrackedPose | None:
        """The newest pose that has come and is old enough, or the oldest; None: none has."""
        now, before = time.monotonic(), self._asked
        self._asked = now
        arrived = now if now - before <= self._most_age else before
        for _ in range(_MOST):
            try:
                found = parse_pose(self._socket.recv(_LONGEST))
            except OSError:  # nothing more is there
                break
            if found is None:
                self.bad += 1
                continue
            taken = arrived - found[0]
            if not self._told or taken >= self._told[-1][0]:
                self._told.append((taken, found[1], found[2]))
        while len(self._told) > 1 and self._told[1][0] <= now - self._least_age:
            del self._told[0]
        if not self._told:
            return None
        taken, position, quaternion = self._told[0]
        return TrackedPose(position, quaternion, taken, now - taken > self._most_age)

    def close(self) -> None:
        """Close the port."""
        self._socket.close()


def parse_place(where: str) -> tuple[str, int]:
    """Host and port of ``[HOST:]PORT``.

    Raises:
        InvalidInput: it is none.
    """
    host, _, port = where.rpartition(":")
    if not (port.isascii() and port.isdigit() and 0 <= int(port) <= 65535):
        raise InvalidInput(f"the tracker's port is {where!r}; expected [HOST:]PORT, 0 to 65535")
    return host or LOCAL, int(port)


def wait_for_pose(source: PoseSource, seconds: float) -> TrackedPose:
    """The first pose that is not stale.

    Raises:
        InvalidInput: none has come for ``seconds``.
    """
    end = time.monotonic() + seconds
    while True:
        pose = source.read()
        if pose is not None and not pose.stale:
            return pose
        if time.monotonic() >= end:
            raise InvalidInput(
                f"{silence(source, seconds)}; expected one at least every {MOST_AGE:g} s"
            )
        time.sleep(0.005)


def silence(source: PoseSource, seconds: float) -> str:
    """That nothing has been told for so long [s], for people; and what came in place of it."""
    bad = getattr(source, "bad", 0)
    said = f", and {bad} datagrams that are no pose" if bad else ""
    return f"the tracker has told no pose for {seconds:g} s{said}"


class Heard(NamedTuple):
    """What a tracker has told while somebody listened.

    Attributes:
        poses: how many.
        rate: poses a second [Hz].
        age: of a pose when it was found, median [s].
        position: of the last pose, ``(3,)`` [m]; NaN where there was none.
        spread: standard deviation of the coordinates ``(3,)`` [m], of an object at rest its noise.
    """

    poses: int
    rate: float
    age: float
    position: Floats
    spread: Floats


def listen(source: PoseSource, seconds: float) -> Heard:
    """What ``source`` tells for a while."""
    begin = time.monotonic()
    ages: list[float] = []
    places: list[Floats] = []
    last = -np.inf
    while (now := time.monotonic()) < begin + seconds:
        pose = source.read()
        if pose is not None and pose.time > last:
            last = pose.time
            ages.append(now - pose.time)
            places.append(pose.position)
        time.sleep(0.001)
    if not places:
        nothing = np.full(3, np.nan)
        return Heard(0, 0.0, np.nan, nothing, nothing)
    return Heard(
        len(places),
        len(places) / seconds,
        float(np.median(ages)),
        places[-1],
        np.std(places, axis=0),
    )
