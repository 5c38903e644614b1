"""Trees as arrays: paths by hand, files that are whole, what does not belong together, starts."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.planning import Kinematic, Nodes, Tree, TreeHeader, grow, path_states
from dexctl.planning.starts import other_gravity
from dexctl.settings import to_plain
from dexctl.sim import Scene, SceneConfig
from dexctl.sim.grasp_states import GraspStates


def header(**changes: object) -> TreeHeader:
    values: dict = {
        "hand": "two", "joint_names": ("a", "b"), "object": "cube", "object_width": 0.1,
        "object_mass": 0.1, "gravity": (0.0, 0.0, -9.81), "axis": (0.0, 0.0, 1.0),
        "expansion": "RandomActions", "action_names": ("change_a", "change_b"), "settings": {},
        "versions": {}, "seed": 0,
    }  # fmt: skip
    return TreeHeader(**{**values, **changes})


def changed_header(**changes: object) -> np.ndarray:
    """As it stands in a file."""
    return np.asarray(json.dumps({**header().to_plain(), **changes}))


def nodes(rotation: list[float]) -> Nodes:
    count = len(rotation)
    number = np.arange(count, dtype=float)[:, None]
    return Nodes(
        q=number + np.array([0.0, 0.5]),
        q_target=number + np.array([0.1, 0.6]),
        object_position=np.zeros((count, 3)),
        object_quaternion=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        joint_velocity=np.zeros((count, 2)),
        object_velocity=np.zeros((count, 6)),
        in_contact=np.ones((count, 3), bool),
        rotation=np.array(rotation),
        cost=np.arange(count, dtype=float),
    )


def grown(parent: list[int], rotation: list[float]) -> Tree:
    """A tree with these parents, the root's left out, and rotations, the root's first."""
    every = nodes(rotation)
    tree = Tree(header(), every.take([0]))
    for i, p in enumerate(parent, 1):
        tree.append(every.take([i]), [p], [[0.1 * i, 0.2]], [i])
    return tree


#        0 - 1 - 2 - 3   (3: 0.9 rad)
#             \ 4 - 5    (5: 0.8 rad)
#        0 - 6           (6: 0.1 rad)
def forked() -> Tree:
    return grown([0, 1, 2, 1, 4, 0], [0.0, 0.2, 0.5, 0.9, 0.4, 0.8, 0.1])


def test_paths_end_at_the_furthest_and_share_no_end() -> None:
    whole = [path.tolist() for path in forked().paths(3)]
    assert whole == [[0, 1, 2, 3], [0, 1, 4, 5], [0, 6]]
    # the thesis deletes: 1 is gone with the first path, and 4, 5 are no orphans of it
    cut = [path.tolist() for path in forked().paths(3, whole=False)]
    assert cut == [[0, 1, 2, 3], [4, 5], [0, 6]]
    assert len(forked().paths(100)) == 3  # the nodes run out


def test_paths_to_goals() -> None:
    tree = forked()
    assert [path.tolist() for path in tree.paths(2, 0.45)] == [[0, 1, 2], [0, 1, 4]]
    assert [path[-1] for path in tree.paths(2, [0.1, 0.8])] == [6, 5]
    with pytest.raises(InvalidInput, match=r"goal is 3 rad; the tree reaches 0\.00 to 0\.90"):
        tree.paths(1, 3.0)
    with pytest.raises(InvalidInput, match="n is 0; expected a whole number"):
        tree.paths(0)
    with pytest.raises(InvalidInput, match="node is 7; expected 0 to 6"):
        tree.path_to(7)
    ask: Any = tree
    for call, why in (
        (lambda: ask.paths(2, [0.1, 0.2, 0.3]), r"goal has shape \(3,\); expected a rotation in"),
        (lambda: ask.paths(3, "x"), "goal is not an array of numbers: 'x'; expected a rotation"),
        (lambda: ask.path_to("a"), "node is 'a'; expected 0 to 6"),
        (lambda: ask.states(10**9), "index is 1000000000; expected numbers of nodes, 0 to 6, or"),
        (lambda: ask.states([0.5]), r"index is \[0\.5\]; expected numbers of nodes"),
        (lambda: ask.states([True, False]), "index is .* a mask of shape"),
        (lambda: ask.states(np.zeros(7, bool)), "no nodes are chosen"),
    ):
        with pytest.raises(InvalidInput, match=why):
            call()
    assert len(tree.states(3)) == len(tree.states(np.arange(7) == 2)) == len(tree.states([-1])) == 1
    with pytest.raises(InvalidInput, match="parents are"):
        tree.append(nodes([0.3]), [9], [[0.0, 0.0]], [9])


@given(st.lists(st.floats(0, 1), min_size=1, max_size=60), st.randoms(use_true_random=False))
def test_every_path_is_a_chain_of_parents(rotation: list[float], random) -> None:
    parent = [random.randrange(i) for i in range(1, len(rotation))]
    tree = grown(parent, rotation)
    assert len(tree) == len(rotation)
    seen: set[int] = set()
    for whole in (True, False):
        seen.clear()
        for path in tree.paths(5, whole=whole):
            assert (tree.parent[path[1:]] == path[:-1]).all()
            assert whole or not (set(path[path > 0].tolist()) & seen)
            seen |= set(path.tolist())


def test_a_tree_is_the_same_after_its_file(tmp_path: Path) -> None:
    tree, path = forked(), tmp_path / "tree.npz"
    tree.header.refused = {"bounds": 3}
    tree.save(path)
    again = Tree.load(path)
    assert again.header == tree.header
    for name in ("rotation", "parent", "action", "expansion"):
        np.testing.assert_array_equal(getattr(again, name), getattr(tree, name))
    np.testing.assert_array_equal(again.nodes.q_target, tree.nodes.q_target)
    again.append(nodes([0.0]), [6], [[0.0, 0.0]], [8])
    assert len(again) == 8 and len(tree) == 7
    with np.load(path, allow_pickle=False) as file:  # numpy alone
        assert json.loads(str(file["meta"]))["object"] == "cube"
        assert file["parent"].tolist() == [-1, 0, 1, 2, 1, 4, 0]
    assert list(tmp_path.iterdir()) == [path]


def test_its_file_is_one_of_grasp_states(tmp_path: Path) -> None:
    tree, path = forked(), tmp_path / "tree.npz"
    tree.save(path)
    found, own = GraspStates.load(path), tree.states()
    assert len(found) == 7 and found.hand == "two" and set(found.object) == {"cube"}
    np.testing.assert_array_equal(found.q_target, own.q_target)
    chosen = tree.states(np.concatenate(tree.paths(1)))
    np.testing.assert_array_equal(chosen.q[:, 0], [0, 1, 2, 3])
    with pytest.raises(InvalidInput, match="no nodes are chosen"):
        tree.states([])


def test_files_that_are_no_trees(tmp_path: Path) -> None:
    path = tmp_path / "tree.npz"
    with pytest.raises(InvalidInput, match="cannot be read"):
        Tree.load(path)
    forked().save(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InvalidInput, match=r"tree '.*tree.npz' cannot be read"):
        Tree.load(path)
    path.write_text("hello")  # it was said how to load pickles
    with pytest.raises(
        InvalidInput, match=r"tree '.*tree.npz' cannot be read: it is no \.npz file"
    ):
        Tree.load(path)
    forked().states().save(path)
    with pytest.raises(InvalidInput, match="lacks .*action.*; it is no tree"):
        Tree.load(path)
    for name, value, why in (
        ("parent", np.array([-1, 0, 1, 2, 1, 4, 6]), "do not stand before their children"),
        ("q", np.full((7, 2), np.nan), "q has numbers that are not finite"),
        ("q", np.zeros((7, 3)), r"q has shape \(7, 3\); expected \(7, 2\)"),
        ("meta", np.asarray("{}"), "its format is None; expected 1"),
        ("meta", np.asarray("[" * 100_000), "tree.npz': "),
        ("parent", np.asarray(3), r"q has shape \(7, 2\); expected \(1, 2\)"),
        ("parent", np.array([-1.0, 0, 1, 2, 1, 4, 0]), "parent is of float64; it is no tree"),
        ("in_contact", np.asarray(True), r"in_contact has shape \(\); expected \(7,\)"),
        ("q", np.full((7, 2), "a"), "q is of <U1; it is no tree"),
        ("object_quaternion", np.ones((7, 4)), "object_quaternion has norm 2; expected 1"),
        ("meta", changed_header(scene=[1]), r"scene of its header is \[1\], which it cannot be"),
        ("meta", changed_header(expansions="3"), "expansions of its header is '3', which"),
        ("meta", changed_header(seed=True), "seed of its header is True, which"),
        ("meta", changed_header(axis="z"), "axis of its header is 'z', which"),
        ("meta", changed_header(axis=[0, 0, 0]), r"axis of its header is \[0, 0, 0\], which"),
        ("meta", changed_header(axis=["a", "b", "c"]), r"axis of its header is \['a', 'b', 'c'\]"),
        ("meta", changed_header(gravity=[0, 0]), r"gravity of its header is \[0, 0\], which"),
        ("meta", changed_header(gravity=[0, 0, np.nan]), r"gravity of its header is \[0, 0, nan\]"),
        ("meta", changed_header(joint_names=[1, 2]), r"joint_names of its header is \[1, 2\]"),
        (
            "meta",
            changed_header(action_names=["a", 2]),
            r"action_names of its header is \['a', 2\]",
        ),
        ("meta", changed_header(refused={"a": "b"}), "refused of its header is {'a': 'b'}, which"),
        ("meta", changed_header(object_mass=-1), "object_mass of its header is -1, which"),
        ("meta", changed_header(object="banana"), "unknown object in its header 'banana'; known: "),
    ):
        forked().save(path)
        with np.load(path) as stored:
            values = {key: stored[key] for key in stored.files}
        values[name] = value
        np.savez(path, **values)
        with pytest.raises(InvalidInput, match=why) as caught:
            Tree.load(path)
        assert "\n" not in str(caught.value)


def test_a_tree_that_does_not_fit_its_hand(small: Tree, tmp_path: Path) -> None:
    """A file says neither how many fingers a hand has nor whether there is one of that name."""
    path = tmp_path / "tree.npz"
    scene = to_plain(SceneConfig(object=("cylinder",)))
    for cut, changes, why in (
        (4, {}, "contacts of 4 fingers; expected 5, as the hand 'dex5' has"),
        (5, {"hand": "nohand"}, "unknown hand 'nohand'"),
        (5, {"hand": "nohand", "scene": scene}, "of the hand 'nohand' .* of .*'dex5'"),
        (5, {"object": "sphere", "scene": scene}, "the object 'sphere', the scene in its header"),
        (5, {"joint_names": ["a", *small.header.joint_names[1:]]}, "hand 'dex5' has others"),
    ):
        small.save(path)
        with np.load(path) as stored:
            values = {key: stored[key] for key in stored.files}
        values["in_contact"] = values["in_contact"][:, :cut]
        values["meta"] = np.asarray(json.dumps({**json.loads(str(values["meta"])), **changes}))
        np.savez(path, **values)
        with pytest.raises((InvalidInput, UnknownName), match=why) as caught:
            Tree.load(path).build_scene()
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("load", [Tree.load, GraspStates.load])
def test_any_bit_of_a_files_directory_may_be_wrong(load: Any, tmp_path: Path) -> None:
    """Flags of an encrypted or unknown kind of file among them."""
    path = tmp_path / "tree.npz"
    forked().save(path)
    whole = path.read_bytes()
    for sign in (b"PK\1\2", b"PK\3\4"):
        entry = whole.index(sign)
        for byte in range(entry + 4, entry + 46):
            for bit in range(8):
                cut = bytearray(whole)
                cut[byte] ^= 1 << bit
                path.write_bytes(cut)
                with suppress(InvalidInput):  # or it does not matter
                    load(path)


def test_trees_of_several_processes_become_one() -> None:
    a, b = forked(), grown([0, 1], [0.0, 0.3, 1.2])
    a.header.expansions, b.header.expansions, b.header.refused = 10, 5, {"bounds": 2}
    merged = Tree.merge([a, b])
    assert len(merged) == 9 and merged.header.expansions == 15
    assert merged.header.refused == {"bounds": 2}
    assert merged.path_to(8).tolist() == [0, 7, 8]
    assert merged.rotation[8] == 1.2
    assert a.header.expansions == 10
    only = Tree.merge([Tree(header(), nodes([0.0])), b])
    assert len(only) == 3
    other = Tree(header(object="sphere"), nodes([0.0]))
    with pytest.raises(InvalidInput, match="of the object 'sphere'; expected 'cube'"):
        Tree.merge([a, other])
    with pytest.raises(InvalidInput, match="different roots"):
        Tree.merge([a, Tree(header(), nodes([0.0, 0.0]).take([1]))])
    with pytest.raises(InvalidInput, match="got no trees"):
        Tree.merge([])
    kept, loose = (
        Tree(header(settings={"expansion": {"margin": margin, "step": 0.2}}), nodes([0.0]))
        for margin in (0.006, 0.0)
    )
    assert len(Tree.merge([kept, kept])) == 1
    with pytest.raises(InvalidInput, match=r"settings: expansion\.margin was 0\.006, is 0\.0; exp"):
        Tree.merge([kept, loose])


def test_a_tree_is_a_graph() -> None:
    pytest.importorskip("networkx", reason="the extra 'planning' is not installed")
    graph = forked().to_networkx()
    assert sorted(graph.edges) == [(0, 1), (0, 6), (1, 2), (1, 4), (2, 3), (4, 5)]
    assert graph.nodes[5]["rotation"] == 0.8


def test_paths_are_taken_until_there_are_enough() -> None:
    # q counts the nodes of the tree; 3 and its path come first, then 5 up to where it leaves that
    states = path_states(forked(), 5, weights="equal")
    assert states.q[:, 0].tolist() == [0, 1, 2, 3, 4, 5]
    assert states.parent is not None
    assert states.parent.tolist() == [-1, 0, 1, 2, 1, 4]
    assert states.weight is None
    about = json.loads(states.meta)
    assert (about["goals"], about["weights"], about["tried"]) == ("greatest", "equal", 6)
    assert about["tree"]["object"] == "cube"
    assert len(path_states(forked(), 1)) == 4
    assert len(path_states(forked(), 100)) == 7  # all there are


def test_no_state_is_an_orphan() -> None:
    rng = np.random.default_rng(0)
    parent = [int(rng.integers(i)) for i in range(1, 200)]
    tree = grown(parent, rng.uniform(0, 3, 200).tolist())
    for goals in ("greatest", "even"):
        states = path_states(tree, 60, goals=goals)
        assert states.parent is not None
        numbers = states.q[:, 0].astype(int)
        assert states.parent[0] == -1 and (states.parent[1:] >= 0).all()
        assert numbers[states.parent[1:]].tolist() == tree.parent[numbers[1:]].tolist()


def test_every_rotation_is_as_likely() -> None:
    tree = grown([0] * 9, [0.05, *[0.55] * 6, 1.05, 1.06, 1.07])
    weight = path_states(tree, 10).weight
    assert weight is not None
    numbers = path_states(tree, 10).q[:, 0].astype(int)
    sums = [weight[np.isin(numbers, rows)].sum() for rows in ([0], range(1, 7), range(7, 10))]
    np.testing.assert_allclose(sums, sum(sums) / 3)
    assert weight.mean() == pytest.approx(1.0)


def test_even_goals_are_at_every_rotation() -> None:
    rotation = np.concatenate([[0.0], np.full(300, 2.95), 0.15 + 0.1 * np.arange(28)])
    tree = grown([0] * 328, rotation.tolist())
    turned = tree.rotation[path_states(tree, 30, goals="even", seed=1).q[:, 0].astype(int)]
    assert len(np.unique(np.floor(turned / 0.1))) == 30  # one of each, and the root


def test_states_that_do_not_hold_are_left_out(cylinder: Scene) -> None:
    tree = grow(cylinder, Kinematic(batch=32), nodes=40, seed=0, threads=1)
    good = path_states(tree, 30, scene=cylinder, threads=1)
    loose = tree.nodes
    q_target = loose.q_target.copy()
    q_target[10:] = loose.q[10:]  # no grip
    cut = Tree(tree.header, loose.take([0]))
    rest = np.arange(1, len(tree))
    cut.append(
        replace(loose, q_target=q_target).take(rest),
        tree.parent[1:], tree.action[1:], tree.expansion[1:],
    )  # fmt: skip
    fewer = path_states(cut, 30, scene=cylinder, threads=1)
    assert len(fewer) < len(good) <= 40
    assert json.loads(fewer.meta)["tried"] >= 30
    with pytest.raises(InvalidInput, match=r"the tree is Tree\('dex5', 'cylinder'"):
        path_states(tree, 30, scene=Scene.build("dex5", "cylinder", "down"))


def test_states_of_another_gravity_are_told() -> None:
    up, down = (0.0, 0.0, -9.81), np.array([0.0, 0.0, 9.81])
    tree = forked()
    for states in (tree.states(), path_states(tree, 5)):
        assert other_gravity(states, up) is None
        assert other_gravity(states, down) == (
            "the starts were planned under gravity (0, 0, -9.81) m/s²; this is (0, 0, 9.81)"
        )
    mixed = GraspStates.concatenate([tree.states(), replace(path_states(tree, 5), meta="mine")])
    assert other_gravity(mixed, up) is None and other_gravity(mixed, down) is not None
    for meta in ("", "mine", "[1]", '{"gravity": "up", "parts": {"meta": 1}}', "[" * 100_000):
        assert other_gravity(replace(tree.states(), meta=meta), down) is None


def test_what_is_refused() -> None:
    with pytest.raises(InvalidInput, match="count is 0; expected a whole number above 0"):
        path_states(forked(), 0)
    for seed in (-1, "a", 1.5):
        with pytest.raises(InvalidInput, match="seed is .*; expected a whole number from 0 on"):
            path_states(forked(), 3, seed=seed)  # type: ignore[arg-type]
    with pytest.raises(UnknownName, match="unknown goals 'far'; known: greatest, even"):
        path_states(forked(), 3, goals="far")  # type: ignore[arg-type]
    with pytest.raises(UnknownName, match="unknown weights 'none'; known: rotation, equal"):
        path_states(forked(), 3, weights="none")  # type: ignore[arg-type]
