"""The process that writes a run's log: frames on stdin, an MCAP file out.

A process of its own, so that neither the disk nor Python's lock can delay the control loop. It
loads nothing but mcap. A frame is ``<B`` topic index, ``<Q`` time [ns], ``<I`` length, then that
many bytes of JSON. It ends when its stdin does, which also happens if the run's process is killed:
the file is then complete up to that moment.
"""

from __future__ import annotations

import struct
import sys
from pathlib import Path
from typing import BinaryIO

TOPICS = ("/run", "/tick", "/health", "/event", "/summary")
FRAME = struct.Struct("<BQI")
_SCHEMA = b'{"type": "object"}'


def write_log(source: BinaryIO, path: Path) -> None:
    """Write frames from ``source`` to ``path`` until it ends.

    Without chunks and flushed at each message: what was written before a crash can be read.
    """
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file, use_chunking=False)
        writer.start(profile="", library="dexctl")
        schema = writer.register_schema(name="json", encoding="jsonschema", data=_SCHEMA)
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
        writer.finish()


if __name__ == "__main__":
    try:
        write_log(sys.stdin.buffer, Path(sys.argv[1]))
    except OSError as problem:
        sys.exit(f"{problem.strerror or problem}: {sys.argv[1]}")
