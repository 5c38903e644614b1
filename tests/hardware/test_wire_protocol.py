"""Protocol 2.0 packets: against hand-made bytes, against dynamixel-sdk, and against noise."""

from __future__ import annotations

import random
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexctl.exceptions import InvalidInput
from hardware.protocol import (
    BROADCAST,
    HEADER,
    MAX_LENGTH,
    Instruction,
    Packet,
    Parser,
    build,
    build_fast_status,
    build_status,
    crc16,
    split_fast_status,
    stuff,
    unstuff,
)

# bytes that make headers and stuffing likely
NASTY = st.lists(
    st.one_of(st.sampled_from([0xFF, 0xFD, 0x00, 0x55]), st.integers(0, 255)), max_size=60
).map(bytes)


def parse(data: bytes) -> list[Packet]:
    return list(Parser().feed(data))


def bitwise_crc(data: bytes) -> int:
    crc = 0
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1) ^ 0x8005 if crc & 0x8000 else crc << 1
    return crc & 0xFFFF


def test_packets_of_the_manual() -> None:
    assert build(1, Instruction.PING) == bytes.fromhex("ff ff fd 00 01 03 00 01 19 4e")
    read = build(1, Instruction.READ, bytes.fromhex("84 00 04 00"))  # present position
    assert read == bytes.fromhex("ff ff fd 00 01 07 00 02 84 00 04 00 1d 15")
    status = bytes.fromhex("ff ff fd 00 01 08 00 55 00 a6 00 00 00 8c c0")
    assert parse(status) == [Packet(1, 0x55, bytes.fromhex("00 a6 00 00 00"))]
    assert build_status(1, 0, bytes.fromhex("a6 00 00 00")) == status


def test_stuffing_by_hand() -> None:
    assert stuff(b"\xff\xff\xfd\x01") == b"\xff\xff\xfd\xfd\x01"
    assert stuff(b"\xff\xff\xfd\xfd") == b"\xff\xff\xfd\xfd\xfd"
    assert stuff(b"\xff\xfd\xff\xff") == b"\xff\xfd\xff\xff"


@given(NASTY)
def test_crc_is_the_bitwise_one(data: bytes) -> None:
    assert crc16(data) == bitwise_crc(data)
    assert crc16(data[7:], crc16(data[:7])) == crc16(data)


@given(NASTY)
def test_stuffing_inverts_and_hides_headers(data: bytes) -> None:
    assert unstuff(stuff(data)) == data
    assert HEADER not in stuff(data)


@given(st.integers(0, 252), st.sampled_from([2, 3, 0x55, 0x83]), NASTY, NASTY, st.integers(1, 9))
def test_what_is_built_is_parsed(
    servo: int, code: int, parameters: bytes, noise: bytes, step: int
) -> None:
    parameters = parameters or b"\x01"
    data = build(servo, code, parameters) + build(3, 1)
    parser, found = Parser(), []
    for start in range(0, len(data), step):  # however it is cut
        found += parser.feed(data[start : start + step])
    assert found == [Packet(servo, code, parameters), Packet(3, 1, b"")]
    assert parser.crc_errors == parser.skipped == parser.waiting == 0


@given(NASTY)
def test_the_sdk_reads_what_is_built(parameters: bytes) -> None:
    sdk = pytest.importorskip("dynamixel_sdk").Protocol2PacketHandler()
    packet = build(7, Instruction.STATUS, b"\x00" + parameters)
    assert sdk.updateCRC(0, packet, len(packet) - 2) == packet[-2] | packet[-1] << 8
    plain = sdk.removeStuffing(list(packet))
    length = plain[5] | plain[6] << 8
    assert bytes(plain[9 : 7 + length - 2]) == parameters


@given(NASTY, st.integers(0, 200), st.integers(0, 7))
def test_a_damaged_packet_is_lost_alone(parameters: bytes, at: int, bit: int) -> None:
    damaged = bytearray(build(1, 3, parameters + b"\x00"))
    damaged[at % len(damaged)] ^= 1 << bit
    parser = Parser()
    # two good ones: a damaged length may ask for bytes of the next one before its CRC fails
    good = build(2, 2, b"\x01\x02\x03\x04")
    found = list(parser.feed(bytes(damaged) + good + good))
    assert found[-2:] == [Packet(2, 2, b"\x01\x02\x03\x04")] * 2
    assert all(packet.id == 2 for packet in found)


def test_random_streams() -> None:
    """10,000 random streams: no exception, nothing hoarded, and a good packet still found."""
    source = random.Random(1)
    start = time.perf_counter()
    for _ in range(10_000):
        parser = Parser()
        for _ in range(source.randrange(1, 6)):
            kind = source.random()
            if kind < 0.4:
                data = source.randbytes(source.randrange(80))
            elif kind < 0.7:  # headers with any length and id
                data = HEADER + source.randbytes(source.randrange(30))
            else:
                data = bytearray(build(source.randrange(253), 3, source.randbytes(20)))
                data[source.randrange(len(data))] = source.randrange(256)
            for packet in parser.feed(bytes(data)):
                assert 0 <= packet.id <= BROADCAST
            assert parser.waiting <= MAX_LENGTH + 7
        parser.clear()
        assert list(parser.feed(build(9, 1))) == [Packet(9, 1, b"")]
    assert time.perf_counter() - start < 60


def test_a_long_hostile_stream_is_quick() -> None:
    parser = Parser()
    hostile = (HEADER + b"\xfe\x00\x10\x55") * 4000  # fast answers of 4096 bytes that never were
    start = time.perf_counter()
    assert list(parser.feed(hostile)) == []
    assert parser.waiting <= MAX_LENGTH + 7
    assert time.perf_counter() - start < 20


def test_fast_answers() -> None:
    answers = [(1, 0, b"abcd"), (2, 0x80, HEADER), (9, 0, b"\xff\xff\xfd\xfd")]
    data = build_fast_status(answers)
    (packet,) = parse(data)
    assert packet.id == BROADCAST
    assert split_fast_status(packet.parameters, 4) == answers
    # each part ends with the CRC of everything before it
    assert data[8 + 6 : 8 + 8] == crc16(data[:14]).to_bytes(2, "little")
    assert split_fast_status(packet.parameters[:10], 4) == answers[:1]


def test_an_answer_without_error_byte_is_none() -> None:
    assert parse(build(1, Instruction.STATUS)) == []


def test_what_cannot_be_built() -> None:
    for servo in (-1, 253, 255, 1000):
        with pytest.raises(InvalidInput, match=f"servo ID is {servo}"):
            build(servo, Instruction.PING)
    with pytest.raises(InvalidInput, match="5000 parameter bytes"):
        build(1, Instruction.WRITE, bytes(5000))
