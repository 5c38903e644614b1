"""Guard: starts the process of `hardware.guard`, and ends it once the torque is off."""

from __future__ import annotations

import contextlib
import subprocess
import sys

from hardware import guard
from hardware.exceptions import BusError


class Guard:
    """A process that sends ``packet`` over the port if this process dies before `close`.

    Args:
        port: descriptor of the open port; the guard holds it, and its lock, until it ends.
        packet: that takes the torque off.

    Raises:
        BusError: it cannot be started.
    """

    def __init__(self, port: int, packet: bytes) -> None:
        try:
            self._process = subprocess.Popen(
                # isolated and without site packages: it is quickly there, and nothing can break it
                [sys.executable, "-I", "-S", guard.__file__, str(port), packet.hex()],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                pass_fds=(port,),
                start_new_session=True,  # a kill of our process group leaves it alone
                bufsize=0,
            )
        except OSError as error:
            raise BusError(
                f"cannot start the guard that takes the torque off if this process dies: {error}"
            ) from None

    def close(self, done: bool = True) -> None:
        """End it; harmless when repeated.

        Args:
            done: whether all that can be done about the torque has been; else it sends torque-off.
        """
        stdin = self._process.stdin
        assert stdin is not None
        if not stdin.closed:
            if done:
                with contextlib.suppress(OSError):
                    stdin.write(guard.DONE)
            stdin.close()
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
