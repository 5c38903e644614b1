"""Dynamixel Protocol 2.0 packets as pure functions, and a parser that survives any byte stream.

A packet is ``FF FF FD 00 | id | length (2) | instruction | parameters | CRC (2)``, where length
counts everything after itself; a status packet has instruction 0x55 and an error byte before its
parameters. ``FF FF FD`` inside instruction and parameters is sent as ``FF FF FD FD`` (byte
stuffing), so that a header never appears within a packet. The CRC is CRC-16 with polynomial
0x8005, initial value 0, no reflection, over everything before it. (Robotis e-Manual, "Protocol
2.0".)

Replies to fast reads are the exception: several servos write one packet together, whose length is
fixed before the data are known, so nothing in it can be stuffed.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from dexctl.exceptions import InvalidInput

HEADER = b"\xff\xff\xfd\x00"
BROADCAST = 0xFE
MAX_ID = 252
MAX_LENGTH = 4096  # of the length field; 15 servos read whole tables in less
_STUFF, _STUFFED = b"\xff\xff\xfd", b"\xff\xff\xfd\xfd"
_OVERHEAD = 7  # header, id, length
_LEAST = 3  # instruction, CRC


class Instruction(IntEnum):
    """Instruction codes; STATUS marks the answers."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    FACTORY_RESET = 0x06
    REBOOT = 0x08
    CLEAR = 0x10
    STATUS = 0x55
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83
    FAST_SYNC_READ = 0x8A
    BULK_READ = 0x92
    BULK_WRITE = 0x93
    FAST_BULK_READ = 0x9A


class Packet(NamedTuple):
    """A packet that passed its CRC.

    Attributes:
        id: of the servo addressed, or answering.
        instruction: its code; `Instruction.STATUS` for answers.
        parameters: without byte stuffing; of a status packet, the error byte comes first.
    """

    id: int
    instruction: int
    parameters: bytes

    @property
    def error(self) -> int:
        """The error byte of a status packet."""
        return self.parameters[0]

    @property
    def data(self) -> bytes:
        """What a status packet carries after its error byte."""
        return self.parameters[1:]


def _crc_table() -> list[int]:
    """CRC of every two-byte message, so that the loop below takes two bytes at a step."""
    crc = np.arange(1 << 16, dtype=np.uint32)
    for _ in range(16):
        crc = ((crc << 1) ^ np.where(crc & 0x8000, 0x8005, 0)) & 0xFFFF
    return crc.tolist()


_CRC = _crc_table()


def crc16(data: bytes | bytearray | memoryview, crc: int = 0) -> int:
    """CRC-16 of ``data``, continued from ``crc``."""
    table, size = _CRC, len(data)
    for word in struct.unpack_from(f">{size // 2}H", data):
        crc = table[crc ^ word]
    if size % 2:
        # the table's first 256 entries are those of single bytes
        crc = ((crc << 8) & 0xFFFF) ^ table[(crc >> 8) ^ data[-1]]
    return crc


def stuff(data: bytes) -> bytes:
    """``data`` with an ``FD`` added after each ``FF FF FD``."""
    return data.replace(_STUFF, _STUFFED) if _STUFF in data else data


def unstuff(data: bytes) -> bytes:
    """The inverse of `stuff`."""
    return data.replace(_STUFFED, _STUFF) if _STUFFED in data else data


def build(servo: int, instruction: int, parameters: bytes = b"") -> bytes:
    """The bytes of an instruction packet.

    Args:
        servo: ID from 0 to 252, or `BROADCAST`.
        instruction: its code.
        parameters: as they are; byte stuffing is added here.

    Raises:
        InvalidInput: no such ID, or too many parameters.
    """
    if not (0 <= servo <= MAX_ID or servo == BROADCAST):
        raise InvalidInput(f"servo ID is {servo}; expected 0 to {MAX_ID}, or {BROADCAST} for all")
    body = stuff(bytes((instruction,)) + parameters)
    if len(body) + 2 > MAX_LENGTH:
        raise InvalidInput(f"{len(parameters)} parameter bytes; a packet holds {MAX_LENGTH - 3}")
    packet = HEADER + struct.pack("<BH", servo, len(body) + 2) + body
    return packet + struct.pack("<H", crc16(packet))


