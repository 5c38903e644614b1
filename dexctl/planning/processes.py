"""Trees grown by several processes of one machine, and merged."""

from __future__ import annotations

import inspect
import json
import multiprocessing
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.context import SpawnContext
from pathlib import Path
from typing import Any

import numpy as np

from dexctl.exceptions import DexctlError, InvalidInput, SimulationError
from dexctl.files import make_parent
from dexctl.planning.arguments import check_ends, check_kinds
from dexctl.planning.bounds import Bounds
from dexctl.planning.expansion import Expansion
from dexctl.planning.goals import GoalOrientations
from dexctl.planning.grow import Progress, grow
from dexctl.planning.parts import part_file, part_files, part_seed
from dexctl.planning.tree import Tree
from dexctl.sim import SceneConfig
from dexctl.validation import check_seed

LOOK = 0.2
"""Between looks at how far the trees are [s]."""
_ROOM = 4096  # for what a process shows of its tree [bytes]
_GIVEN = {
    "scene", "expansion", "nodes", "seed", "threads", "tree", "scene_config", "path", "progress",
}  # fmt: skip
"""Of `grow`, what its processes are not given as they are."""


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
    """As `grow`, by ``jobs`` processes, one thread each, whose seeds are drawn from ``seed``.

    Each grows a tree of its own from the settled grasp; when one has turned far enough all stop,
    and the trees become one. That file is written when all are done, also after Ctrl-C; those of
    the processes stand beside it (`part_files`), and what is killed loses their last block at most.

    Args:
        scene_config: what each builds its scene from; one object.
        expansion, arguments: as `grow`'s.
        jobs: how many processes.
        path: where the merged tree is written.
        nodes: of all trees together.
        seed: of the first process; those of the others are `part_seed`.
        resume: go on with the files of the processes, each with its own seed; one that has none
            begins anew.
        progress: called several times a second with the sums, and the greatest rotation.

    Raises:
        InvalidInput: as `grow`, no such keyword, more than one object, no whole number of
            processes, or there are files of processes already that no tree has been made of, and
            they are not to be gone on with; or those to go on with are damaged, more than
            ``jobs``, or the tree is not made of any.
        SimulationError: a process ended without a tree.
    """
    check_arguments(scene_config, expansion, arguments)
    seed, share, target = check_seed(seed, 0), share_of(nodes, jobs), make_parent(path)
    parts = begin_parts(target, jobs, resume)
    context = multiprocessing.get_context("spawn")
    stop, shown = context.Event(), _Shown(context, jobs)
    errors = context.SimpleQueue()
    workers = [
        context.Process(
            target=_work,
            args=(scene_config, expansion, part, i, stop, shown, errors),
            kwargs={"nodes": share, "seed": part_seed(seed, i), **arguments},
            daemon=True,
        )
        for i, part in enumerate(parts)
    ]
    start = time.perf_counter()
    try:
        with _no_interrupt():
            for worker in workers:
                worker.start()
        while any(worker.is_alive() for worker in workers):
            time.sleep(LOOK)
            if progress is not None:
                progress(summed(shown.look(), start))
    except BaseException:
        stop.set()
        raise
    finally:
        for worker in workers:
            if worker.pid is not None:  # it was started
                worker.join()
        tree, grown = merge_parts(parts, target, seed)
    return what_grew(tree, grown, jobs, "processes", "" if errors.empty() else errors.get())


