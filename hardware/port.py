"""SerialPort: one serial device, held alone, with a deadline on everything."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import select
import termios
import time
from pathlib import Path

from dexctl.exceptions import InvalidInput, MissingExtra
from hardware.exceptions import BusError, PortBusy, PortLost

BAUD_RATES = (
    9600, 57600, 115200, 1_000_000, 2_000_000, 3_000_000, 4_000_000
)  # those that both the servos and dynamixel-sdk take  # fmt: skip


class SerialPort:
    """A serial device that no other program may open meanwhile.

    dynamixel-sdk's `PortHandler` opens and configures it; reading and writing wait in the kernel,
    not by spinning, and never beyond their deadline.

    Args:
        path: of the device, such as "/dev/ttyUSB0".
        baudrate: one of `BAUD_RATES` [bit/s].

    Raises:
        InvalidInput: no such baud rate.
        MissingExtra: dynamixel-sdk is not installed.
        PortBusy: another program holds it.
        BusError: it cannot be opened.
    """

    def __init__(self, path: str, baudrate: int) -> None:
        if baudrate not in BAUD_RATES:
            raise InvalidInput(
                f"baudrate is {baudrate}; expected one of {', '.join(map(str, BAUD_RATES))}"
            )
        try:
            from dynamixel_sdk import PortHandler
        except ImportError:
            raise MissingExtra("the servo bus", "hardware") from None
        self.path = str(path)
        self.baudrate = baudrate
        self._lock = self._take_lock()  # before the port is configured: it may be another's
        self._handler = PortHandler(self.path)
        try:
            self._handler.setBaudRate(baudrate)
            device = self._handler.ser
            if device is None:
                raise OSError(f"dynamixel-sdk does not open it at {baudrate} baud")
            self._fd = device.fileno()
            fcntl.ioctl(self._fd, termios.TIOCEXCL)
        except (OSError, termios.error) as error:  # pyserial's errors are OSErrors
            os.close(self._lock)
            raise self._refusal(error) from None
        self._poll = select.poll()
        self._poll.register(self._fd, select.POLLIN)
        self._open = True

    def _take_lock(self) -> int:
        try:
            lock = os.open(self.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        except OSError as error:
            raise self._refusal(error) from None
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(lock)
            raise self._refusal(error) from None
        return lock

    def _refusal(self, error: BaseException) -> BusError:
        number = getattr(error, "errno", None)
        if number in (errno.EBUSY, errno.EWOULDBLOCK):
            return PortBusy(f"{self.path}: another program holds this port")
        if number in (errno.ENOENT, errno.ENXIO, errno.ENODEV, errno.EIO):
            return PortLost(f"{self.path}: no such port; is the adapter plugged in?")
        if number == errno.EACCES:
            return BusError(f"{self.path}: permission denied; add yourself to the group 'dialout'")
        return BusError(f"{self.path}: cannot be opened as a serial port ({error})")

    @property
    def descriptor(self) -> int:
        """The open file, for a process that is to hold the port too.

        Raises:
            BusError: the port is closed.
        """
        return self._descriptor()

    @property
    def latency_timer(self) -> float | None:
        """Latency timer of an FTDI adapter [s], None for other ports.

        It should be 1 ms; at its default of 16 ms a bus makes no more than about 55 cycles/s.
        """
        name = Path(self.path).resolve().name
        setting = Path("/sys/bus/usb-serial/devices") / name / "latency_timer"
        try:
            return int(setting.read_text()) * 1e-3
        except (OSError, ValueError):
            return None

    def send(self, data: bytes, timeout: float) -> None:
        """Write all of ``data``.

        Raises:
            PortLost: the port has vanished.
            BusError: it does not take the bytes in ``timeout`` [s].
        """
        deadline = time.monotonic() + timeout
        while data:
            try:
                data = data[os.write(self._descriptor(), data) :]
            except BlockingIOError:
                if time.monotonic() > deadline:
                    raise BusError(
                        f"{self.path}: the port took no bytes for {timeout:g} s"
                    ) from None
                select.select([], [self._fd], [], max(deadline - time.monotonic(), 0.0))
            except OSError:
                raise self._lost() from None

    def receive(self, deadline: float) -> bytes:
        """Bytes as soon as there are some; empty at ``deadline`` (of `time.monotonic`).

        Raises:
            PortLost: the port has vanished.
        """
        fd = self._descriptor()
        try:
            with contextlib.suppress(BlockingIOError):
                if data := os.read(fd, 4096):
                    return data
            while True:
                left = deadline - time.monotonic()
                if left <= 0:
                    return b""
                # poll counts milliseconds; rounding up keeps it from spinning
                if self._poll.poll(int(left * 1000) + 1):
                    data = os.read(fd, 4096)
                    if not data:  # hung up
                        raise self._lost()
                    return data
        except BlockingIOError:
            return b""
        except OSError:
            raise self._lost() from None

    def clear(self) -> None:
        """Forget bytes that have come in.

        Raises:
            PortLost: the port has vanished.
        """
        try:
            termios.tcflush(self._descriptor(), termios.TCIFLUSH)
        except (OSError, termios.error):
            raise self._lost() from None

    def _descriptor(self) -> int:
        if not self._open:
            raise BusError(f"{self.path}: the port is closed")
        return self._fd

    def _lost(self) -> PortLost:
        return PortLost(
            f"{self.path}: the port is gone (unplugged?); torque state UNKNOWN: cut the power"
        )

    def close(self) -> None:
        """Give the port back; harmless when repeated."""
        if not self._open:
            return
        self._open = False
        with contextlib.suppress(OSError, termios.error):
            fcntl.ioctl(self._fd, termios.TIOCNXCL)
        with contextlib.suppress(OSError, termios.error):
            self._handler.closePort()
        os.close(self._lock)
