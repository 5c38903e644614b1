"""The emulator before two clients that others wrote: dynamixel-sdk and rustypot."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from hardware.emulator import Emulator

IDS = [1, 2, 3]
GOAL, PRESENT, TORQUE, ERROR = 116, 132, 64, 70


@pytest.fixture
def sdk(emulator: Emulator) -> Iterator[tuple[Any, Any, Any]]:
    """The SDK's module, its port and its packet handler."""
    module = pytest.importorskip("dynamixel_sdk")
    port = module.PortHandler(emulator.port)
    assert port.setBaudRate(4_000_000)
    yield module, port, module.PacketHandler(2.0)
    port.closePort()


@pytest.fixture
def rusty(emulator: Emulator) -> Iterator[Any]:
    module = pytest.importorskip("rustypot")
    client = module.Xl430PyController(emulator.port, 4_000_000, 2.0)
    yield client
    client.close()


def patiently(call: Any, *arguments: Any, good: int = 0) -> Any:
    """The SDK waits 34 ms and no longer, which a busy machine may not keep: ask again."""
    for _ in range(50):
        found = call(*arguments)
        if (found if isinstance(found, int) else found[-2]) == good:
            break
    return found


def test_sdk_single(sdk: tuple[Any, Any, Any]) -> None:
    _, port, handler = sdk
    assert patiently(handler.ping, port, 2) == (1030, 0, 0)
    assert patiently(handler.read4ByteTxRx, port, 2, PRESENT) == (2048, 0, 0)
    assert patiently(handler.write4ByteTxRx, port, 2, GOAL, 1000)[-1] == 0
    assert patiently(handler.read4ByteTxRx, port, 2, GOAL) == (1000, 0, 0)
    # refusals: read-only, out of range, unknown address
    assert patiently(handler.write4ByteTxRx, port, 2, PRESENT, 1) == (0, 7)
    assert patiently(handler.write1ByteTxRx, port, 2, TORQUE, 2) == (0, 4)
    assert patiently(handler.write1ByteTxRx, port, 2, 17, 2) == (0, 7)


def test_sdk_sync_and_bulk(sdk: tuple[Any, Any, Any], emulator: Emulator) -> None:
    module, port, handler = sdk
    write = module.GroupSyncWrite(port, handler, GOAL, 4)
    for servo in IDS:
        assert write.addParam(servo, [servo, 4, 0, 0])
    assert write.txPacket() == 0
    for call in ("txRxPacket", "fastSyncRead"):
        read = module.GroupSyncRead(port, handler, GOAL, 4)
        for servo in IDS:
            read.addParam(servo)
        assert patiently(getattr(read, call)) == 0
        assert [read.getData(servo, GOAL, 4) for servo in IDS] == [1025, 1026, 1027]
    for call in ("txRxPacket", "fastBulkRead"):
        bulk = module.GroupBulkRead(port, handler)
        bulk.addParam(1, GOAL, 4)
        bulk.addParam(3, 144, 2)
        assert patiently(getattr(bulk, call)) == 0
        assert (bulk.getData(1, GOAL, 4), bulk.getData(3, 144, 2)) == (1025, 120)
    bulk = module.GroupBulkWrite(port, handler)
    bulk.addParam(1, GOAL, 4, [7, 0, 0, 0])
    bulk.addParam(2, 65, 1, [1])
    assert bulk.txPacket() == 0
    assert patiently(handler.read4ByteTxRx, port, 1, GOAL)[0] == 7
    assert patiently(handler.read1ByteTxRx, port, 2, 65)[0] == 1


def test_sdk_reads_stuffed_bytes(sdk: tuple[Any, Any, Any]) -> None:
    _, port, handler = sdk
    assert patiently(handler.write1ByteTxRx, port, 1, 11, 5) == (0, 0)  # a mode that counts turns
    stuffed = 0x00FDFFFF - (1 << 24)  # FF FF FD FF on the wire: -131073
    assert patiently(handler.write4ByteTxRx, port, 1, GOAL, stuffed & 0xFFFFFFFF) == (0, 0)
    assert patiently(handler.read4ByteTxRx, port, 1, GOAL)[0] == stuffed & 0xFFFFFFFF


def test_sdk_sees_alert_and_reboots(sdk: tuple[Any, Any, Any], emulator: Emulator) -> None:
    _, port, handler = sdk
    emulator.overload(3)
    assert patiently(handler.read1ByteTxRx, port, 3, ERROR) == (32, 0, 128)
    assert patiently(handler.write1ByteTxRx, port, 3, TORQUE, 1) == (0, 129)
    assert handler.reboot(port, 3)[0] == 0
    emulator.advance(0.5)
    assert patiently(handler.read1ByteTxRx, port, 3, ERROR) == (0, 0, 0)


def test_sdk_registered_write(sdk: tuple[Any, Any, Any]) -> None:
    _, port, handler = sdk
    assert patiently(handler.regWriteTxRx, port, 1, GOAL, 4, [9, 0, 0, 0]) == (0, 0)
    assert patiently(handler.read1ByteTxRx, port, 1, 69)[0] == 1
    assert patiently(handler.read4ByteTxRx, port, 1, GOAL)[0] == 2048
    handler.action(port, 254)
    assert patiently(handler.read4ByteTxRx, port, 1, GOAL)[0] == 9


def test_rustypot(rusty: Any, emulator: Emulator) -> None:
    rusty.sync_write_torque_enable(IDS, [True] * 3)
    rusty.sync_write_goal_position(IDS, [1900, 2000, 2100])
    emulator.advance(3.0)
    for fast in (False, True):
        rusty.set_fast_sync_read(fast)
        assert list(rusty.sync_read_present_position(IDS)) == [1900, 2000, 2100]
        assert list(rusty.sync_read_goal_position(IDS)) == [1900, 2000, 2100]
    assert emulator.state()["torque_on"][:4] == [True, True, True, False]
    assert rusty.read_present_position(2) == [2000]
    found: dict[int, int] = {}
    for _ in range(50):  # its scan waits only briefly for each servo
        found |= rusty.scan(IDS)
        if len(found) == len(IDS):
            break
    assert found == dict.fromkeys(IDS, 1030)


def test_rustypot_reads_stuffed_bytes_and_errors(rusty: Any, emulator: Emulator) -> None:
    rusty.write_raw_data(1, 11, [5])
    rusty.write_raw_data(1, GOAL, [0xFF, 0xFF, 0xFD, 0xFF])
    assert list(rusty.read_raw_data(1, GOAL, 4)) == [0xFF, 0xFF, 0xFD, 0xFF]
    emulator.overload(2)
    found = rusty.sync_read_raw_data_with_error([1, 2], ERROR, 1)
    assert [(list(data), error) for data, error in found] == [([0], 0), ([32], 128)]
