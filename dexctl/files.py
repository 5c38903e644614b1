"""Files that are either whole or not there: written aside, made durable, then renamed."""

from __future__ import annotations

import errno
import os
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from dexctl.exceptions import InvalidInput

if TYPE_CHECKING:
    import numpy as np

DAMAGED = (
    EOFError,
    LookupError,
    MemoryError,  # of a parser, for what is nested too deep; or of a size that nothing has
    OSError,
    OverflowError,
    RuntimeError,  # among them RecursionError and NotImplementedError; and an encrypted file
    SyntaxError,
    TypeError,
    ValueError,
    struct.error,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
)
"""All that zipfile, numpy's reader of headers and the JSON reader raise for what is not theirs."""


def read_arrays(path: Path, what: str, names: Sequence[str] | None = None) -> dict[str, np.ndarray]:
    """The arrays of a ``.npz`` file; those of ``names`` that there are, None: all.

    Raises:
        InvalidInput: no such file, none of these, or a damaged one; the message says ``what``.
    """
    import numpy as np

    try:
        with path.open("rb") as stream:
            if stream.read(2) != b"PK":  # numpy would take it for a pickle
                raise ValueError("it is no .npz file")
        with np.load(path, allow_pickle=False) as stored:
            wanted = stored.files if names is None else [n for n in names if n in stored]
            return {name: stored[name] for name in wanted}
    except DAMAGED as error:
        why = " ".join(str(error).split()) or type(error).__name__
        raise InvalidInput(f"{what} cannot be read: {why[:200]}") from None


@contextmanager
def aside(path: Path) -> Iterator[Path]:
    """A path beside ``path`` to write to; it becomes ``path`` when the block ends well.

    If the block ends with an exception (a full disk, Ctrl-C) what was written is removed, and an
    earlier ``path`` stays as it was. A process that is killed in the block leaves the file that it
    wrote to; its name is ``.NAME.PID.part`` with the suffix, since writers choose the format by it.
    """
    part = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    try:
        yield part
        with part.open("rb+") as stream:
            os.fsync(stream.fileno())
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
    _sync(path.parent)


def make_parent(path: str | Path, what: str = "path") -> Path:
    """``path``, with its folder made where it is not there.

    Raises:
        InvalidInput: it cannot be made, or is no folder; the message says ``what`` the path is.
    """
    found = Path(path).expanduser()
    try:
        found.parent.mkdir(parents=True, exist_ok=True)
        if not os.access(found.parent, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        if found.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    except OSError as error:
        reason = error.strerror or str(error)
        raise InvalidInput(f"{what} is {str(path)!r}; cannot write there: {reason}") from None
    return found


def is_path(text: str | Path) -> bool:
    """Whether a text is meant as the path of a file, and not as a name: it has a suffix or a /."""
    path = Path(text)
    return isinstance(text, Path) or bool(path.suffix) or len(path.parts) > 1


def write_text(path: Path, text: str) -> None:
    """Write a text file whole."""
    with aside(path) as part:
        part.write_text(text, encoding="utf-8")


def write_bytes(path: Path, content: bytes) -> None:
    """Write a binary file whole."""
    with aside(path) as part:
        part.write_bytes(content)


def _sync(folder: Path) -> None:
    """Bring the renaming to the disk, where folders can be synced."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