@contextmanager
def _no_interrupt() -> Iterator[None]:
    """What is started in the block sees no Ctrl-C, nor SIGTERM: this process tells it to stop.

    Here they are held back until the block is over; where signals cannot be blocked they are not.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    # a blocked signal stays blocked in a process that is started, a handler does not; here only
    # a handler holds it back, since any other thread takes what is blocked in this one alone
    held: list[int] = []
    both = signal.SIGINT, signal.SIGTERM
    main = threading.current_thread() is threading.main_thread()
    handlers = {
        each: signal.signal(each, lambda number, _: held.append(number))
        for each in (both if main else ())
    }
    before = signal.pthread_sigmask(signal.SIG_BLOCK, both)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for each, handler in handlers.items():
            # None: it was not set from Python
            signal.signal(each, signal.SIG_DFL if handler is None else handler)
    if held:
        signal.raise_signal(held[0])


def begin_parts(target: Path, jobs: int, resume: bool) -> list[Path]:
    """The files of ``jobs`` trees that are to become ``target``.

    Those that an earlier ``target`` was made of go, but to resume.

    Raises:
        InvalidInput: no whole number above 0, or files that no tree has been made of. To resume:
            more files than ``jobs``, one that is damaged, or a ``target`` that is of none.
    """
    _check_jobs(jobs)
    old = part_files(target)
    if resume:
        _check_parts(target, old, jobs)
    elif old and not target.exists():  # of a run that was killed
        raise InvalidInput(
            f"{target.parent} has the trees of {len(old)} processes, which are not in "
            f"{target.name} yet; expected resume=True, which goes on with them, or another path"
        )
    for part in () if resume else old:
        part.unlink(missing_ok=True)
    return [part_file(target, i) for i in range(jobs)]


def _check_parts(target: Path, parts: Sequence[Path], jobs: int) -> None:
    """Raise InvalidInput where the tree of these would lack what an earlier ``target`` has."""
    if len(parts) > jobs:
        raise InvalidInput(
            f"jobs is {jobs}; {target.parent} has the trees of {len(parts)} processes, expected "
            "as many to go on with them"
        )
    if target.exists() and not parts:
        raise InvalidInput(f"{target} is not of several processes; expected grow(tree=...)")
    for part in parts:
        if part.exists():
            Tree.load(part)


def check_arguments(
    scene_config: SceneConfig, expansion: Expansion, arguments: Mapping[str, Any]
) -> None:
    """Raise InvalidInput for what would end every process with a traceback of its own."""
    check_kinds(
        (SceneConfig, "scene_config", scene_config), (Expansion, "expansion", expansion),
        optional=(),
    )  # fmt: skip
    if len(scene_config.object) != 1:
        raise InvalidInput(f"object is {' '.join(scene_config.object)}; expected one")
    known = [name for name in inspect.signature(grow).parameters if name not in _GIVEN]
    for name in arguments:
        if name not in known:
            raise InvalidInput(f"there is no keyword {name!r}; known ones: {', '.join(known)}")


def _check_jobs(jobs: int) -> None:
    if not isinstance(jobs, (int, np.integer)) or isinstance(jobs, bool) or jobs < 1:
        raise InvalidInput(f"jobs is {jobs!r}; expected a whole number of processes above 0")


def share_of(nodes: int | None, jobs: int) -> int | None:
    """How many nodes each of ``jobs`` trees needs for ``nodes`` together; they share the root.

    Raises:
        InvalidInput: no whole number of trees above 0, or no number of nodes.
    """
    _check_jobs(jobs)
    if nodes is None:
        return None
    check_ends(nodes, None, None, Bounds(), GoalOrientations())
    return 1 - (1 - nodes) // jobs


def grow_part(
    scene_config: SceneConfig,
    expansion: Expansion,
    part: Path,
    watch: Callable[[Progress], object],
    **arguments: Any,
) -> bool:
    """Grow the tree in the file ``part``, or a new one; whether all may stop now."""
    (scene,) = scene_config.scenes()
    tree = grow(
        scene, expansion, scene_config=scene_config, path=part, threads=1, progress=watch,
        tree=Tree.load(part) if part.exists() else None, **arguments,
    )  # fmt: skip
    goals, until = arguments.get("goals"), arguments.get("until_rotation")
    arrived = bool(goals) and (goals.away(tree.nodes.object_quaternion) <= goals.angle).all()
    return bool(arrived or (until is not None and tree.rotation.max() >= until))


def merge_parts(parts: Sequence[Path], target: Path, seed: int) -> tuple[Tree | None, int]:
    """Write the tree of those files that are one to ``target``; it, and of how many it is.

    A ``target`` that has more nodes than what could be read of its files is left as it is.
    """
    trees = dict[int, Tree]()
    for number, part in enumerate(parts):
        with suppress(InvalidInput):
            trees[number] = Tree.load(part)
    if not trees:
        return None, 0
    tree = Tree.merge(list(trees.values()))
    if 0 not in trees:  # whose seed is that of all
        tree.header.seed = seed
    if len(trees) == len(parts) or len(tree) >= _nodes_of(target):
        tree.save(target)
    return tree, len(trees)


def _nodes_of(target: Path) -> int:
    """How many nodes the tree in the file has; 0 where there is none."""
    with suppress(InvalidInput):
        return len(Tree.load(target))
    return 0


def what_grew(tree: Tree | None, grown: int, jobs: int, those: str, why: str) -> Tree:
    """The merged tree, where each of ``jobs`` grew one and nothing went wrong.

    Raises:
        SimulationError: some ended without a tree.
        InvalidInput: ``why``.
    """
    if tree is None or grown < jobs:
        raise SimulationError(
            f"{jobs - grown} of {jobs} {those} ended without a tree{why and f': {why}'}"
        )
    if why:
        raise InvalidInput(why)
    return tree


def _work(
    scene_config: SceneConfig,
    expansion: Expansion,
    part: Path,
    number: int,
    stop: Any,
    shown: _Shown,
    errors: Any,
    **arguments: Any,
) -> None:
    """What a process does: a tree in a file, gone on with where there is one."""
    parent = multiprocessing.parent_process()

    def watch(now: Progress) -> bool:
        shown.show(number, now)
        # who has killed the parent wants an end
        return stop.is_set() or (parent is not None and not parent.is_alive())

    try:
        if not stop.is_set() and grow_part(scene_config, expansion, part, watch, **arguments):
            stop.set()
    except KeyboardInterrupt:
        pass  # the tree is in its file
    except DexctlError as error:
        errors.put(str(error))
        stop.set()


def summed(shown: Iterable[Progress | None], start: float) -> Progress:
    """The progress of all trees, None where there is none yet, since ``start``.

    Nodes are those of the tree that they become: they share the root.
    """
    every = [one for one in shown if one is not None]
    refused = Counter[str]()
    for one in every:
        refused.update(one.refused)
    return Progress(
        nodes=sum(one.nodes - 1 for one in every) + bool(every),
        expansions=sum(one.expansions for one in every),
        rotation=max((one.rotation for one in every), default=0.0),
        seconds=time.perf_counter() - start,
        refused=dict(refused),
        physics_steps=sum(one.physics_steps for one in every),
        first=sum(one.first - 1 for one in every) + bool(every),
    )


class _Shown:
    """What processes show of their trees: a text each, in memory that they share."""

    def __init__(self, context: SpawnContext, jobs: int) -> None:
        self._jobs, self._memory = jobs, context.Array("c", _ROOM * jobs)

    def show(self, number: int, now: Progress) -> None:
        """Process ``number`` is so far."""
        text = json.dumps(now).encode()
        if len(text) >= _ROOM:  # reasons of an expansion that has very many
            text = json.dumps(now._replace(refused={})).encode()
        first = _ROOM * number
        with self._memory.get_lock():
            self._memory[first : first + _ROOM] = text.ljust(_ROOM, b"\0")

    def look(self) -> list[Progress | None]:
        """How far each is; None: it has not begun."""
        with self._memory.get_lock():
            whole = bytes(self._memory[:])
        texts = [whole[i * _ROOM : (i + 1) * _ROOM].rstrip(b"\0") for i in range(self._jobs)]
        return [Progress(*json.loads(text)) if text else None for text in texts]
