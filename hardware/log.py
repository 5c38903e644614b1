"""Logs of runs: written by another process behind a bounded queue, read back as arrays.

The queue is the pipe to that process. A message is handed over without ever waiting: where the
pipe is full the message is dropped and counted, and the control loop goes on.
"""

from __future__ import annotations

import contextlib
import fcntl
import io
import json
import os
import struct
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from dexctl.exceptions import InvalidInput, MissingExtra
from dexctl.files import is_path
from dexctl.hand import HandModel
from dexctl.state import Floats
from hardware.log_process import FRAME, TOPICS

_PIPE_BYTES = 1 << 20  # about 8 s of ticks at 50 Hz; the kernel may grant less
_INDEX = {topic: i for i, topic in enumerate(TOPICS)}


class LogWriter:
    """Hands messages to the process that writes them.

    Args:
        path: the MCAP file; replaced if it is there.

    Attributes:
        dropped: messages that found the queue full, or the process gone, or that JSON cannot hold.
        refused: why JSON could not hold the last one of those, "" if there was none.
        error: what the process said when it failed, "" if it did not.

    Raises:
        MissingExtra: mcap is not installed.
        InvalidInput: the file cannot be written.
    """

    def __init__(self, path: str | Path) -> None:
        if find_spec("mcap") is None:
            raise MissingExtra("logging", "hardware")
        self.path = Path(path).expanduser()
        try:
            file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o666)
        except OSError as error:
            raise InvalidInput(f"cannot write {self.path}: {error.strerror}") from None
        self.dropped = 0
        self.refused = ""
        self.error = ""
        self._said: list[str] = []
        self._pending = b""
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
        # a session of its own: Ctrl-C in the terminal is for the run, the log ends after it
        self._process = subprocess.Popen(
            [sys.executable, "-m", "hardware.log_process", str(self.path)],
            stdin=subprocess.PIPE,
            stdout=file,
            stderr=subprocess.PIPE,
            start_new_session=True,
            env=environment,
            bufsize=0,
        )
        os.close(file)
        assert self._process.stdin is not None
        assert self._process.stderr is not None
        self._pipe = self._process.stdin.fileno()
        os.set_blocking(self._pipe, False)
        os.set_blocking(self._process.stderr.fileno(), False)
        if hasattr(fcntl, "F_SETPIPE_SZ"):
            with contextlib.suppress(OSError):  # a smaller queue is a queue too
                fcntl.fcntl(self._pipe, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)

    def write(self, topic: str, message: Mapping[str, Any], nanoseconds: int | None = None) -> bool:
        """Hand over one message; returns whether there was room for it. Never waits.

        Args:
            topic: one of `TOPICS`.
            message: values that JSON knows, or arrays; what is not finite becomes null.
            nanoseconds: when it was; default now.
        """
        try:
            data = encode(message)
        except Exception as problem:  # noqa: BLE001 (whatever it is, the run goes on without)
            self.refused = " ".join(f"{topic}: {type(problem).__name__}: {problem}".split())
            self.dropped += 1
            return False
        if not self._push():
            self.dropped += 1
            return False
        now = time.time_ns() if nanoseconds is None else nanoseconds
        self._pending = FRAME.pack(_INDEX[topic], now, len(data)) + data
        self._push()
        return True

    def _push(self) -> bool:
        """Write what is left of the last frame; whether all of it is through."""
        while self._pending:
            try:
                self._pending = self._pending[os.write(self._pipe, self._pending) :]
            except (BlockingIOError, BrokenPipeError):
                return False
        return True

    def trouble(self) -> str:
        """What the process has complained of since the last call, "" for nothing. Never waits."""
        assert self._process.stderr is not None
        if self._process.stderr.closed:
            return ""
        with contextlib.suppress(BlockingIOError):
            data = os.read(self._process.stderr.fileno(), 4096)
            self._said += data.decode(errors="replace").strip().splitlines()
            if data:
                return self._said[-1]
        return ""

    def close(self, timeout: float = 10.0) -> None:
        """Let the process finish the file; waits for at most ``timeout`` [s]. Idempotent."""
        if self._process.stdin is None or self._process.stdin.closed:
            return
        end = time.monotonic() + timeout
        while not self._push() and self._process.poll() is None and time.monotonic() < end:
            time.sleep(0.005)
        self.dropped += bool(self._pending)
        self._process.stdin.close()
        try:
            self._process.wait(max(end - time.monotonic(), 0.1))
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        assert self._process.stderr is not None
        while self.trouble():
            pass
        self._process.stderr.close()
        if self._process.returncode:
            self.error = self._said[-1] if self._said else f"exit code {self._process.returncode}"

    def __enter__(self) -> LogWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def encode(message: Mapping[str, Any]) -> bytes:
    """As JSON; arrays become lists, numbers that are not finite null."""
    try:
        return json.dumps(message, default=_listed, allow_nan=False).encode()
    except ValueError:
        return json.dumps(_finite(message), allow_nan=False).encode()


