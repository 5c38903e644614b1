"""Errors of the servo bus: what happened, on which port, and what to look at."""

from __future__ import annotations

from dexctl.exceptions import DexctlError


def tell_torque(error: BaseException, message: str) -> None:
    """Let an error say what is known of the torque, so that whoever meets it is told.

    Our own errors say it in their message, all others in a note (PEP 678), which tracebacks and
    the command line show.
    """
    if isinstance(error, DexctlError):
        error.args = (f"{error}; {message}", *error.args[1:])
    else:
        error.add_note(message)


class BusError(DexctlError, RuntimeError):
    """The servo bus cannot do what was asked."""


class PortBusy(BusError):
    """Another program holds the port."""


class PortLost(BusError):
    """The port is gone: unplugged, or its adapter has lost power.

    Whether the servos still hold their torque cannot be known from here.
    """


class ServoError(BusError):
    """A servo did not answer, or refused an instruction.

    Attributes:
        servo: its ID.
        status: error number of its status packet without the alert bit; 0 if it never answered.
        alert: whether it reported a hardware error.
        answered: whether it answered at all.
    """

    def __init__(
        self,
        message: str,
        servo: int,
        *,
        status: int = 0,
        alert: bool = False,
        answered: bool = True,
    ) -> None:
        super().__init__(message)
        self.servo = servo
        self.status = status
        self.alert = alert
        self.answered = answered
