"""Tasks of a Ray cluster grow what processes would have grown."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from time import perf_counter

import numpy as np
import pytest

from dexctl.cluster import ClusterError, connect
from dexctl.exceptions import InvalidInput, SimulationError
from dexctl.planning import Progress, RandomActions, Tree, grow, grow_on_cluster
from dexctl.planning.cluster import Board
from dexctl.planning.parts import part_files, part_seed
from dexctl.sim import SceneConfig


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    pytest.importorskip("ray", reason="the extra 'distributed' is not installed")
    from ray.cluster_utils import Cluster

    for attempt in range(3):  # on a busy machine Ray's own processes may be too slow for Ray
        try:
            cluster = Cluster(
                initialize_head=True, head_node_args={"num_cpus": 2, "include_dashboard": False}
            )
            break
        except Exception:
            if attempt == 2:
                raise
    yield str(cluster.address)
    cluster.shutdown()


@pytest.mark.slow
def test_tasks_grow_what_each_would_have_grown_and_are_resumed(
    address: str, tmp_path: Path
) -> None:
    config, path = SceneConfig(object=("cylinder",)), tmp_path / "tree.npz"
    expansion, seen = RandomActions(batch=4), list[Progress]()
    first = grow_on_cluster(
        config, expansion, address, 2, path=path, nodes=8, seed=5, progress=seen.append
    )
    (scene,) = config.scenes()
    seeds = [part_seed(5, i) for i in range(2)]
    alone = [grow(scene, expansion, nodes=5, seed=seed, threads=1) for seed in seeds]
    np.testing.assert_array_equal(first.rotation, Tree.merge(alone).rotation)
    assert seen and len(Tree.load(path)) == len(first)
    assert [part.name for part in part_files(path)] == [".tree.0.npz", ".tree.1.npz"]
    more = grow_on_cluster(config, expansion, address, path=path, nodes=16, seed=5, resume=True)
    whole = [grow(scene, expansion, nodes=9, seed=seed, threads=1) for seed in seeds]
    np.testing.assert_array_equal(more.rotation, Tree.merge(whole).rotation)
    with pytest.raises(InvalidInput, match="the tree is of the gravity"):
        grow_on_cluster(
            SceneConfig(object=("cylinder",), gravity="down"), expansion, address, 2,
            path=path, nodes=20, resume=True,
        )  # fmt: skip
    with pytest.raises(SimulationError, match="2 of 2 tasks ended without a tree: grow is told"):
        grow_on_cluster(config, expansion, address, 2, path=tmp_path / "none.npz")


def test_no_cluster(tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="the extra 'distributed' is not installed")
    begun = perf_counter()
    for wrong, why in (
        ("127.0.0.1:1", "refused; expected its head's"),
        ("ray://127.0.0.1:1", "refused; expected its head's"),
        ("127.0.0.1:x", "expected HOST:PORT"),
        ("a..b:1", "expected its head's"),
    ):
        with pytest.raises(ClusterError, match=f"no Ray cluster at {wrong}: .*{why}") as error:
            connect(wrong)
        assert "\n" not in str(error.value)
    assert perf_counter() - begun < 30  # Ray tried for minutes
    with pytest.raises(ClusterError, match="no Ray cluster at nonsense"):
        grow_on_cluster(SceneConfig(), RandomActions(), "nonsense", path=tmp_path / "tree.npz")


def test_the_board_hands_each_tree_on_once() -> None:
    board, now = Board(2), Progress(3, 4, 0.5, 1.0, {"bounds": 2}, 6, 1)
    assert not board.tell(1, now, b"tree")
    shown, files = board.look()
    assert shown == [None, now] and files == {1: b"tree"}
    assert not board.look()[1]
    board.stop()
    assert board.tell(0, None, None)
