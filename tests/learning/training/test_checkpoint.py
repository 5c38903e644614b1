"""Checkpoint files: the same back, whole or not there, and one clear line where they are no use."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import pickle
import signal
import struct
import subprocess
import sys
import time
from collections import OrderedDict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

pytest.importorskip("torch")

import torch

from learning.training import checkpoint
from learning.training.checkpoint import CheckpointError

ROOT = Path(__file__).parents[3]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT)}

NUMPY = st.sampled_from(["?", "u1", "i4", "i8", "u4", "u8", "f2", "f4", "f8", "c16"])
ARRAYS = NUMPY.flatmap(lambda kind: hnp.arrays(kind, hnp.array_shapes(min_dims=0, min_side=0)))
TENSORS = st.sampled_from(["?", "u1", "i8", "f2", "f4", "f8"]).flatmap(
    lambda kind: hnp.arrays(kind, hnp.array_shapes(min_dims=0, min_side=0)).map(torch.from_numpy)
)
PLAIN = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5)
PLAIN |= st.sampled_from([2**63, -(2**64), "\ud800", "list", float("-inf")])
CONTENT = st.recursive(
    PLAIN | ARRAYS | TENSORS,
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.lists(inner, max_size=4).map(tuple)
        | st.dictionaries(st.text(max_size=5), inner, max_size=4)
        | st.dictionaries(st.integers() | st.text(max_size=3), inner, max_size=4)
    ),
    max_leaves=12,
)


def same(a: Any, b: Any) -> bool:
    """Of the same kinds, and to the bit; NaNs are the same where their bits are."""
    if type(a) is not type(b):
        return False
    if isinstance(a, dict):
        return list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    if isinstance(a, (list, tuple)):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, torch.Tensor):
        return a.dtype == b.dtype and same(a.numpy(), b.numpy())
    if isinstance(a, np.ndarray):
        return (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())
    if isinstance(a, float):
        return struct.pack("d", a) == struct.pack("d", b)
    return a == b


@given(st.dictionaries(st.text(max_size=5), CONTENT, max_size=4))
@settings(deadline=None)
def test_there_and_back(content: dict[str, Any]) -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "c.bin"
        checkpoint.write(path, content)
        assert same(checkpoint.read(path), content)
        assert list(Path(folder).iterdir()) == [path]


def test_views_and_what_modules_and_optimisers_have(tmp_path: Path) -> None:
    path, grid = tmp_path / "c.bin", np.arange(12.0).reshape(3, 4)
    layer = torch.nn.Linear(2, 3)
    optimiser = torch.optim.Adam(layer.parameters())
    layer(torch.ones(2)).sum().backward()
    optimiser.step()
    half = torch.tensor([1.5, -2.0], dtype=torch.bfloat16)
    checkpoint.write(path, {"columns": grid[:, ::2], "layer": layer.state_dict(), "half": half,
                            "optimiser": optimiser.state_dict(), "t": layer.weight.T,
                            "large": 7**9000})  # fmt: skip
    found = checkpoint.read(path)
    assert found["columns"].tolist() == [[0, 2], [4, 6], [8, 10]]
    assert found["half"].dtype == torch.bfloat16 and found["half"].tolist() == [1.5, -2.0]
    assert same(OrderedDict(found["layer"]), OrderedDict(layer.state_dict()))
    assert same(found["optimiser"], optimiser.state_dict())
    assert (found["t"] == layer.weight.T).all() and not found["t"].requires_grad
    assert found["large"] == 7**9000  # more digits than Python turns into text
    found["columns"][0, 0] = 7.0  # memory of its own, to go on with
    optimiser.load_state_dict(found["optimiser"])


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ({"a": [0, {"b": np.int64(3)}]}, r"content\['a'\]\[1\]\['b'\] is a int64"),
        ({"a": {1.5: 0}}, r"content\['a'\] has the key 1.5"),
        ({"a": np.array(["x"])}, r"content\['a'\] is an array of "),
        ({"a": np.array([print])}, r"content\['a'\] is an array of object"),
        ({"a": np.zeros(2, ">f4")}, r"content\['a'\] is an array of >f4"),
        ({"a": torch.eye(2).to_sparse()}, r"content\['a'\] is a torch.sparse_coo torch.float32"),
        ({"a": print}, r"content\['a'\] is a builtin_function_or_method"),
    ],
)
def test_what_a_checkpoint_cannot_hold(tmp_path: Path, content: Any, said: str) -> None:
    path = tmp_path / "c.bin"
    checkpoint.write(path, {"a": 1})
    with pytest.raises(TypeError, match=said):
        checkpoint.write(path, content)
    assert checkpoint.read(path) == {"a": 1}


def test_content_that_holds_itself(tmp_path: Path) -> None:
    content: dict[str, Any] = {}
    content["a"] = content
    with pytest.raises(TypeError, match="nested too deeply"):
        checkpoint.write(tmp_path / "c.bin", content)


def refused(path: Path) -> str:
    """What is said of a file that cannot be read."""
    with pytest.raises(CheckpointError) as caught:
        checkpoint.read(path)
    said = str(caught.value)
    assert str(path) in said and "\n" not in said
    return said


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """A checkpoint with a little of everything."""
    path = tmp_path / "c.bin"
    checkpoint.write(path, {"a": torch.arange(6).reshape(2, 3), "b": [1.5, ("x", None)],
                            "c": np.ones(3, bool), "d": {0: 2**70, 1: -np.inf}})  # fmt: skip
    return path


def test_a_flipped_bit_is_seen_wherever_it_is(small: Path) -> None:
    whole = small.read_bytes()
    rng = np.random.default_rng(0)
    places = {*range(40), *rng.integers(0, len(whole), 200).tolist()}
    for place in places:
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(rng.integers(8))
        small.write_bytes(damaged)
        refused(small)


def test_a_file_that_was_cut_short_or_grew(small: Path) -> None:
    whole = small.read_bytes()
    for length in range(len(whole)):
        small.write_bytes(whole[:length])
        refused(small)
    small.write_bytes(whole + b"\0")
    refused(small)


def made_up(header: Any, data: bytes = b"", length: int | None = None) -> bytes:
    """A file with any header, whose checksum is right."""
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    length = len(text) if length is None else length
    whole = b"dexctl checkpoint, format 2\n" + struct.pack("<Q", length) + text + data
    return whole + hashlib.blake2b(whole, digest_size=32).digest()


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (made_up({}, length=800_000_000_000), "cut short: 800000000000 more bytes expected"),
        (made_up({"a": ["numpy", "float64", [10**11]]}), "expected 800000000000"),
        (made_up({"a": ["torch", "float64", [10**11]]}, bytes(8)), "expected 800000000000"),
        (made_up({"a": ["numpy", "float64", [-1]]}, bytes(8)), "makes no sense"),
        (made_up({"a": ["numpy", "object", [1]]}, bytes(8)), "makes no sense"),
        (made_up({"a": ["torch", "load", [1]]}, bytes(8)), "makes no sense"),
        (made_up({"a": ["torch", "float32", [0, 2**70]]}), "makes no sense"),
        (made_up({"a": ["numpy", "float32", [0, 2**70]]}), "makes no sense"),
        (made_up({"a": ["numpy", "float64", [1] * 80]}, bytes(8)), "makes no sense"),
        (made_up({"a": ["numpy"]}), "makes no sense"),
        (made_up({"a": ["dict", [], 1]}), "makes no sense"),
        (made_up({"a": ["dict", 1]}), "makes no sense"),
        (made_up({"a": ["system", "ls"]}), "makes no sense"),
        (made_up({"a": []}), "makes no sense"),
        (made_up(b'{"a": NaN}'), "makes no sense"),
        (made_up(b'{"a": "\xff"}'), "makes no sense"),
        (made_up(b"[" * 100_000), "makes no sense"),
        (made_up(b'["list",' * 200 + b"1" + b"]" * 200), "makes no sense"),
        (made_up(["list"]), "no table of names and values"),
        (b"", "cut short"),
        (b"not a checkpoint", "it is no checkpoint"),
        (b"dexctl checkpoint, format 31\n...", "has format 31; this version reads format 2"),
        (b"dexctl checkpoint, format 1\n...", "has format 1; this version reads format 2"),
    ],
)
def test_files_of_others(tmp_path: Path, content: bytes, said: str) -> None:
    path = tmp_path / "c.bin"
    path.write_bytes(content)
    assert said in refused(path)


class Payload:
    """Makes a file where it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, (f"touch {self.mark}",)


