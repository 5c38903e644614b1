"""The line format, and readings that may not be used."""

from __future__ import annotations

import os
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexctl.exceptions import InvalidInput
from hardware.tactile import LineParser, NoTactile, SerialTactile, format_line, judge, parse_line

P, N = np.array([0.01, -0.02, 0.13]), np.array([0.0, 0.6, 0.8])


def test_a_line_by_hand() -> None:
    body = b"T,2,0.01,-0.02,0.13,0,0.6,0.8,1.5"
    checksum = 0
    for byte in body:
        checksum ^= byte
    line = body + b"*" + f"{checksum:02x}".encode()
    assert format_line(2, P, N, 1.5) == line.upper() + b"\n"
    found = parse_line(line)
    assert found is not None and found[0] == 2
    np.testing.assert_allclose(found[1], [*P, *N, 1.5])


def test_bad_lines() -> None:
    line = format_line(2, P, N, 1.5).rstrip().decode()
    assert parse_line(line.encode()) is not None
    for damaged in ("*", "T", "1.5", "0.6", ","):
        assert parse_line(line.replace(damaged, "7", 1).encode()) is None, damaged
    for impossible in (
        format_line(0, P, N, float("nan")),
        format_line(0, P, N, -1.0),
        format_line(0, P, 2.0 * N, 1.0),
        b"",
        b"*",
        b"T,0*",
    ):
        assert parse_line(impossible.rstrip()) is None, impossible


@given(st.lists(st.binary(max_size=300), max_size=8))
def test_any_bytes_are_survived(chunks: list[bytes]) -> None:
    parser = LineParser(5)
    for chunk in chunks:
        parser.feed(chunk, 1.0)
    parser.feed(b"\n" + format_line(4, P, N, 2.0), 7.0)
    assert parser.force[4] == 2.0 and parser.taken[4] == 7.0


def test_lines_may_come_in_pieces_and_of_too_many_fingers() -> None:
    parser, line = LineParser(5), format_line(1, P, N, 2.0)
    parser.feed(line[:7], 1.0)
    parser.feed(line[7:] + format_line(5, P, N, 2.0), 2.0)
    assert parser.taken.tolist() == [-np.inf, 2.0, -np.inf, -np.inf, -np.inf]
    assert parser.bad_lines == 1
    parser.feed(b"x" * 1000, 3.0)
    parser.feed(b"\n" + line, 4.0)
    assert parser.taken[1] == 4.0


def test_old_weak_and_broken_readings_are_no_contact() -> None:
    position, normal = np.tile(P, (5, 1)), np.tile(N, (5, 1))
    normal[4] = 0.0
    force = np.array([2.0, 0.99, 2.0, np.nan, 2.0])
    taken = np.array([9.95, 9.95, 9.85, 9.95, 9.95])
    found = judge(position, normal, force, taken, 10.0)
    assert found.in_contact.tolist() == [True, False, False, False, False]
    assert found.stale.tolist() == [False, False, True, False, False]
    assert (found.position[1:] == 0).all() and (found.force[1:] == 0).all()
    np.testing.assert_allclose(found.normal[0], N)


def test_without_tactile_fingertips_everything_is_stale() -> None:
    reading = NoTactile(5).read()
    assert reading.stale.all() and not reading.in_contact.any()


def test_a_serial_port_that_falls_silent() -> None:
    pytest.importorskip("serial")
    here, there = os.openpty()
    source = SerialTactile(os.ttyname(there), 5, most_age=0.2)
    try:
        assert source.read().stale.all()
        os.write(here, format_line(3, P, N, 2.0) + b"rubbish\n")
        end = time.monotonic() + 5.0
        while not (reading := source.read()).in_contact[3] and time.monotonic() < end:
            time.sleep(0.005)
        assert reading.in_contact.tolist() == [False, False, False, True, False]
        assert source.bad_lines <= 1
        time.sleep(0.25)
        reading = source.read()
        assert reading.stale.all() and not reading.in_contact.any() and (reading.force == 0).all()
        os.close(there)
        os.close(here)
        assert source.read().stale.all() and source.read().stale.all()
        assert source.lost
    finally:
        source.close()


def test_what_waited_to_be_read_is_as_old_as_it_may_be() -> None:
    """Lines that nobody had read for seconds were dated when they were: what had gone was felt."""
    pytest.importorskip("serial")
    here, there = os.openpty()
    source = SerialTactile(os.ttyname(there), 5, most_age=0.2)
    try:
        os.write(here, format_line(3, P, N, 2.0))
        time.sleep(0.5)
        reading = source.read()
        assert reading.stale.all() and not reading.in_contact.any()
        os.write(here, format_line(3, P, N, 2.0))
        end = time.monotonic() + 5.0
        while not (reading := source.read()).in_contact[3] and time.monotonic() < end:
            time.sleep(0.005)
        assert reading.in_contact[3]  # read often enough it is new
    finally:
        source.close()
        os.close(here)
        os.close(there)


def test_no_such_port() -> None:
    pytest.importorskip("serial")
    with pytest.raises(InvalidInput, match="cannot open the tactile port '/dev/none'"):
        SerialTactile("/dev/none", 5)
