r"""What fingertips feel: a small interface, and a source that reads lines from a serial port.

The line format, one line per reading of one finger, numbers in SI units::

    T,<finger>,<px>,<py>,<pz>,<nx>,<ny>,<nz>,<force>*<checksum>\n

``finger`` counts from 0; ``p`` is the contact point and ``n`` the unit normal from the fingertip
into the object, both in the world (palm) frame of the hand model; ``force`` is the normal force. A
finger that touches nothing sends force 0 (position and normal are then not looked at). The
checksum is the exclusive or of all bytes before the ``*``, two hexadecimal digits. Lines of any
other kind are counted and left out.

Readings below 1 N are not trusted (thesis, evaluation on the real hand), and a reading that is
too old is marked stale and counts as no contact: it is never handed out again as if it were new.
"""

from __future__ import annotations

import os
import time
from typing import Any, NamedTuple, Protocol

import numpy as np

from dexctl.exceptions import InvalidInput, MissingExtra
from dexctl.state import Bools, Floats

TRUSTED_FORCE = 1.0
MOST_AGE = 0.1
_LONGEST_LINE = 200


class TactileReading(NamedTuple):
    """What m fingertips feel.

    Attributes:
        position: contact points, world frame, ``(m, 3)`` [m].
        normal: unit, from the fingertip into the object, ``(m, 3)``.
        force: normal force, ``(m,)`` [N].
        time: when each was taken, on the clock of ``time.monotonic``, ``(m,)`` [s]; -inf: never.
        stale: whether it is too old to be used, ``(m,)`` bool.
        in_contact: fresh, and at least the trusted force, ``(m,)`` bool; the other rows of
            position, normal and force are zero.
    """

    position: Floats
    normal: Floats
    force: Floats
    time: Floats
    stale: Bools
    in_contact: Bools


class TactileSource(Protocol):
    """Anything that knows what the fingertips feel."""

    def read(self) -> TactileReading:
        """What is known now; returns at once."""
        ...

    def close(self) -> None:
        """Let go of the device."""
        ...


def judge(
    position: Floats,
    normal: Floats,
    force: Floats,
    taken: Floats,
    now: float,
    trusted_force: float = TRUSTED_FORCE,
    most_age: float = MOST_AGE,
) -> TactileReading:
    """A reading with what may not be used marked and zeroed.

    Args:
        position, normal, force, taken: as in `TactileReading`.
        now: time [s].
        trusted_force: weakest force that counts as touch [N].
        most_age: older readings are stale [s].
    """
    stale = ~(now - taken <= most_age)
    length = np.linalg.norm(normal, axis=1)
    finite = np.isfinite(position).all(1) & np.isfinite(length) & np.isfinite(force)
    touch = ~stale & finite & (length > 0.5) & (force >= trusted_force)
    rows = touch[:, None]
    unit = normal / np.where(length > 0.5, length, 1.0)[:, None]
    return TactileReading(
        np.where(rows, position, 0.0),
        np.where(rows, unit, 0.0),
        np.where(touch, force, 0.0),
        taken.copy(),
        stale,
        touch,
    )


class NoTactile:
    """A hand without tactile fingertips: nothing is felt, and all of it is stale.

    Args:
        n_fingers: m.
    """

    def __init__(self, n_fingers: int) -> None:
        self._nothing = judge(
            np.zeros((n_fingers, 3)),
            np.zeros((n_fingers, 3)),
            np.zeros(n_fingers),
            np.full(n_fingers, -np.inf),
            0.0,
        )

    def read(self) -> TactileReading:
        """Nothing."""
        return self._nothing

    def close(self) -> None:
        """Nothing to let go of."""