def _listed(value: object) -> object:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return str(value)


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if not isinstance(value, str | int | float | list | tuple | None):
        value = _listed(value)
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


@dataclass(frozen=True, eq=False)
class Log:
    """A log, read.

    Attributes:
        path: the file.
        run: what was run: controller, hand, period, calibration, limits, machine.
        ticks: by name, a row for each tick: ``time`` ``(T,)`` [s] since the start, ``q``,
            ``q_target`` ``(T, d)`` and whatever else the ticks hold; null became NaN.
        health, events: messages, each with its ``time`` [s].
        summary: what the run said at its end; {} where it never came to it.
        cut: whether the file ends before its end mark.
        damage: what else is wrong with the file, for people; "" for nothing. Messages that cannot
            be read, and ticks without what every tick has, are left out.
    """

    path: Path
    run: Mapping[str, Any]
    ticks: Mapping[str, np.ndarray]
    health: tuple[Mapping[str, Any], ...]
    events: tuple[Mapping[str, Any], ...]
    summary: Mapping[str, Any]
    cut: bool
    messages: int = 0
    damage: str = ""


def hand_of(log: Log, asked: str | None = None) -> str:
    """Name or file of the hand ``asked`` for, else of the one that a log is of.

    Raises:
        InvalidInput: none is asked for, and the log does not say it.
    """
    if asked is not None:
        return asked
    scene, files = (log.run.get(name) for name in ("scene", "hand_files"))
    named = scene.get("hand") if isinstance(scene, Mapping) else None
    # logs from before files were told by their absolute paths
    if isinstance(named, str) and is_path(named) and not Path(named).expanduser().is_file():
        elsewhere = files.get("toml") if isinstance(files, Mapping) else None
        named = elsewhere if isinstance(elsewhere, str) else named
    if not isinstance(named, str):
        raise InvalidInput(f"{log.path} does not say which hand it is of; expected --hand")
    return named


def check_joints(log: Log, hand: HandModel) -> None:
    """Refuse a log of another hand.

    Raises:
        InvalidInput: its joints are not those of ``hand``.
    """
    count, names = log.ticks["q"].shape[1], log.run.get("joints")
    asked = "expected --hand with the hand of the log"
    if count != hand.nq:
        raise InvalidInput(f"{log.path} has {count} joints, and {hand.name} has {hand.nq}; {asked}")
    known = names if isinstance(names, list) and len(names) == count else hand.joint_names
    for j, (said, own) in enumerate(zip(known, hand.joint_names, strict=True)):
        if said != own:
            raise InvalidInput(
                f"joint {j + 1} of {log.path} is {said}, and that of {hand.name} is {own}; {asked}"
            )


def of_joints(run: Mapping[str, Any], count: int, *path: str) -> Floats | None:
    """What a log says first of each of ``count`` joints; None where it does not say it.

    Args:
        run: `Log.run`.
        count: of the joints, d.
        path: where it stands, as one number for all joints or as d numbers.
    """
    value: Any = run
    for name in path:
        value = value.get(name) if isinstance(value, Mapping) else None
    found = value if isinstance(value, list) else [value] * count
    numbers = all(isinstance(one, int | float) and not isinstance(one, bool) for one in found)
    if len(found) != count or not numbers or not np.isfinite(found).all():
        return None
    return np.array(found, float)


def limits_of(run: Mapping[str, Any], count: int, name: str) -> Floats | None:
    """The "speed_limit" or "torque_limit" ``(d,)`` that each joint had [rad/s], [N m], or None."""
    found = of_joints(run, count, "joint_limits", name)
    # logs from before each joint had its own
    return of_joints(run, count, "limits", name) if found is None else found