def test_code_in_a_file_is_not_run(tmp_path: Path) -> None:
    path, mark = tmp_path / "c.bin", tmp_path / "mark"
    path.write_bytes(pickle.dumps(Payload(mark)))
    assert "no checkpoint" in refused(path)
    torch.save({"format": 1, "a": Payload(mark)}, path)
    assert "of an earlier version, which this one cannot read; begin anew" in refused(path)
    assert not mark.exists()


def test_none_and_a_folder(tmp_path: Path) -> None:
    assert "there is no checkpoint" in refused(tmp_path / "c.bin")
    assert os.strerror(errno.EISDIR) in refused(tmp_path)
    with pytest.raises(CheckpointError, match="there is none before it"):
        checkpoint.write(tmp_path / "none" / "c.bin", {})


FULL = """
import resource, signal, sys
import numpy as np
from pathlib import Path
from learning.training import checkpoint
path = Path(sys.argv[1])
checkpoint.write(path, {"a": 1})
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
try:
    checkpoint.write(path, {"a": np.zeros(100_000)})
except checkpoint.CheckpointError as error:
    print(error)
assert "torch" not in sys.modules
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="file size limits are of Unix")
def test_full_disk_in_mid_write_keeps_the_one_before(tmp_path: Path) -> None:
    """A limit on the file's size stops the writing as a full disk does."""
    path = tmp_path / "c.bin"
    done = subprocess.run(
        [sys.executable, "-c", FULL, str(path)],
        env=ENVIRONMENT, capture_output=True, text=True, timeout=100, check=True,
    )  # fmt: skip
    (line,) = done.stdout.splitlines()
    assert line.startswith("cannot write")
    assert line.endswith(f"{os.strerror(errno.EFBIG)}; the one before is kept")
    assert checkpoint.read(path) == {"a": 1}
    assert list(tmp_path.iterdir()) == [path]


WRITING = """
import sys
import numpy as np
from pathlib import Path
from learning.training import checkpoint
path, number = Path(sys.argv[1]), 0
while True:
    number += 1
    checkpoint.write(path, {"number": number, "a": np.full(2_000_000, number)})
"""


def test_a_kill_while_writing_leaves_a_whole_one(tmp_path: Path) -> None:
    path = tmp_path / "c.bin"
    parts = lambda: list(tmp_path.glob(".c.*.part.bin"))  # noqa: E731
    for _ in range(3):
        process = subprocess.Popen([sys.executable, "-c", WRITING, str(path)], env=ENVIRONMENT)
        until = time.monotonic() + 60
        while not (path.exists() and parts()) and time.monotonic() < until:
            time.sleep(0.001)
        process.send_signal(signal.SIGKILL)
        process.wait()
        found = checkpoint.read(path)
        assert (found["a"] == found["number"]).all()