class LineParser:
    """Readings out of a stream of bytes in the line format of this module.

    Args:
        n_fingers: m; lines of other fingers are bad lines.

    Attributes:
        position, normal, force: the last ones of each finger.
        taken: when their bytes arrived, as `feed` was told [s]; -inf where none has.
        bad_lines: how many lines could not be used.
    """

    def __init__(self, n_fingers: int) -> None:
        self.position = np.zeros((n_fingers, 3))
        self.normal = np.zeros((n_fingers, 3))
        self.force = np.zeros(n_fingers)
        self.taken = np.full(n_fingers, -np.inf)
        self.bad_lines = 0
        self._rest = b""

    def feed(self, data: bytes, now: float) -> None:
        """Take bytes that arrived at time ``now`` [s]. Never raises, whatever they are."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > _LONGEST_LINE:  # no line end in sight: do not hoard
            self._rest = b""
            self.bad_lines += 1
        for line in lines:
            found = parse_line(line.rstrip(b"\r"))
            if found is None or not 0 <= found[0] < len(self.force):
                self.bad_lines += 1
                continue
            finger, numbers = found
            self.position[finger] = numbers[:3]
            self.normal[finger] = numbers[3:6]
            self.force[finger] = numbers[6]
            self.taken[finger] = now


def parse_line(line: bytes) -> tuple[int, Floats] | None:
    """(finger, [p, n, force] ``(7,)``) of a line without its end; None if it is not right."""
    body, star, checksum = line.rpartition(b"*")
    fields = body.split(b",")
    if not star or len(fields) != 9 or fields[0] != b"T" or len(checksum) != 2:
        return None
    try:
        if int(checksum, 16) != _checksum(body):
            return None
        finger, numbers = int(fields[1]), np.array([float(field) for field in fields[2:]])
    except ValueError:
        return None
    if not np.isfinite(numbers).all() or numbers[6] < 0:
        return None
    touching = numbers[6] > 0
    if touching and abs(np.linalg.norm(numbers[3:6]) - 1.0) > 0.05:
        return None
    return finger, numbers


def format_line(finger: int, position: Floats, normal: Floats, force: float) -> bytes:
    """The line of one reading, its end included; what `parse_line` reads."""
    numbers = ",".join(f"{value:.6g}" for value in (*position, *normal, force))
    body = f"T,{finger},{numbers}".encode()
    return body + f"*{_checksum(body):02X}\n".encode()


def _checksum(body: bytes) -> int:
    value = 0
    for byte in body:
        value ^= byte
    return value


class SerialTactile:
    """Fingertips that send lines over a serial port of their own.

    Bytes are taken as they come, in :meth:`read`; nothing waits and there is no thread. So it is to
    be called more often than every ``most_age``: what it finds after a longer pause may have been
    waiting since the last call, and counts as that old. After an unplug the readings grow stale
    and `lost` is set.

    Args:
        port: device, such as /dev/ttyACM0.
        n_fingers: m.
        baudrate: [bit/s].
        trusted_force: weakest force that counts as touch [N].
        most_age: older readings are stale [s].

    Raises:
        MissingExtra: pyserial is not installed.
        InvalidInput: the port cannot be opened.
    """

    def __init__(
        self,
        port: str,
        n_fingers: int,
        *,
        baudrate: int = 115_200,
        trusted_force: float = TRUSTED_FORCE,
        most_age: float = MOST_AGE,
    ) -> None:
        try:
            import serial
        except ImportError:
            raise MissingExtra("tactile sensing over a serial port", "hardware") from None
        try:
            self._serial: Any = serial.Serial(port, baudrate, timeout=0, exclusive=True)
        except (OSError, ValueError) as error:  # SerialException is an OSError
            number = getattr(error, "errno", None)
            why = os.strerror(number) if number else error
            raise InvalidInput(f"cannot open the tactile port {port!r}: {why}") from None
        self._parser = LineParser(n_fingers)
        self._trusted_force, self._most_age = trusted_force, most_age
        self._asked = time.monotonic()  # when it was read last
        self.lost = False

    @property
    def bad_lines(self) -> int:
        """How many lines could not be used."""
        return self._parser.bad_lines

    def read(self) -> TactileReading:
        """The newest reading of each finger."""
        now, before = time.monotonic(), self._asked
        self._asked = now
        arrived = now if now - before <= self._most_age else before
        if not self.lost:
            try:
                self._parser.feed(self._serial.read(self._serial.in_waiting), arrived)
            except (OSError, TypeError):  # pyserial answers an unplug with either
                self.lost = True
        parser = self._parser
        return judge(
            parser.position,
            parser.normal,
            parser.force,
            parser.taken,
            now,
            self._trusted_force,
            self._most_age,
        )

    def close(self) -> None:
        """Close the port."""
        self._serial.close()