def read_log(path: str | Path) -> Log:
    """Read a log, one cut off at any byte included.

    Raises:
        InvalidInput: no such file, or one that is not MCAP.
        MissingExtra: mcap is not installed.
    """
    if find_spec("mcap") is None:
        raise MissingExtra("reading logs", "hardware")
    path = Path(path).expanduser()
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InvalidInput(f"cannot read {path}: {error.strerror}") from None
    topics: dict[str, list[dict[str, Any]]] = {topic: [] for topic in TOPICS}
    ends: set[_End] = set()
    unread = 0
    for item in _messages(content, path):
        if isinstance(item, _End):
            ends.add(item)
        elif item is None:
            unread += 1
        else:
            topics[item[0]].append(item[1])
    ticks, health, events = (
        _alike(topics[topic], needed)
        for topic, needed in (("/tick", TICK), ("/health", HEALTH), ("/event", EVENT))
    )
    unread += sum(
        len(topics[topic]) - len(kept)
        for topic, kept in (("/tick", ticks), ("/health", health), ("/event", events))
    )
    damage = [f"{unread} messages are damaged and left out"] if unread else []
    damage += ["its checksum is wrong"] if _End.CHECKSUM in ends else []
    names = [name for name in ticks[0] if all(name in tick for tick in ticks)] if ticks else []
    return Log(
        path=path,
        run=topics["/run"][0] if topics["/run"] else {},
        ticks={name: _column([tick[name] for tick in ticks]) for name in names},
        health=tuple(health),
        events=tuple(events),
        summary=topics["/summary"][-1] if topics["/summary"] else {},
        cut=not ends,
        messages=sum(len(found) for found in topics.values()),
        damage="; ".join(damage),
    )


TICK = ("time", "state", "q", "q_target", "velocity", "torque", "fresh", "age", "in_contact",
        "contact_force", "lateness")  # fmt: skip
HEALTH = ("time", "voltage", "temperature")
EVENT = ("time", "event", "state", "detail")


def _alike(messages: list[dict[str, Any]], needed: tuple[str, ...]) -> list[dict[str, Any]]:
    """Messages whose values of ``needed`` are of the form that those of most have."""
    forms = [tuple(_form(message.get(name, _MISSING)) for name in needed) for message in messages]
    if not forms:
        return []
    ((usual, _),) = Counter(forms).most_common(1)
    return [message for message, form in zip(messages, forms, strict=True) if form == usual]


_MISSING = object()


def _form(value: object) -> object:
    """What kind of value it is: one of the same form fits into the same array."""
    if isinstance(value, list):
        inside = {_form(item) for item in value}
        return (len(value), inside.pop()) if len(inside) == 1 else (len(value), frozenset(inside))
    if value is None or isinstance(value, float | int):
        return "number"
    return "missing" if value is _MISSING else type(value).__name__


class _End(Enum):
    MARK = "the end mark"
    CHECKSUM = "the end, with another checksum than the writer's"


def _messages(content: bytes, path: Path) -> Iterator[tuple[str, dict[str, Any]] | _End | None]:
    """(topic, message) of what is whole in the file; None of what is not; its end."""
    from mcap.exceptions import McapError
    from mcap.records import Channel, Footer, Message
    from mcap.stream_reader import CRCValidationError, StreamReader

    magic = b"\x89MCAP0\r\n"
    if content[: len(magic)] != magic[: len(content)]:
        raise InvalidInput(f"{path} is no MCAP file")
    names: dict[int, str] = {}
    # No record is longer than the file: a length made of half a number must not ask for memory.
    reader = StreamReader(io.BytesIO(content), record_size_limit=len(content), validate_crcs=True)
    try:
        for record in reader.records:
            if isinstance(record, Channel):
                names[record.id] = record.topic
            elif isinstance(record, Message) and names.get(record.channel_id) in _INDEX:
                message = _parsed(record.data)
                yield None if message is None else (names[record.channel_id], message)
            elif isinstance(record, Footer):
                yield _End.MARK
    except CRCValidationError:
        yield _End.CHECKSUM
    except (McapError, EOFError, struct.error, ValueError, LookupError, OverflowError):
        return  # cut off here, or the records' own lengths are damaged


def _parsed(data: bytes) -> dict[str, Any] | None:
    """A message; None where it is none."""
    try:
        message = json.loads(data)
    except (ValueError, RecursionError):
        return None
    return message if isinstance(message, dict) else None


def _column(values: list[Any]) -> np.ndarray:
    """Numbers as an array of floats, anything else as objects."""
    try:
        return np.array(values, float)
    except (TypeError, ValueError):
        column = np.empty(len(values), object)
        column[:] = values
        return column
