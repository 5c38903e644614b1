"""Trees grown as tasks of a Ray cluster, and merged."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

from dexctl.cluster import connect, cores, inside, reason
from dexctl.exceptions import DexctlError
from dexctl.files import aside, make_parent
from dexctl.planning.expansion import Expansion
from dexctl.planning.grow import Progress
from dexctl.planning.parts import part_seed
from dexctl.planning.processes import (
    LOOK,
    begin_parts,
    check_arguments,
    grow_part,
    merge_parts,
    share_of,
    summed,
    what_grew,
)
from dexctl.planning.tree import Tree
from dexctl.settings import absolute
from dexctl.sim import SceneConfig
from dexctl.sim.grasp_states import TREE
from dexctl.validation import check_seed

_TO_STOP = 60.0  # tasks that are told to stop have this long to send what they have [s]


def grow_on_cluster(
    scene_config: SceneConfig,
    expansion: Expansion,
    address: str,
    jobs: int | None = None,
    *,
    path: str | Path,
    nodes: int | None = None,
    seed: int = 0,
    resume: bool = False,
    progress: Callable[[Progress], object] | None = None,
    **arguments: Any,
) -> Tree:
    """As `grow_in_processes`, by tasks of a Ray cluster: the trees are the same.

    Machines need no folder in common, only the code, and the files that the settings name at the
    same paths: tasks send their trees every few seconds, and this process writes and merges them.
    So what is killed here loses some seconds, and `resume` goes on.

    Args:
        address: of the cluster's head, "HOST:PORT", "ray://HOST:PORT" or "auto".
        jobs: how many tasks, one core each; None: as many as the cluster has cores.
        scene_config, expansion, path, nodes, seed, resume, progress, arguments: as there.

    Raises:
        MissingExtra: Ray is not installed.
        ClusterError: no cluster at the address.
        InvalidInput, SimulationError: as `grow_in_processes`.
    """
    check_arguments(scene_config, expansion, arguments)
    seed, target = check_seed(seed, 0), make_parent(path)
    ray = connect(address)
    try:
        jobs = cores(ray) if jobs is None else jobs
        parts = begin_parts(target, jobs, resume)
        board = ray.remote(Board).options(num_cpus=0).remote(jobs)
        task = ray.remote(_work).options(num_cpus=1, max_retries=0, name="dexctl plan")
        here, share = Path.cwd(), share_of(nodes, jobs)
        tasks = [
            task.remote(
                absolute(scene_config, here), absolute(expansion, here), i, board,
                part.read_bytes() if part.exists() else None,
                nodes=share, seed=part_seed(seed, i), **arguments,
            )
            for i, part in enumerate(parts)
        ]  # fmt: skip
        start, left = perf_counter(), tasks
        try:
            while left:
                _, left = ray.wait(left, num_returns=len(left), timeout=LOOK)
                shown, files = ray.get(board.look.remote())
                _write(files, parts)
                if progress is not None:
                    progress(summed(shown, start))
        except BaseException:
            ray.get(board.stop.remote())
            raise
        finally:
            ray.wait(tasks, num_returns=len(tasks), timeout=_TO_STOP)
            _write(ray.get(board.look.remote())[1], parts)
            tree, grown = merge_parts(parts, target, seed)
        return what_grew(tree, grown, jobs, "tasks", next(filter(None, _said(ray, tasks)), ""))
    finally:
        ray.shutdown()


class Board:
    """Where tasks tell how far they are and leave their trees: an actor of the cluster."""

    def __init__(self, jobs: int) -> None:
        self._shown: list[Progress | None] = [None] * jobs
        self._files: dict[int, bytes] = {}
        self._stop = False

    def tell(self, number: int, shown: Progress | None, file: bytes | None) -> bool:
        """What task ``number`` has; whether it is to stop."""
        self._shown[number] = shown
        if file is not None:
            self._files[number] = file
        return self._stop

    def stop(self) -> None:
        """Every task is to stop."""
        self._stop = True

    def look(self) -> tuple[list[Progress | None], Mapping[int, bytes]]:
        """How far all tasks are, and the trees that have come since the last look."""
        files, self._files = self._files, {}
        return self._shown, files


def _work(
    scene_config: SceneConfig,
    expansion: Expansion,
    number: int,
    board: Any,
    file: bytes | None,
    **arguments: Any,
) -> str:
    """What a task does: a tree, told to the board; what went wrong, "" for nothing."""
    ray = inside()
    with TemporaryDirectory() as folder:
        part = Path(folder) / TREE
        if file is not None:
            part.write_bytes(file)
        shown: Progress | None = None
        told, sent, stopped = 0.0, 0, False

        def tell() -> None:
            nonlocal told, sent, stopped
            written = part.stat().st_mtime_ns if part.exists() else 0
            new = part.read_bytes() if written > sent else None
            stopped = ray.get(board.tell.remote(number, shown, new))
            told, sent = perf_counter(), max(sent, written)

        def watch(now: Progress) -> bool:
            nonlocal shown
            shown = now
            if perf_counter() - told > LOOK:
                tell()
            return stopped

        try:
            if grow_part(scene_config, expansion, part, watch, **arguments):
                ray.get(board.stop.remote())
        except DexctlError as error:
            ray.get(board.stop.remote())
            return str(error)
        finally:
            tell()
    return ""


def _write(files: Mapping[int, bytes], parts: Sequence[Path]) -> None:
    for number, content in files.items():
        with aside(parts[number]) as file:
            file.write_bytes(content)


def _said(ray: Any, tasks: Sequence[Any]) -> list[str]:
    """What went wrong in each task."""
    found = []
    for task in tasks:
        try:
            found.append(ray.get(task, timeout=0))
        except ray.exceptions.RayError as error:
            found.append(reason(error))
    return found
