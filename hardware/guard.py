"""The guard of an armed hand: takes the torque off when the run's process dies without doing so.

A process that is killed (SIGKILL), aborts or crashes runs no Python any more, and the servos keep
their torque. So a second process holds the port too, in a session of its own, and waits: if its
standard input ends before it was told that all is done, whoever armed the hand is dead, and it
sends torque-off for a second. It does not ask the servos whether they heard it.

This file is run by its path and loads nothing of ours: it is there in a few milliseconds.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import time

DONE = b"."
SECONDS = 1.0  # for which torque-off is sent
_PAUSE = 0.02


def send_off(port: int, packet: bytes, seconds: float = SECONDS) -> bool:
    """Write ``packet`` again and again; whether the port took it."""
    end, taken = time.monotonic() + seconds, False
    while time.monotonic() < end:
        try:
            taken |= os.write(port, packet) == len(packet)
        except BlockingIOError:  # full: once more
            pass
        except OSError:  # unplugged
            return False
        time.sleep(_PAUSE)
    return taken


def main(port: int, packet: bytes) -> int:
    """Wait for the end of standard input; torque off unless it was announced."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT"):
        signal.signal(getattr(signal, name), signal.SIG_IGN)
    said = b""
    while data := os.read(0, 16):
        said += data
    if said.endswith(DONE):
        return 0
    sent = send_off(port, packet)
    with contextlib.suppress(OSError):
        how = "torque-off was sent, unconfirmed" if sent else "torque-off could not be sent"
        said = (
            f"dexctl: what armed the hand has ended with its torque on; {how}: look, or cut power\n"
        )
        os.write(2, said.encode())
    return 0


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), bytes.fromhex(sys.argv[2])))
