"""The files of the processes that grow one tree, beside its own."""

from __future__ import annotations

from pathlib import Path

import numpy as np


def part_file(target: Path, number: int) -> Path:
    """Where process ``number`` has its tree, of those that become ``target``."""
    return target.with_name(f".{target.stem}.{number}.npz")


def part_seed(seed: int, number: int) -> int:
    """Of process ``number``, where all together have ``seed``: the first has that itself.

    The others' are drawn from the pair, so trees of neighbouring seeds share none of their parts.
    """
    if number == 0:
        return seed
    (drawn,) = np.random.SeedSequence(seed, spawn_key=(number,)).generate_state(1, np.uint64)
    return int(drawn >> np.uint64(1))  # JSON and numpy read it as a signed number, too


def part_files(path: str | Path) -> list[Path]:
    """The files of the processes that grew the tree ``path``, in their order.

    One that was killed before it had anything to write has none.
    """
    target = Path(path)
    names = (each.name.split(".")[-2] for each in target.parent.glob(f".{target.stem}.*.npz"))
    last = max((int(name) for name in names if name.isdigit()), default=-1)
    return [part_file(target, i) for i in range(last + 1)]
