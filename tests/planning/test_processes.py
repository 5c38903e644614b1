"""Several processes grow one tree."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dexctl.exceptions import InvalidInput, SimulationError
from dexctl.planning import Progress, RandomActions, Tree, grow, grow_in_processes
from dexctl.planning.parts import part_files
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
    assert seen
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


def test_growing_stops_where_progress_says_so(cylinder: Scene) -> None:
    tree = grow(
        cylinder, RandomActions(batch=4), nodes=100, seed=0, threads=1, progress=lambda _: True
    )
    assert tree.header.expansions == 4
