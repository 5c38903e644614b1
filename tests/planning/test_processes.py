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
from dexctl.planning.parts import part_files, part_seed
from dexctl.planning.processes import _no_interrupt, _Shown, begin_parts, merge_parts, summed
from dexctl.sim import Scene, SceneConfig


def test_two_processes_grow_what_each_would_have_grown(tmp_path: Path) -> None:
    config, path = SceneConfig(object=("cylinder",)), tmp_path / "tree.npz"
    expansion, seen = RandomActions(batch=4), list[Progress]()
    tree = grow_in_processes(config, expansion, 2, path=path, nodes=8, seed=5, progress=seen.append)
    (scene,) = config.scenes()
    seeds = [part_seed(5, i) for i in range(2)]
    alone = [grow(scene, expansion, nodes=5, seed=seed, threads=1) for seed in seeds]
    assert 8 <= len(tree) == sum(map(len, alone)) - 1 == len(Tree.load(path))
    np.testing.assert_array_equal(tree.rotation, Tree.merge(alone).rotation)
    assert tree.header.seed == 5
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
    seen = list[Progress]()
    tree = grow_in_processes(
        config, expansion, 2, path=path, nodes=16, seed=5, resume=True, progress=seen.append
    )
    assert len(tree) >= 16 > len(first)
    # those of the file are not among what has been grown since, which the rate is of
    assert seen[-1].first == len(kept) and seen[-1].nodes == len(tree)
    again = Tree.load(parts[1])
    np.testing.assert_array_equal(again.nodes.q[: len(kept)], kept.nodes.q)
    whole = [
        grow(config.scenes()[0], expansion, nodes=9, seed=part_seed(5, i), threads=1)
        for i in range(2)
    ]
    np.testing.assert_array_equal(tree.rotation, Tree.merge(whole).rotation)
    other = SceneConfig(object=("cylinder",), gravity="down")
    with pytest.raises(InvalidInput, match="the tree is of the gravity"):
        grow_in_processes(other, expansion, 2, path=path, nodes=20, resume=True)


def test_neighbouring_seeds_have_no_part_in_common() -> None:
    """As seeds that were counted on had: seed 0 with two processes grew the first part of 1."""
    seeds = [part_seed(seed, i) for seed in (*range(20), 2**64) for i in range(8)]
    assert len(set(seeds)) == len(seeds)
    assert seeds[::8] == [*range(20), 2**64] and min(seeds) >= 0
    assert all(seed < 2**63 for i, seed in enumerate(seeds) if i % 8)
    assert part_seed(3, 2) == part_seed(3, 2)


def test_a_merged_tree_never_loses_nodes(small: Tree, tmp_path: Path) -> None:
    path = tmp_path / "tree.npz"
    for part in begin_parts(path, 3, False):
        small.save(part)
    merged, grown = merge_parts(part_files(path), path, 1)
    assert merged is not None and grown == 3
    whole, config = path.read_bytes(), SceneConfig(object=("cylinder",))
    before = [part.read_bytes() for part in part_files(path)]
    with pytest.raises(InvalidInput, match="jobs is 2; .* has the trees of 3 processes, expected"):
        grow_in_processes(config, RandomActions(batch=8), 2, path=path, nodes=9, resume=True)
    assert [part.read_bytes() for part in part_files(path)] == before
    damaged = part_files(path)[1]
    damaged.write_bytes(before[1][:-40])
    with pytest.raises(InvalidInput, match=r"tree\.1\.npz' cannot be read"):
        grow_in_processes(config, RandomActions(batch=8), 3, path=path, nodes=90, resume=True)
    # and where it is damaged while they grow
    tree, grown = merge_parts(part_files(path), path, 1)
    assert tree is not None and grown == 2 and len(tree) < len(merged)
    assert path.read_bytes() == whole
    part_files(path)[0].write_bytes(b"")
    path.unlink()
    other, _ = merge_parts(part_files(path), path, 7)
    assert other is not None and len(Tree.load(path)) == len(small)
    assert other.header.seed == 7
    for part in part_files(path):
        part.unlink()
    with pytest.raises(InvalidInput, match="tree.npz is not of several processes"):
        begin_parts(path, 2, True)


