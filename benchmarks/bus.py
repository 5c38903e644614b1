"""Servo bus over a pseudo-terminal: reading and writing all 15 servos, all checks on.

One cycle is what a control loop does at every tick: write 15 goal positions, read 15 present
currents, velocities and positions. The emulated servos run in a process of their own on the same
machine and take their share of its time. Measured in turns with dynamixel-sdk's groups and
rustypot, where installed, which check less (no per-servo errors, no range of goals).
"""

from __future__ import annotations

import importlib.util
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from measuring.results import Figure, write
from measuring.settings import Settings, settings
from measuring.timing import in_turns, spread

from hardware import registers as R  # noqa: N812 (a table of names)
from hardware.bus import Bus
from hardware.emulator import Emulator

IDS = list(range(1, 16))
PRESENT = [R.PRESENT_CURRENT, R.PRESENT_VELOCITY, R.PRESENT_POSITION]
WATCHED = [R.HARDWARE_ERROR, R.BUS_WATCHDOG, *PRESENT]
GOAL_HZ = 700


@dataclass(frozen=True, kw_only=True)
class BusSettings(Settings):
    """Cycles per second over a pseudo-terminal."""

    cycles: int = 1000
    """Cycles in a row of each client."""
    rounds: int = 10
    """How often the clients take turns."""


def ours(bus: Bus, registers: list[R.Register]) -> Callable[[int], Any]:
    goals = np.pi + np.linspace(-0.1, 0.1, 15)

    def cycle(i: int) -> None:
        bus.write(R.GOAL_POSITION, goals + 0.01 * (i % 10))
        for found in bus.read_many(registers):
            if not found.ok.all():
                raise SystemExit(f"servos {found.missing} did not answer")

    return cycle


def sdk(port: str) -> tuple[Callable[[int], Any], Callable[[], None]]:
    import dynamixel_sdk

    handler = dynamixel_sdk.PortHandler(port)
    handler.setBaudRate(4_000_000)
    packets = dynamixel_sdk.PacketHandler(2.0)
    goals = dynamixel_sdk.GroupSyncWrite(handler, packets, R.GOAL_POSITION.address, 4)
    present = dynamixel_sdk.GroupSyncRead(handler, packets, R.PRESENT_CURRENT.address, 10)
    for servo in IDS:
        goals.addParam(servo, [0, 8, 0, 0])
        present.addParam(servo)

    def cycle(i: int) -> None:
        for servo in IDS:
            goals.changeParam(servo, list(struct.pack("<i", 2048 + i % 10)))
        goals.txPacket()
        present.fastSyncRead()
        for register in PRESENT:
            for servo in IDS:
                present.getData(servo, register.address, register.size)

    return cycle, handler.closePort


def rusty(port: str) -> tuple[Callable[[int], Any], Callable[[], None]]:
    import rustypot

    client = rustypot.Xl430PyController(port, 4_000_000, 0.5)
    client.set_fast_sync_read(True)

    def cycle(i: int) -> None:
        client.sync_write_goal_position(IDS, [2048 + i % 10] * 15)
        for data in client.sync_read_raw_data(IDS, R.PRESENT_CURRENT.address, 10):
            struct.unpack("<hii", bytes(data))

    return cycle, client.close


def peers(given: BusSettings) -> dict[str, np.ndarray]:
    """Seconds per cycle of the other clients, each alone on an emulator of its own."""
    found = {}
    for name, module, make in (
        ("dynamixel-sdk, fast sync read", "dynamixel_sdk", sdk),
        ("rustypot, fast sync read", "rustypot", rusty),
    ):
        if importlib.util.find_spec(module) is None:
            continue
        with Emulator() as emulator:
            cycle, close = make(emulator.port)
            try:
                found[name] = in_turns({name: cycle}, given.cycles, given.rounds)[name]
            finally:
                close()
    return found


def main() -> None:
    given = settings(BusSettings, __doc__)
    with Emulator() as emulator, Bus(emulator.port, IDS, timeout=0.1) as bus:
        bus.write(R.OPERATING_MODE, R.OperatingMode.CURRENT_BASED_POSITION)
        bus.write(R.TORQUE_ENABLE, 1)
        calls = {"dexctl": ours(bus, PRESENT), "dexctl, errors too": ours(bus, WATCHED)}
        taken = in_turns(calls, given.cycles, given.rounds)
        counts = bus.statistics.as_dict()
    taken |= peers(given)
    spreads = {name: spread(seconds) for name, seconds in taken.items()}
    rates = {name: 1e6 / found["median_us"] for name, found in spreads.items()}
    p99 = {name: found["p99_us"] / 1000 for name, found in spreads.items()}
    figures = [
        Figure(
            "15 servos over a pseudo-terminal: goals written, positions, velocities, currents read",
            f"{rates['dexctl']:.0f} Hz median, p99 {p99['dexctl']:.2f} ms",
            f"at least {GOAL_HZ} Hz median",
            rates["dexctl"] >= GOAL_HZ,
        ),
        Figure(
            "the same with hardware errors and watchdogs in every read",
            f"{rates['dexctl, errors too']:.0f} Hz median, p99 {p99['dexctl, errors too']:.2f} ms",
        ),
    ]
    rows = [[name, f"{rates[name]:.0f}", f"{p99[name]:.2f}"] for name in spreads]
    table = {
        "title": "Servo bus, 15 emulated servos on a pseudo-terminal",
        "header": ["client", "median [Hz]", "p99 [ms]"],
        "rows": rows,
    }
    write("bus", given, figures, [table], spread=spreads, statistics=counts)


if __name__ == "__main__":
    main()
