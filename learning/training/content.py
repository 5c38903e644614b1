"""What checkpoints hold: nested plain values and arrays, as JSON and bytes.

In the JSON, an array always begins with the kind of what it stands for: ``list``, ``tuple``,
``dict`` (keys and values in turn, where not every key is a text), ``int`` (hexadecimal, beyond 64
bits), ``float`` (its bits, where it is not finite), ``numpy`` and ``torch`` (kind of number, shape;
the bytes are elsewhere, in the order of the JSON). Everything else stands for itself.
"""

from __future__ import annotations

import json
import math
import struct
import sys
from collections.abc import Callable, Mapping
from typing import Any, NoReturn

import numpy as np

DEEPEST = 100
"""How many containers may be in each other; far more than any state has."""

_NUMPY = {np.dtype(code).name: np.dtype(code).itemsize for code in "?bhilqBHILQefdFD"}
_TORCH = {
    "bool": 1, "uint8": 1, "int8": 1, "int16": 2, "int32": 4, "int64": 8,
    "float16": 2, "bfloat16": 2, "float32": 4, "float64": 8,
}  # fmt: skip
_BYTES = {"numpy": _NUMPY, "torch": _TORCH}
"""Bytes of a number, for each kind that an array may be of."""

MakeArray = Callable[[str, str, tuple[int, ...], int], Any]
"""From "numpy" or "torch", the kind of number, the shape and the size [bytes] to the array."""


def encode(content: Any) -> tuple[bytes, list[np.ndarray]]:
    """The JSON of nested content, and the bytes of its arrays, ``(n,)`` uint8 each, as views.

    Raises:
        TypeError: there is something in it that a checkpoint cannot hold; the message says where.
    """
    arrays: list[np.ndarray] = []
    found = _encode(content, "content", 0, arrays)
    return json.dumps(found, allow_nan=False).encode("ascii"), arrays


def decode(text: bytes, make: MakeArray) -> Any:
    """The content of what `encode` wrote; ``make`` is asked for each array, in order.

    Raises:
        ValueError: this is not of `encode`.
    """
    try:
        return _decode(json.loads(text.decode("ascii"), parse_constant=_refuse), 0, make)
    except (TypeError, KeyError, IndexError, OverflowError, RuntimeError, struct.error) as error:
        raise ValueError(str(error)) from error


def make_array(kind: str, dtype: str, shape: tuple[int, ...], data: np.ndarray) -> Any:
    """The array or tensor of bytes ``(n,)`` uint8, which it shares its memory with."""
    if kind == "numpy":
        return data.view(np.dtype(dtype)).reshape(shape)
    import torch

    if not len(data):
        return torch.empty(shape, dtype=getattr(torch, dtype))
    return torch.from_numpy(data).view(getattr(torch, dtype)).reshape(shape)


def _encode(value: Any, where: str, depth: int, arrays: list[np.ndarray]) -> Any:
    if depth > DEEPEST:
        raise TypeError(f"{where[:80]}... is nested too deeply for a checkpoint")
    if value is None or isinstance(value, (bool, str)):
        return value
    if isinstance(value, int):
        return int(value) if value.bit_length() < 64 else ["int", hex(value)]
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else ["float", struct.pack(">d", value).hex()]
    if isinstance(value, (list, tuple)):
        found = [_encode(v, f"{where}[{i}]", depth + 1, arrays) for i, v in enumerate(value)]
        return ["tuple" if isinstance(value, tuple) else "list", *found]
    if isinstance(value, Mapping):
        for key in value:
            if not isinstance(key, (str, int)) or isinstance(key, bool):
                raise TypeError(f"{where} has the key {key!r}; expected texts or whole numbers")
        pairs = [(k, _encode(v, f"{where}[{k!r}]", depth + 1, arrays)) for k, v in value.items()]
        if all(isinstance(key, str) for key, _ in pairs):
            return dict(pairs)
        return ["dict", *(one for k, v in pairs for one in (_encode(k, where, 0, arrays), v))]
    return _encode_array(value, where, arrays)


def _encode_array(value: Any, where: str, arrays: list[np.ndarray]) -> list[Any]:
    """A numpy array or a torch tensor; without torch loaded, nothing is a tensor."""
    what = f"a {type(value).__name__}"
    torch: Any = sys.modules.get("torch")
    if isinstance(value, np.ndarray):
        dtype, what = value.dtype.name, f"an array of {value.dtype}"
        if value.dtype.isnative and dtype in _NUMPY:
            arrays.append(np.ascontiguousarray(value).reshape(-1).view(np.uint8))
            return ["numpy", dtype, list(value.shape)]
    elif torch is not None and isinstance(value, torch.Tensor):
        dtype, what = str(value.dtype).removeprefix("torch."), f"a {value.layout} {value.dtype}"
        if value.layout == torch.strided and dtype in _TORCH:
            flat = value.detach().cpu().contiguous().reshape(-1)
            # the strides of an empty one may be such that torch has no view of it
            arrays.append(flat.view(torch.uint8).numpy() if len(flat) else np.empty(0, np.uint8))
            return ["torch", dtype, list(value.shape)]
    raise TypeError(f"{where} is {what}, which a checkpoint cannot hold")


def _decode(value: Any, depth: int, make: MakeArray) -> Any:
    if depth > DEEPEST:
        _refuse("its depth")
    if isinstance(value, dict):
        return {key: _decode(v, depth + 1, make) for key, v in value.items()}
    if not isinstance(value, list):
        return value
    kind, *parts = value
    if kind == "int":
        return int(parts[0], 16)
    if kind == "float":
        return struct.unpack(">d", bytes.fromhex(parts[0]))[0]
    if kind in ("numpy", "torch"):
        dtype, sizes = parts
        if not all(type(size) is int and size >= 0 for size in sizes):
            _refuse("the shape of an array")
        return make(kind, dtype, tuple(sizes), math.prod(sizes) * _BYTES[kind][dtype])
    found = [_decode(part, depth + 1, make) for part in parts]
    if kind == "list":
        return found
    if kind == "tuple":
        return tuple(found)
    if kind != "dict":
        _refuse(kind)
    return dict(zip(found[::2], found[1::2], strict=True))


def _refuse(what: object) -> NoReturn:
    raise ValueError(f"{what!r} makes no sense")
