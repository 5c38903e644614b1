"""Finding servos: on which port, at which speed, which IDs and models."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from dexctl.exceptions import InvalidInput
from hardware import port
from hardware.bus import Bus
from hardware.exceptions import BusError
from hardware.readings import Ping

_USUAL = (4_000_000, 57_600, 1_000_000)  # of hands, of new servos, of many other robots
BAUD_RATES = (*_USUAL, *(rate for rate in reversed(port.BAUD_RATES) if rate not in _USUAL))
"""In the order in which they are tried."""


class Found(NamedTuple):
    """Servos that answered.

    Attributes:
        port: path of the device.
        baudrate: [bit/s].
        servos: what each said, by ID.
    """

    port: str
    baudrate: int
    servos: dict[int, Ping]


def discover(
    ports: Sequence[str], baudrates: Iterable[int] = BAUD_RATES, timeout: float = 0.01
) -> Found:
    """The first port and speed at which servos answer; asks everybody, 0.8 s a port and speed.

    Each that answers is then asked by itself: answers to everybody may collide on a real line, and
    a servo that was heard only as noise is found so by a second call to everybody.

    Raises:
        InvalidInput: nobody answers; names what was tried.
        BusError: no port could be opened.
    """
    rates, refused = list(baudrates), ""
    for device in ports:
        for baudrate in rates:
            try:
                with Bus(device, [1], baudrate=baudrate, timeout=timeout) as bus:
                    heard = bus.everyone()
                    if not heard and not bus.statistics.bytes_received:
                        continue
                    servos = bus.scan(sorted(heard | bus.everyone()))
            except BusError as error:
                refused = str(error)
                break  # of this port
            if servos:
                return Found(device, baudrate, servos)
    if refused and len(ports) == 1:
        raise BusError(refused)
    raise InvalidInput(
        f"no servo answers on {', '.join(ports) or 'any port: there is none'} at "
        f"{', '.join(map(str, rates))} bit/s; check power, cable and adapter"
        + (f" ({refused})" if refused else "")
    )


def find_baudrate(device: str, ids: Sequence[int], timeout: float = 0.01) -> int | None:
    """The speed at which one of the first servos answers; None if at none of them."""
    for baudrate in BAUD_RATES:
        with Bus(device, ids, baudrate=baudrate, timeout=timeout) as bus:
            if bus.scan(ids[:3]):
                return baudrate
    return None
