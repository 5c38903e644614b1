"""Checkpoints: everything that decides the rest of a run, in one file, never half written.

A checkpoint is written beside the last one under another name, brought to the disk, and then
renamed over it: a run that is killed at any moment leaves the one or the other, whole.

The file holds numbers and texts only (see `learning.training.content`), so that reading one never
runs code out of it. It is, in this order, a line that says what it is and in which format; the
length of the header, eight bytes with the least first; the header, which is JSON; the bytes of the
arrays, in the order in which the header names them; and a digest of all this.
"""

from __future__ import annotations

import hashlib
import os
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from dexctl.exceptions import DexctlError
from dexctl.files import aside
from learning.training.content import decode, encode, make_array

FORMAT = 2
_MAGIC = b"dexctl checkpoint, format "
_FIRST_LINE = _MAGIC + b"%d\n" % FORMAT
_LENGTH = struct.Struct("<Q")
_DIGEST_SIZE = 32
_PIECE = 1 << 22
"""Bytes that are written, or read, and put into the digest at a time."""


class CheckpointError(DexctlError, RuntimeError):
    """A checkpoint cannot be written, read, or continued from."""


def write(path: Path, content: Mapping[str, Any]) -> None:
    """Put ``content`` into the checkpoint ``path``, in place of the one before.

    Args:
        path: of the file.
        content: dicts (whose keys are texts or whole numbers), lists and tuples of None, bools,
            numbers, texts, numpy arrays and torch tensors. Arrays are not copied; they must not
            change meanwhile.

    Raises:
        CheckpointError: it cannot be written (a full disk, for one); the one before is left.
        TypeError: the content has something else in it; the message says where.
    """
    header, arrays = encode(dict(content))
    digest = _new_digest()
    try:
        with aside(path) as part, part.open("wb") as file:
            for data in (_FIRST_LINE, _LENGTH.pack(len(header)), header, *arrays):
                for piece in _pieces(data):
                    digest.update(piece)
                    file.write(piece)
            file.write(digest.digest())
    except OSError as error:
        kept = "the one before is kept" if path.exists() else "there is none before it"
        raise CheckpointError(f"cannot write {path}: {error.strerror or error}; {kept}") from error


def read(path: Path) -> dict[str, Any]:
    """The content of the checkpoint ``path``, in memory of its own; tensors are on the CPU.

    Raises:
        CheckpointError: there is none, it is damaged, or of another version.
    """
    try:
        with path.open("rb") as file:
            return _Reader(file).content()
    except FileNotFoundError:
        raise CheckpointError(f"there is no checkpoint {path}") from None
    except _Unusable as error:
        raise CheckpointError(f"cannot read the checkpoint {path}: {error}") from None
    except OSError as error:
        reason = error.strerror or error
        raise CheckpointError(f"cannot read the checkpoint {path}: {reason}") from error


class _Unusable(Exception):
    """Why a file is not read."""


class _Reader:
    """Reads one file; sizes are compared with its length before memory is asked for."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._digest = _new_digest()
        self._left = os.fstat(file.fileno()).st_size - _DIGEST_SIZE
        """Bytes before the digest that are still to come."""

    def content(self) -> dict[str, Any]:
        first = self._file.read(len(_FIRST_LINE))
        if first != _FIRST_LINE:
            raise _Unusable(_why_not(first + self._file.readline(20)))
        self._digest.update(first)
        self._left -= len(first)
        (length,) = _LENGTH.unpack(self._take(_LENGTH.size).tobytes())
        header = self._take(length).tobytes()
        try:
            sizes: list[int] = []
            decode(header, lambda kind, dtype, shape, size: sizes.append(size))
            if sum(sizes) != self._left:
                raise _Unusable(
                    f"it is damaged: it has {self._left} bytes of arrays; expected {sum(sizes)}"
                )
            content = decode(header, self._array)
        except MemoryError:
            raise _Unusable("there is not enough memory for it") from None
        except ValueError:
            raise _Unusable("it is damaged: its header makes no sense") from None
        if self._file.read(_DIGEST_SIZE + 1) != self._digest.digest():
            raise _Unusable("it is damaged: its checksum is wrong")
        if not isinstance(content, dict):
            raise _Unusable("it is damaged: it is no table of names and values")
        return content

    def _array(self, kind: str, dtype: str, shape: tuple[int, ...], size: int) -> Any:
        return make_array(kind, dtype, shape, self._take(size))

    def _take(self, size: int) -> np.ndarray:
        """The next bytes, ``(size,)``."""
        if size > self._left:
            raise _Unusable(f"it is cut short: {size} more bytes expected, {self._left} there")
        self._left -= size
        data = np.empty(size, np.uint8)
        for piece in _pieces(data):
            if self._file.readinto(piece) != len(piece):  # type: ignore[attr-defined]
                raise _Unusable("it is cut short")
            self._digest.update(piece)
        return data


def _why_not(start: bytes) -> str:
    """What a file is that does not begin as it should."""
    if start.startswith(b"PK"):  # as torch writes them
        return "it is of an earlier version, which this one cannot read; begin anew"
    if _FIRST_LINE.startswith(start):
        return "it is cut short"
    found = start.removeprefix(_MAGIC).partition(b"\n")[0]
    if start.startswith(_MAGIC) and found.isdigit():
        return f"it has format {int(found)}; this version reads format {FORMAT}"
    return "it is no checkpoint"


def _new_digest() -> Any:
    return hashlib.blake2b(digest_size=_DIGEST_SIZE)


def _pieces(data: bytes | np.ndarray) -> Iterator[memoryview]:
    view = data.data if isinstance(data, np.ndarray) else memoryview(data)
    return (view[start : start + _PIECE] for start in range(0, len(view), _PIECE))