def build_status(servo: int, error: int = 0, data: bytes = b"") -> bytes:
    """The bytes of a status packet, an answer."""
    return build(servo, Instruction.STATUS, bytes((error,)) + data)


def build_fast_status(answers: Sequence[tuple[int, int, bytes]]) -> bytes:
    """The one packet in which several servos answer a fast read.

    Args:
        answers: (ID, error byte, data) of each servo.

    Each part ends with the CRC of all bytes before it; the last one is the packet's own.
    """
    body = bytearray((Instruction.STATUS,))
    length = 1 + sum(4 + len(data) for _, _, data in answers)
    packet = bytearray(HEADER + struct.pack("<BH", BROADCAST, length) + body)
    crc, done = 0, 0
    for servo, error, data in answers:
        packet += bytes((error, servo)) + data
        crc = crc16(packet[done:], crc)
        done = len(packet)
        packet += struct.pack("<H", crc)
    return bytes(packet)


def split_fast_status(parameters: bytes, size: int) -> list[tuple[int, int, bytes]]:
    """(ID, error byte, data) of each servo in the answer to a fast sync read.

    Args:
        parameters: of the status packet, the error byte of the first servo included.
        size: bytes that each servo was asked for.
    """
    stride = size + 4  # error, id, data, CRC; the last CRC is the packet's and is already off
    return [
        (parameters[start + 1], parameters[start], parameters[start + 2 : start + 2 + size])
        for start in range(0, len(parameters) - size - 1, stride)
    ]


class Parser:
    """Takes bytes as they come and gives the packets in them.

    Bytes that belong to no packet, damaged packets and packets of impossible length are skipped
    and counted; a good packet after them is found however they are cut. At most `MAX_LENGTH` + 7
    bytes wait for the rest of a packet, and each header seen costs at most one CRC of that many.

    Attributes:
        crc_errors: packets whose CRC was wrong.
        skipped: bytes that belonged to no good packet.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()
        self.crc_errors = 0
        self.skipped = 0

    def clear(self) -> None:
        """Forget an unfinished packet."""
        self.skipped += len(self._buffer)
        self._buffer.clear()

    @property
    def waiting(self) -> int:
        """Bytes that wait for the rest of their packet."""
        return len(self._buffer)

    def feed(self, data: bytes) -> Iterator[Packet]:
        """Add ``data``; gives each packet completed by it."""
        self._buffer += data
        buffer = self._buffer
        while True:
            start = buffer.find(HEADER)
            if start < 0:  # keep what may be the beginning of a header
                self._skip(max(len(buffer) - len(HEADER) + 1, 0))
                return
            self._skip(start)
            if len(buffer) < _OVERHEAD:
                return
            servo, length = struct.unpack_from("<BH", buffer, 4)
            if not _LEAST <= length <= MAX_LENGTH or (servo > MAX_ID and servo != BROADCAST):
                self._skip(1)
                continue
            end = _OVERHEAD + length
            if len(buffer) < end:
                # A damaged length must not swallow the packets behind it: a header cannot appear
                # inside a stuffed packet. (A fast answer may hold one; there, wait.)
                if servo != BROADCAST and (nested := buffer.find(HEADER, 4)) >= 0:
                    self._skip(nested)
                    continue
                return
            packet = self._take(end)
            if packet is not None:
                yield packet

    def _take(self, end: int) -> Packet | None:
        buffer = self._buffer
        if crc16(buffer[: end - 2]) != buffer[end - 2] | buffer[end - 1] << 8:
            self.crc_errors += 1
            self._skip(1)  # its length may be what is damaged: look for a header inside
            return None
        servo, instruction = buffer[4], buffer[7]
        parameters = bytes(buffer[8 : end - 2])
        del buffer[:end]
        if instruction == Instruction.STATUS:
            if not parameters:  # an answer without an error byte is none
                self.skipped += end
                return None
            if servo == BROADCAST:  # a fast answer, not stuffed
                return Packet(servo, instruction, parameters)
        return Packet(servo, instruction, unstuff(parameters))

    def _skip(self, count: int) -> None:
        if count:
            self.skipped += count
            del self._buffer[:count]
