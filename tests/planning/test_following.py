"""PlannedGait: from grasp to grasp of a tree, closed loop; and the nodes that lead on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dexctl import controllers
from dexctl.cli import main
from dexctl.exceptions import InvalidInput
from dexctl.planning import Kinematic, PlannedGait, Route, Tree, grow
from dexctl.planning.nodes import put
from dexctl.sim import BatchSimulator, Scene, run


@pytest.fixture(scope="module")
def l_shape() -> Scene:
    return Scene.build("dex5", "l_shape", "up")


@pytest.fixture(scope="module")
def part(l_shape: Scene) -> Tree:
    """A quarter of a turn."""
    return grow(l_shape, Kinematic(batch=128), until_rotation=1.6, seed=0)


@pytest.fixture(scope="module")
def whole(cylinder: Scene) -> Tree:
    return grow(cylinder, Kinematic(batch=128), until_rotation=2 * np.pi, seed=0)


def test_the_nodes_of_a_route_lead_to_its_ends(cylinder: Scene, whole: Tree) -> None:
    route = Route(whole, cylinder.hand)
    on = route.following >= 0
    assert route.node[0] == 0 and on[0] and not on.all()
    parent = whole.parent[route.node[route.following[on]]]
    np.testing.assert_array_equal(parent, route.node[on])
    assert (route.rotation[~on] >= 2 * np.pi).all() and (route.rotation[on] < 2 * np.pi).all()


def test_of_equal_ways_the_sooner_one_is_taken(part: Tree, l_shape: Scene) -> None:
    """A root with two children that both have turned far enough, and one that has not."""
    nodes, names = part.nodes.take([0, 1, 2, 3]), part.header.action_names
    nodes = replace(
        nodes, rotation=np.array([0.0, 7.0, 7.0, 3.0]), cost=np.array([0.0, 9.0, 5.0, 1.0])
    )
    tree = Tree(part.header, nodes.take([0]))
    tree.append(nodes.take([1, 2, 3]), [0, 0, 0], np.full((3, len(names)), -1.0), [1, 2, 3])
    route = Route(tree, l_shape.hand)
    assert route.node.tolist() == [0, 1, 2]
    assert route.following.tolist() == [2, -1, -1]


def test_it_turns_an_l_with_fingers_that_let_go(l_shape: Scene, part: Tree) -> None:
    gait = PlannedGait(l_shape.hand, part)
    with BatchSimulator(l_shape, 6, seed=3, threads=2) as sim:
        trace = run(gait, sim, 15.0)
    assert not trace.dropped.any()
    assert trace.final_rotation.min() > 1.2
    assert (np.diff(trace.in_contact.astype(int), axis=0) < 0).any(axis=0).sum(axis=1).min() >= 3


def test_without_tracking_it_sums_the_pose_up(l_shape: Scene, part: Tree) -> None:
    gait = PlannedGait(l_shape.hand, part)
    with BatchSimulator(l_shape, 2, seed=3, threads=1) as sim:
        for _ in range(120):
            state = sim.read()
            seen = replace(state, object_position=None, object_quaternion=None)
            sim.write(state.q_target + gait.act(seen))
            sim.step()
        state = sim.read()
        assert state.object_quaternion is not None
        turned = part.frame.rotation(state.object_quaternion, np.zeros(2))
    assert turned.min() > 0.4


def test_it_begins_wherever_the_grasp_is_on_the_tree(l_shape: Scene, part: Tree) -> None:
    route = Route(part, l_shape.hand)
    chosen = np.flatnonzero(route.following >= 0)[[0, 2, 4, 6]]
    gait = PlannedGait(l_shape.hand, part)
    with BatchSimulator(l_shape, len(chosen), disturbance=0.0, threads=1) as sim:
        put(sim, part.nodes.take(route.node[chosen]))
        gait.act(sim.read())
    expected = route.node[route.following[chosen]]
    np.testing.assert_array_equal(gait.diagnostics["node"], expected)


def test_hands_that_are_reset_amid_a_repair_begin_as_new_ones_do(
    l_shape: Scene, part: Tree
) -> None:
    route = Route(part, l_shape.hand)
    late = np.flatnonzero((route.following >= 0) & (route.rotation > 0.5))[[0, -1]]
    gait = PlannedGait(l_shape.hand, part, misplaced=2e-4)  # fingers are always put down anew
    with BatchSimulator(l_shape, 2, seed=3, threads=1) as sim:
        put(sim, part.nodes.take(route.node[late]))
        for _ in range(5):
            sim.step()
        gait.act(sim.read())
        met = gait.state_dict()["met"]
        assert met["repairs"].all() and met["goal"].all()
        mask = np.array([True, False])
        sim.reset(mask=mask)
        gait.reset(mask=mask)
        new = PlannedGait(l_shape.hand, part, misplaced=2e-4)
        for _ in range(20):
            state = sim.read()
            action, expected = gait.act(state), new.act(state)
            for name in ("node", "finger"):
                assert gait.diagnostics[name][0] == new.diagnostics[name][0], name
            np.testing.assert_array_equal(action[0], expected[0])
            sim.write(state.q_target + action)
            sim.step()


def test_after_a_turn_it_goes_on_from_a_turn_before(cylinder: Scene, whole: Tree) -> None:
    """From the last node but one, past the end, to one near the root; misplaced fingers first."""
    route = Route(whole, cylinder.hand)
    before = int(np.flatnonzero((route.following >= 0) & (route.rotation > 6.0))[-1])
    end = int(route.following[before])
    assert route.following[end] < 0
    gait = PlannedGait(cylinder.hand, whole)
    found = []
    with BatchSimulator(cylinder, 1, disturbance=0.0, threads=1) as sim:
        put(sim, whole.nodes.take(route.node[[before]]))
        for _ in range(100):
            state = sim.read()
            sim.write(state.q_target + gait.act(state))
            sim.step()
            found.append(int(gait.diagnostics["node"][0]))
            if gait.diagnostics["node"][0] != route.node[end]:
                break
    assert found[0] == route.node[end]
    assert whole.rotation[found[-1]] < np.pi
    assert gait.diagnostics["finger"][0] >= 0


def test_it_is_known_by_name(
    l_shape: Scene, part: Tree, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name = f"planned:{tmp_path / 'tree.npz'}"
    with pytest.raises(InvalidInput, match=r"tree.npz' cannot be read"):
        controllers.make(name, l_shape.hand)
    assert main(["rotate", "--controller", name]) == 2  # the file is wrong, not the hand
    assert "cannot be read" in capsys.readouterr().err
    part.save(tmp_path / "tree.npz")
    for made in (
        controllers.make(name, l_shape.hand, control_period=0.02),
        controllers.resolve(name, l_shape.hand, control_period=0.02, axis=(0.0, 0.0, 1.0)),
    ):
        assert isinstance(made, PlannedGait) and made.control_period == 0.02
    assert made.object == "l_shape"
    up, remark = l_shape.gravity, controllers.made_for_another
    assert made.gravity == tuple(up)
    assert remark(name, made, ("l_shape",), up) is None
    assert remark(name, made, ("l_shape", "cube"), up) == (
        f"{name} is made for the object l_shape; this is cube"
    )
    assert remark(name, made, ("l_shape",), -up) == (
        f"{name} is made for gravity (0, 0, -9.81) m/s²; this is (0, 0, 9.81)"
    )
    assert remark("igm", controllers.make("igm", l_shape.hand), ("cube",), -up) is None
    assert controllers.entry(name).title == "planned gait"
    assert controllers.label("planned:a/b.npz") == "planned-a-b.npz"
    with pytest.raises(InvalidInput, match="expected planned:FILE"):
        controllers.make("planned", l_shape.hand)
    with pytest.raises(InvalidInput, match="expected planned:FILE"):
        controllers.make("planned:", l_shape.hand)
    with pytest.raises(InvalidInput, match=r"turns about \(0.0, 0.0, 1.0\); expected"):
        controllers.make(name, l_shape.hand, axis="x")
    assert not controllers.is_named("igm:tree.npz")


def test_what_cannot_be_followed(l_shape: Scene, small: Tree, part: Tree) -> None:
    with pytest.raises(InvalidInput, match="RandomActions name no finger"):
        PlannedGait(l_shape.hand, small)
    with pytest.raises(InvalidInput, match="one node"):
        PlannedGait(l_shape.hand, Tree(part.header, part.nodes.take([0])))
    with pytest.raises(InvalidInput, match="speed is -1"):
        PlannedGait(l_shape.hand, part, speed=-1.0)
    gait = PlannedGait(l_shape.hand, part)
    with BatchSimulator(l_shape, 2, threads=1) as sim:
        gait.act(sim.read())
        saved = gait.state_dict()
        saved["met"]["goal"][0] = 10**6
        with pytest.raises(InvalidInput, match="another tree"):
            gait.load_state_dict(saved)
        gait.reset()
        gait.act(sim.read())
        with pytest.raises(InvalidInput, match="reset for 2 hands and got 1"):
            gait.act(sim.read()[:1])
