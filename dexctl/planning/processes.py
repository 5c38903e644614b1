"""Trees grown by several processes of one machine, and merged."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from dexctl.exceptions import DexctlError, InvalidInput, SimulationError
from dexctl.planning.expansion import Expansion
from dexctl.planning.grow import Progress, grow
from dexctl.planning.tree import Tree
from dexctl.sim import SceneConfig

_LOOK = 0.2  # between looks at how far the processes are [s]
_SHOWN = 4  # numbers that each shows: nodes, expansions, rotation, physics steps


def grow_in_processes(
    scene_config: SceneConfig,
    expansion: Expansion,
    jobs: int,
    *,
    path: str | Path,
    nodes: int | None = None,
    seed: int = 0,
    resume: bool = False,
    progress: Callable[[Progress], object] | None = None,
    **arguments: Any,
) -> Tree:
    """As `grow`, by ``jobs`` processes with the seeds ``seed + i``, one thread each.

    Each grows a tree of its own from the settled grasp; when one has turned far enough all stop,
    and the trees become one. That file is written when all are done, also after Ctrl-C; those of
    the processes stand beside it (`part_files`), and what is killed loses their last block at most.

    Args:
        scene_config: what each builds its scene from; one object.
        expansion, arguments: as `grow`'s.
        jobs: how many processes.
        path: where the merged tree is written.
        nodes: of all trees together.
        seed: of the first process.
        resume: go on with the files of the processes; one that has none begins anew.
        progress: called several times a second with the sums, and the greatest rotation.

    Raises:
        InvalidInput: as `grow`, or no whole number of processes.
        SimulationError: a process ended without a tree.
    """
    if not isinstance(jobs, (int, np.integer)) or isinstance(jobs, bool) or jobs < 1:
        raise InvalidInput(f"jobs is {jobs!r}; expected a whole number of processes above 0")
    target = Path(path)
    parts = [_part(target, i) for i in range(jobs)]
    for part in () if resume else part_files(target):
        part.unlink(missing_ok=True)
    context = multiprocessing.get_context("spawn")
    stop, shown = context.Event(), context.Array("d", _SHOWN * jobs)
    errors = context.SimpleQueue()
    share = None if nodes is None else -(-nodes // jobs)
    workers = [
        context.Process(
            target=_work,
            args=(scene_config, expansion, part, i, stop, shown, errors),
            kwargs={"nodes": share, "seed": seed + i, **arguments},
            daemon=True,
        )
        for i, part in enumerate(parts)
    ]
    start = time.perf_counter()
    try:
        for worker in workers:
            worker.start()
        while any(worker.is_alive() for worker in workers):
            time.sleep(_LOOK)
            if progress is not None:
                progress(_sum(np.array(shown).reshape(jobs, _SHOWN), start))
    except BaseException:
        stop.set()
        raise
    finally:
        for worker in workers:
            worker.join()
        trees = []
        for part in parts:
            with suppress(InvalidInput):
                trees.append(Tree.load(part))
        if trees:
            tree = Tree.merge(trees)
            tree.save(target)
    why = "" if errors.empty() else errors.get()
    if len(trees) < jobs:
        raise SimulationError(
            f"{jobs - len(trees)} of {jobs} processes ended without a tree{why and f': {why}'}"
        )
    if why:
        raise InvalidInput(why)
    return tree


def part_files(path: str | Path) -> list[Path]:
    """The files of the processes that grew the tree ``path``, in their order.

    One that was killed before it had anything to write has none.
    """
    target = Path(path)
    names = (each.name.split(".")[-2] for each in target.parent.glob(f".{target.stem}.*.npz"))
    last = max((int(name) for name in names if name.isdigit()), default=-1)
    return [_part(target, i) for i in range(last + 1)]


def _part(target: Path, number: int) -> Path:
    return target.with_name(f".{target.stem}.{number}.npz")


def _work(
    scene_config: SceneConfig,
    expansion: Expansion,
    part: Path,
    number: int,
    stop: Any,
    shown: Any,
    errors: Any,
    **arguments: Any,
) -> None:
    """What a process does: a tree in a file, gone on with where there is one."""
    parent = multiprocessing.parent_process()

    def watch(now: Progress) -> bool:
        first = _SHOWN * number
        shown[first : first + _SHOWN] = [now.nodes, now.expansions, now.rotation, now.physics_steps]
        # who has killed the parent wants an end
        return stop.is_set() or (parent is not None and not parent.is_alive())

    try:
        (scene,) = scene_config.scenes()
        tree = grow(
            scene, expansion, scene_config=scene_config, path=part, threads=1, progress=watch,
            tree=Tree.load(part) if part.exists() else None, **arguments,
        )  # fmt: skip
        goals = arguments.get("goals")
        arrived = goals and (goals.away(tree.nodes.object_quaternion) <= goals.angle).all()
        if arrived or tree.rotation.max() >= (arguments.get("until_rotation") or np.inf):
            stop.set()
    except KeyboardInterrupt:
        pass  # the tree is in its file
    except DexctlError as error:
        errors.put(str(error))
        stop.set()


def _sum(shown: np.ndarray, start: float) -> Progress:
    nodes, expansions, _, steps = shown.sum(axis=0).astype(int).tolist()
    rotation = float(shown[:, 2].max())
    return Progress(nodes, expansions, rotation, time.perf_counter() - start, {}, steps)
