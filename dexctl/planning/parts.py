"""The files of the processes that grow one tree, beside its own."""

from __future__ import annotations

from pathlib import Path


def part_file(target: Path, number: int) -> Path:
    """Where process ``number`` has its tree, of those that become ``target``."""
    return target.with_name(f".{target.stem}.{number}.npz")


def part_files(path: str | Path) -> list[Path]:
    """The files of the processes that grew the tree ``path``, in their order.

    One that was killed before it had anything to write has none.
    """
    target = Path(path)
    names = (each.name.split(".")[-2] for each in target.parent.glob(f".{target.stem}.*.npz"))
    last = max((int(name) for name in names if name.isdigit()), default=-1)
    return [part_file(target, i) for i in range(last + 1)]
