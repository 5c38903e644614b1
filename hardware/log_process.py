"""The process that writes a run's log: frames on stdin, an MCAP file on stdout.

A process of its own, so that neither the disk nor Python's lock can delay the control loop. It
loads nothing but mcap. A frame is ``<B`` topic index, ``<Q`` time [ns], ``<I`` length, then that
many bytes of JSON. It ends when its stdin does, which also happens if the run's process is killed:
the file is then complete up to that moment.
"""

from __future__ import annotations

import os
import shutil
import struct
import sys
from pathlib import Path
from typing import BinaryIO

TOPICS = ("/run", "/tick", "/health", "/event", "/summary")
FRAME = struct.Struct("<BQI")
_SCHEMA = b'{"type": "object"}'


def write_log(source: BinaryIO, descriptor: int, path: Path) -> None:
    """Write frames from ``source`` to an open file until it ends.

    Without chunks and flushed at each message: what was written before a crash can be read.

    Args:
        source: the frames.
        descriptor: of the file, for reading and writing.
        path: of the file; should it be deleted meanwhile, it is written anew at the end.
    """
    from mcap.writer import Writer

    with os.fdopen(descriptor, "wb", closefd=False) as file:
        writer = Writer(file, use_chunking=False, enable_data_crcs=True)
        writer.start(profile="", library="dexctl")
        schema = writer.register_schema(name="json", encoding="jsonschema", data=_SCHEMA)
        told = False
        channels = [
            writer.register_channel(topic=topic, message_encoding="json", schema_id=schema)
            for topic in TOPICS
        ]
        while len(header := source.read(FRAME.size)) == FRAME.size:
            topic, nanoseconds, length = FRAME.unpack(header)
            data = source.read(length)
            if len(data) < length:
                break  # the run's process was killed in the middle of a frame
            writer.add_message(channels[topic], nanoseconds, data, nanoseconds)
            file.flush()
            if not told and _deleted(file):
                told = True
                say(f"{path} was deleted during the run; it is written anew at the end")
        writer.finish()
        file.flush()
        if _deleted(file):
            path.parent.mkdir(parents=True, exist_ok=True)
            os.lseek(descriptor, 0, os.SEEK_SET)
            with path.open("wb") as anew, os.fdopen(descriptor, "rb", closefd=False) as old:
                shutil.copyfileobj(old, anew)


def _deleted(file: BinaryIO) -> bool:
    """Whether the open file has no name any more; what is written to it is lost once it closes."""
    return os.fstat(file.fileno()).st_nlink == 0


def say(what: str) -> None:
    """One line for the run, on standard error."""
    print(what, file=sys.stderr, flush=True)


if __name__ == "__main__":
    try:
        write_log(sys.stdin.buffer, 1, Path(sys.argv[1]))
    except OSError as problem:
        sys.exit(f"{problem.strerror or problem}: {sys.argv[1]}")
