"""Several processes grow one tree."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import pytest

from dexctl.exceptions import InvalidInput, SimulationError
from dexctl.planning import Progress, RandomActions, Tree, grow, grow_in_processes
from dexctl.planning.parts import part_files
from dexctl.planning.processes import _no_interrupt, _Shown, summed
from dexctl.sim import Scene, SceneConfig


def test_two_processes_grow_what_each_would_have_grown(tmp_path: Path) -> None:
    config, path = SceneConfig(object=("cylinder",)), tmp_path / "tree.npz"
    expansion, seen = RandomActions(batch=4), list[Progress]()
    tree = grow_in_processes(config, expansion, 2, path=path, nodes=8, seed=5, progress=seen.append)
    (scene,) = config.scenes()
    alone = [grow(scene, expansion, nodes=5, seed=5 + i, threads=1) for i in range(2)]
    assert 8 <= len(tree) == sum(map(len, alone)) - 1 == len(Tree.load(path))
    np.testing.assert_array_equal(tree.rotation, Tree.merge(alone).rotation)
    assert tree.header.expansions == sum(one.header.expansions for one in alone)
    assert (np.sort(tree.expansion)[-1]) <= 2 * tree.header.expansions
    # looked at from time to time: the last look may be before the end
    assert seen and seen[-1].expansions
    assert sum(seen[-1].refused.values()) and set(seen[-1].refused) <= set(tree.header.refused)
    assert all(count <= tree.header.refused[why] for why, count in seen[-1].refused.items())
    assert set(tmp_path.iterdir()) == {path, *part_files(path)}


def test_what_was_killed_is_gone_on_with(tmp_path: Path) -> None:
    """The merged tree is missing, and what one process had, as after a kill -9."""
    config, path = SceneConfig(object=("cylinder",)), tmp_path / "tree.npz"
    expansion = RandomActions(batch=4)
    first = grow_in_processes(config, expansion, 2, path=path, nodes=8, seed=5)
    path.unlink()
    parts = part_files(path)
    assert [part.name for part in parts] == [".tree.0.npz", ".tree.1.npz"]
    kept = Tree.load(parts[1])
    with pytest.raises(InvalidInput, match="has the trees of 2 processes, which are not in tree"):
        grow_in_processes(config, expansion, 2, path=path, nodes=8, seed=5)
    parts[0].unlink()
    assert part_files(path) == parts
    with pytest.raises(InvalidInput, match=r"is not there yet: .* of 2 processes; .* --resume"):
        Tree.load(tmp_path)
    tree = grow_in_processes(config, expansion, 2, path=path, nodes=16, seed=5, resume=True)
    assert len(tree) >= 16 > len(first)
    again = Tree.load(parts[1])
    np.testing.assert_array_equal(again.nodes.q[: len(kept)], kept.nodes.q)
    whole = [grow(config.scenes()[0], expansion, nodes=9, seed=5 + i, threads=1) for i in range(2)]
    np.testing.assert_array_equal(tree.rotation, Tree.merge(whole).rotation)
    other = SceneConfig(object=("cylinder",), gravity="down")
    with pytest.raises(InvalidInput, match="the tree is of the gravity"):
        grow_in_processes(other, expansion, 2, path=path, nodes=20, resume=True)


def test_what_goes_wrong_in_a_process_is_said(tmp_path: Path) -> None:
    config = SceneConfig(object=("cylinder",))
    with pytest.raises(SimulationError, match="without a tree: grow is told no end"):
        grow_in_processes(config, RandomActions(), 1, path=tmp_path / "tree.npz")
    with pytest.raises(InvalidInput, match="jobs is 0; expected a whole number of processes"):
        grow_in_processes(config, RandomActions(), 0, path=tmp_path / "tree.npz", nodes=3)
    many: Any = "many"
    with pytest.raises(InvalidInput, match="nodes is 'many'; expected a number above 0"):
        grow_in_processes(config, RandomActions(), 2, path=tmp_path / "tree.npz", nodes=many)
    assert not list(tmp_path.iterdir())


def test_what_processes_show_is_summed() -> None:
    shown = _Shown(multiprocessing.get_context("spawn"), 3)
    shown.show(0, Progress(5, 8, 0.5, 1.0, {"bounds": 2, "contacts": 1}, 60))
    shown.show(2, Progress(3, 4, 0.7, 2.0, {"bounds": 3}, 40))
    found = summed(shown.look(), perf_counter())
    assert found._replace(seconds=0.0) == (8, 12, 0.7, 0.0, {"bounds": 5, "contacts": 1}, 100)
    shown.show(0, Progress(6, 9, 0.5, 1.0, {str(why): why for why in range(999)}, 60))
    assert summed(shown.look(), 0.0).refused == {"bounds": 3}
    assert summed([None], 0.0).nodes == 0


def test_growing_stops_where_progress_says_so(cylinder: Scene) -> None:
    tree = grow(
        cylinder, RandomActions(batch=4), nodes=100, seed=0, threads=1, progress=lambda _: True
    )
    assert tree.header.expansions == 4


@pytest.mark.skipif(not hasattr(signal, "pthread_sigmask"), reason="signals cannot be blocked")
def test_another_thread_does_not_let_ctrl_c_through() -> None:
    """A signal to the process goes to any thread that has not blocked it."""
    over, ended = threading.Event(), list[bool]()

    def interrupted() -> None:
        with _no_interrupt():
            os.kill(os.getpid(), signal.SIGINT)
            _ = over.wait(0.05)
            ended.append(True)

    other = threading.Thread(target=over.wait)
    other.start()
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            interrupted()
        assert ended and signal.getsignal(signal.SIGINT) is signal.default_int_handler
        _ = signal.signal(signal.SIGINT, signal.SIG_IGN)
        interrupted()  # as a shell lets what it starts in the background
    finally:
        over.set()
        other.join()
        _ = signal.signal(signal.SIGINT, before)