def test_what_goes_wrong_in_a_process_is_said(tmp_path: Path) -> None:
    config = SceneConfig(object=("cylinder",))
    with pytest.raises(SimulationError, match="without a tree: grow is told no end"):
        grow_in_processes(config, RandomActions(), 1, path=tmp_path / "tree.npz")
    with pytest.raises(InvalidInput, match="jobs is 0; expected a whole number of processes"):
        grow_in_processes(config, RandomActions(), 0, path=tmp_path / "tree.npz", nodes=3)
    many: Any = "many"
    with pytest.raises(InvalidInput, match="nodes is 'many'; expected a number above 0"):
        grow_in_processes(config, RandomActions(), 2, path=tmp_path / "tree.npz", nodes=many)
    wrong: dict[str, Any]
    for wrong, why in (
        ({"until_rotations": 3.0}, "no keyword 'until_rotations'; known ones: seconds, until_"),
        ({"threads": 2}, "there is no keyword 'threads'"),
        ({"seed": -1}, "seed is -1; expected a whole number from 0 on"),
        ({"scene_config": SceneConfig(object=("cube", "sphere"))}, "object is cube sphere; exp"),
        ({"scene_config": None}, "scene_config is None; expected of class SceneConfig"),
        ({"expansion": "random"}, "expansion is 'random'; expected of class Expansion"),
    ):
        given: dict[str, Any] = {"scene_config": config, "expansion": RandomActions(), **wrong}
        with pytest.raises(InvalidInput, match=why):
            grow_in_processes(**given, jobs=2, path=tmp_path / "made" / "tree.npz", nodes=3)
    assert not list(tmp_path.iterdir())


def test_what_processes_show_is_summed() -> None:
    shown = _Shown(multiprocessing.get_context("spawn"), 3)
    shown.show(0, Progress(5, 8, 0.5, 1.0, {"bounds": 2, "contacts": 1}, 60, 4))
    shown.show(2, Progress(3, 4, 0.7, 2.0, {"bounds": 3}, 40, 1))
    found = summed(shown.look(), perf_counter())
    assert found._replace(seconds=0.0) == (7, 12, 0.7, 0.0, {"bounds": 5, "contacts": 1}, 100, 4)
    shown.show(0, Progress(6, 9, 0.5, 1.0, {str(why): why for why in range(999)}, 60, 4))
    assert summed(shown.look(), 0.0).refused == {"bounds": 3}
    none = summed([None, None], 0.0)
    assert none.nodes == none.first == 0


def test_growing_stops_where_progress_says_so(cylinder: Scene) -> None:
    tree = grow(
        cylinder, RandomActions(batch=4), nodes=100, seed=0, threads=1, progress=lambda _: True
    )
    assert tree.header.expansions == 4


@pytest.mark.skipif(not hasattr(signal, "pthread_sigmask"), reason="signals cannot be blocked")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_another_thread_does_not_let_ctrl_c_through(number: signal.Signals) -> None:
    """A signal to the process goes to any thread that has not blocked it."""
    over, ended = threading.Event(), list[bool]()

    def interrupted() -> None:
        with _no_interrupt():
            os.kill(os.getpid(), number)
            _ = over.wait(0.05)
            ended.append(True)

    other = threading.Thread(target=over.wait)
    other.start()
    before = signal.signal(number, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            interrupted()
        assert ended and signal.getsignal(number) is signal.default_int_handler
        _ = signal.signal(number, signal.SIG_IGN)
        interrupted()  # as a shell lets what it starts in the background
    finally:
        over.set()
        other.join()
        _ = signal.signal(number, before)
