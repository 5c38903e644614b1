"""Growing in simulation: nodes hold, resuming goes on as it would have, lazy is literal."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dexctl.exceptions import InvalidInput
from dexctl.planning import (
    Bounds,
    ControllerMacros,
    Expansion,
    FollowedEdges,
    GoalOrientations,
    GraspSampling,
    Kinematic,
    Metric,
    Nodes,
    Progress,
    RandomActions,
    Stability,
    Tree,
    grow,
    holding,
    sample_grasps,
)
from dexctl.planning.expansion import Problem
from dexctl.planning.nodes import put
from dexctl.planning.simulated import Driven, SimulatedExpander
from dexctl.settings import to_plain
from dexctl.sim import BatchSimulator, Scene, SceneConfig, rotation_about
from dexctl.sim.sensing import Sensing

NOISY = Sensing(joint_noise=0.01)  # as the scene of a policy may have


def same(a: Tree, b: Tree) -> None:
    assert len(a) == len(b)
    for name in ("rotation", "parent", "action", "expansion"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
    np.testing.assert_array_equal(a.nodes.q, b.nodes.q)


def test_nodes_hold_for_two_seconds(cylinder: Scene, small: Tree) -> None:
    assert len(small) >= 20 and small.rotation.max() > 0.1
    nodes, strict = small.nodes, Stability(seconds=2.0)
    with BatchSimulator(cylinder, len(small), disturbance=0.0, threads=1) as sim:
        put(sim, nodes)
        found = strict.check(sim)
    assert found.stable.mean() > 0.9
    assert (nodes.in_contact.sum(axis=1) >= 3).all()
    assert Bounds().hold(small.frame, nodes).all()
    header = small.header
    tried = header.expansions * RandomActions().actions
    assert len(small) - 1 + sum(header.refused.values()) <= tried
    assert header.physics_steps > 0 and header.seconds > 0


def test_rotation_is_that_of_the_pose_and_cost_adds_up(small: Tree) -> None:
    nodes = small.nodes
    for node in (len(small) - 1, int(small.rotation.argmax())):
        along = small.path_to(node)
        np.testing.assert_allclose(
            nodes.rotation[along], rotation_about(nodes.object_quaternion[along]), atol=1e-9
        )
    parent = small.parent[1:]
    np.testing.assert_allclose(nodes.cost[1:], nodes.cost[parent] + 0.1)
    np.testing.assert_allclose(small.action[1:].std(), 0.15, atol=0.03)


def test_a_resumed_tree_goes_on_as_it_would_have(
    cylinder: Scene, small: Tree, tmp_path: Path
) -> None:
    path = tmp_path / "tree.npz"
    half = grow(cylinder, RandomActions(batch=8), nodes=8, seed=1, threads=1, path=path)
    assert len(half) < len(small)
    again = grow(
        cylinder, RandomActions(batch=8), nodes=20, seed=99, threads=1, tree=Tree.load(path)
    )
    same(again, small)
    assert again.header.refused == small.header.refused


def test_lazy_and_literal_find_the_same_nodes(cylinder: Scene) -> None:
    lazy = RandomActions(batch=6, actions=3)
    stability = Stability(seconds=0.3)
    trees = [
        grow(cylinder, expansion, nodes=6, seed=4, threads=1, stability=stability)
        for expansion in (lazy, replace(lazy, lazy=False))
    ]
    same(*trees)
    assert trees[0].header.physics_steps < trees[1].header.physics_steps


class _GivenUp:
    """Nothing is done: three candidates are given up, one is carried away too, one breaks down."""

    action_names = ("nothing",)

    def __call__(self, sim: BatchSimulator, nodes: Nodes, rng: np.random.Generator) -> Driven:
        position, broken = nodes.object_position.copy(), np.arange(len(nodes)) == 5
        position[0, 2] += 2 * Bounds().displacement
        put(sim, replace(nodes, object_position=position))
        put(sim, replace(nodes, object_velocity=np.full((len(nodes), 6), 1e30)), broken)
        sim.step(broken)
        lost = np.arange(len(nodes)) < 4
        return Driven(np.zeros((len(nodes), 1)), np.zeros(len(nodes)), lost, 0)


def test_candidates_that_are_given_up_are_not_out_of_bounds(cylinder: Scene, small: Tree) -> None:
    root = small.nodes.take([0])
    problem = Problem(scene=cylinder, root=root, frame=small.frame, threads=1)
    expander = SimulatedExpander(problem, _GivenUp(), batch=8, candidates=1, lazy=True)
    nodes, rng = small.nodes.take(np.zeros(8, int)), np.random.default_rng(0)
    found = expander(nodes, problem.metric.of(problem.frame, nodes), rng)
    expander.close()
    assert {why: n for why, n in found.refused.items() if n} == {"bounds": 1, "lost": 4}
    assert found.source.tolist() == [4, 6, 7]


def test_macros_turn_the_object_further(cylinder: Scene) -> None:
    macros = ControllerMacros(batch=8)
    seen: list[Progress] = []
    tree = grow(cylinder, macros, nodes=10, seed=0, threads=1, progress=seen.append)
    assert tree.rotation.max() > 0.5
    action = dict(zip(tree.header.action_names, tree.action[1:].T, strict=True))
    assert {-1.0} < set(action["finger"]) <= {-1.0, 0.0, 1.0, 2.0, 3.0, 4.0}
    assert (action["seconds"] >= 0.2 - 1e-9).all()
    np.testing.assert_allclose(
        tree.nodes.cost[1:], tree.nodes.cost[tree.parent[1:]] + action["seconds"]
    )
    assert seen[-1].nodes == len(tree) and seen[-1].expansions == tree.header.expansions
    assert tree.header.settings["expansion"]["macro"]["in_grasp"]["grip_force"] == 2.5


def test_a_tree_that_is_interrupted_is_whole(cylinder: Scene, tmp_path: Path) -> None:
    path = tmp_path / "tree.npz"

    def stop(progress: Progress) -> None:
        if progress.nodes > 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        grow(cylinder, RandomActions(batch=8), nodes=100, seed=1, path=path, progress=stop)
    assert len(Tree.load(path)) > 1


def test_the_root_is_written_before_anything_else(cylinder: Scene, tmp_path: Path) -> None:
    path = tmp_path / "made" / "tree.npz"

    class Killed(RandomActions):
        def open(self, problem):
            made = super().open(problem)

            class Stops:
                batch, action_names, close = made.batch, made.action_names, made.close

                def __call__(self, *_):
                    assert len(Tree.load(path)) == 1
                    raise KeyboardInterrupt

            return Stops()

    with pytest.raises(KeyboardInterrupt):
        grow(cylinder, Killed(batch=2), nodes=5, path=path, threads=1)
    assert len(Tree.load(path)) == 1
    (tmp_path / "file").touch()
    for wrong in (tmp_path / "file" / "tree.npz", tmp_path):
        with pytest.raises(InvalidInput, match="path is .*; cannot write there"):
            grow(cylinder, Killed(), nodes=5, path=wrong)


def test_the_physics_is_stepped_as_the_scene_says(cylinder: Scene, tmp_path: Path) -> None:
    config = SceneConfig(object=("cylinder",), control_period=0.02, substeps=5, sensing=NOISY)
    path = tmp_path / "tree.npz"
    options: dict[str, Any] = {"seed": 1, "threads": 1, "path": path}
    tree = grow(cylinder, RandomActions(batch=2), nodes=2, scene_config=config, **options)
    assert tree.header.physics_steps % 5 == 0 and tree.header.physics_steps % 10
    more = grow(cylinder, RandomActions(batch=2), nodes=4, tree=Tree.load(path), **options)
    other = grow(cylinder, RandomActions(batch=2), nodes=4, scene_config=config, **options)
    same(more, other)
    macros = ControllerMacros(batch=2)
    tree = grow(cylinder, macros, nodes=2, scene_config=config, **options)
    seconds = tree.action[1:, tree.header.action_names.index("seconds")]
    np.testing.assert_allclose(seconds / 0.02, np.round(seconds / 0.02), atol=1e-6)
    seen = []

    class Looked(BatchSimulator):
        def __init__(self, *arguments, **keywords):
            super().__init__(*arguments, **keywords)
            if self.num_envs != 1:  # the root's is looked at only
                seen.append((self.control_period, self.substeps))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("dexctl.sim.BatchSimulator", Looked)
        holding(cylinder, tree, threads=1, batch=2)
        sampling = GraspSampling(batch=16)
        sample_grasps(cylinder, 1, sampling, scene_config=config, threads=1)
    assert seen == [(0.02, 5)] * 2


def test_a_tree_goes_on_and_merges_with_the_same_settings_only(
    cylinder: Scene, small: Tree, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for changes, why in (
        ({"expansion": RandomActions(batch=2)}, r"expansion\.batch 8, not 2"),
        ({"expansion": ControllerMacros()}, "of the expansion 'RandomActions'; expected 'Contr"),
        ({"metric": Metric(tilt=2.0)}, r"metric\.tilt 1\.0, not 2\.0"),
        ({"bounds": Bounds(tilt=0.6)}, r"bounds\.tilt 0\.4, not 0\.6"),
        ({"stability": Stability(seconds=1.0)}, r"stability\.seconds 0\.5, not 1\.0"),
        (
            {"goals": GoalOrientations(orientations=((1, 0, 0, 0),))},
            r"goals\.orientations \(\), not",
        ),
    ):
        settings: dict[str, Any] = {"expansion": RandomActions(batch=8), **changes}
        with pytest.raises(InvalidInput, match=why):
            grow(cylinder, nodes=99, tree=small, threads=1, **settings)
    # a setting that there was not yet has its default, and files are what they were
    header, config = replace(small.header), SceneConfig(object=("cylinder",))
    header.settings = {**header.settings, "metric": {}}
    edges = FollowedEdges(tree=tmp_path / "a" / "tree.npz")
    header.settings["edges"] = to_plain(edges)
    (tmp_path / "a").mkdir()
    monkeypatch.chdir(tmp_path / "a")
    header.check_settings({"metric": Metric(), "edges": FollowedEdges(tree=Path("tree.npz"))})
    # physics that both know
    one, other = Tree(header, small.nodes.take([0])), Tree(small.header, small.nodes.take([0]))
    one.header.scene = to_plain(config)
    assert len(Tree.merge([one, other])) == 1
    other.header = replace(header, scene=to_plain(replace(config, object_friction=0.5)))
    with pytest.raises(InvalidInput, match="the tree is of the object_friction 0.5; expected None"):
        Tree.merge([one, other])
    with pytest.raises(InvalidInput, match="the tree is of the object_friction 0.5; expected None"):
        grow(cylinder, RandomActions(batch=8), nodes=99, tree=other, scene_config=config)


def test_what_grow_refuses(cylinder: Scene, small: Tree, tmp_path: Path) -> None:
    class Never(Expansion):
        def open(self, problem):
            raise AssertionError("no expansion is to be opened")

    wrong: dict[str, Any]
    for wrong, why in (
        ({}, "grow is told no end"),
        ({"nodes": 0}, "nodes is 0; expected a number above 0"),
        ({"until_rotation": 9.0}, "until_rotation is 9; targets go up to 7 rad"),
        ({"nodes": 5, "axis": (0, 0, 0)}, "axis"),
        ({"nodes": "many"}, "nodes is 'many'; expected a number above 0"),
        ({"nodes": 5, "seed": "a"}, "seed is 'a'; expected a whole number"),
        ({"nodes": 5, "seed": -1}, "seed is -1; expected a whole number from 0 on"),
        ({"goals": [(1, 0, 0, 0)]}, r"goals is \[.*; expected of class GoalOrientations"),
        ({"nodes": 5, "metric": 3}, "metric is 3; expected of class Metric"),
    ):
        with pytest.raises(InvalidInput, match=why):
            grow(cylinder, Never(), **wrong)
    named: Any = "kinematic"
    with pytest.raises(InvalidInput, match="expansion is 'kinematic'; expected of class Expansion"):
        grow(cylinder, named, nodes=5)
    down = Scene.build("dex5", "cylinder", "down")
    path, header = tmp_path / "tree.npz", small.header.to_plain()
    path.write_bytes(b"another tree")
    with pytest.raises(InvalidInput, match="the tree is of the gravity"):
        grow(down, RandomActions(batch=2), nodes=30, tree=small, threads=1, path=path)
    # a tree that is not gone on with neither is written nor becomes another one
    assert path.read_bytes() == b"another tree" and small.header.to_plain() == header
    pair: Any = 3
    one: Any = (0,)
    for make, why in (
        (lambda: RandomActions(actions=0), "actions is 0"),
        (lambda: RandomActions(scale=-1), "scale is -1"),
        (lambda: ControllerMacros(still=0.8, guided=0.4), "add up to 1"),
        (lambda: ControllerMacros(seconds=(1.0, 9.0)), "seconds is"),
        (lambda: ControllerMacros(speed=(1.0, 0.0)), "speed is"),
        (lambda: ControllerMacros(speed=pair), r"speed is 3; expected \(least, greatest\)"),
        (lambda: Bounds(rotation=pair), r"rotation is 3; expected \(least <= 0, greatest > 0\)"),
        (lambda: Bounds(rotation=one), r"rotation is \(0,\); expected \(least"),
        (lambda: Bounds(rotation=(1.0, 2.0)), r"rotation is \(1\.0, 2\.0\); expected"),
    ):
        with pytest.raises(InvalidInput, match=why):
            make()


def test_nodes_that_are_to_hold_are_the_trees(cylinder: Scene, small: Tree) -> None:
    count = len(small)
    wrong: Any
    for wrong in ([count], [0.5], np.ones(count + 1, bool), [-count - 1], "a"):
        with pytest.raises(InvalidInput, match="index is .*; expected numbers of nodes, 0 to"):
            holding(cylinder, small, wrong)
    mask = np.arange(count) < 2
    np.testing.assert_array_equal(
        holding(cylinder, small, mask, threads=1, batch=2),
        holding(cylinder, small, [0, 1], threads=1, batch=2),
    )


def test_nodes_are_rows(small: Tree) -> None:
    nodes = small.nodes
    again = Nodes.concatenate([nodes.take([0]), nodes.take(np.arange(1, len(nodes)))])
    np.testing.assert_array_equal(again.q, nodes.q)
    with pytest.raises(ValueError, match="read-only"):
        small.rotation[0] = 1.0


def test_the_hand_of_a_tree_is_found_from_another_folder(
    cylinder: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cylinder.hand.config.write(tmp_path / "mine.toml")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path)
    config = SceneConfig(hand="mine.toml", object=("cylinder",))
    scene = Scene.build("mine.toml", "cylinder")
    grow(scene, Kinematic(), nodes=3, seed=1, path="tree.npz", scene_config=config)
    monkeypatch.chdir(tmp_path / "elsewhere")
    hand = Tree.load(tmp_path / "tree.npz").header.build_scene().hand
    assert hand.config.source == tmp_path.resolve() / "mine.toml"
