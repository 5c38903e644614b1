"""FollowedEdges: edges of a kinematic tree that controllers have carried out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dexctl.exceptions import InvalidInput
from dexctl.planning import FollowedEdges, Kinematic, PlannedGait, Route, Tree, grow, holding
from dexctl.sim import Scene


@pytest.fixture(scope="module")
def planned(cylinder: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("planned") / "tree.npz"
    grow(cylinder, Kinematic(batch=64), until_rotation=0.8, seed=0, path=path)
    return path


@pytest.fixture(scope="module")
def verified(cylinder: Scene, planned: Path) -> Tree:
    return grow(cylinder, FollowedEdges(tree=planned, batch=4), nodes=12, seed=0, threads=2)


def test_what_is_kept_has_been_carried_out_and_holds(cylinder: Scene, verified: Tree) -> None:
    assert verified.header.physics_steps > 0
    assert holding(cylinder, verified).mean() > 0.9
    assert (verified.nodes.q_target != verified.nodes.q).any(axis=1).all()
    assert verified.rotation.max() > 0.15


def test_fingers_are_where_the_other_tree_has_them(
    cylinder: Scene, planned: Path, verified: Tree
) -> None:
    whole = Route(Tree.load(planned), cylinder.hand, every=True)
    goal = verified.action[1:, verified.header.action_names.index("node")].astype(int)
    nodes = verified.nodes.take(np.arange(1, len(verified)))
    tip = whole.in_object(
        cylinder.hand.fingertip_positions(nodes.q), nodes.object_position, nodes.object_quaternion
    )
    apart = np.linalg.norm(tip - whole.tip[goal], axis=-1)[whole.touch[goal]]
    assert apart.max() < FollowedEdges().within + 0.002
    np.testing.assert_array_equal(nodes.in_contact, whole.touch[goal])


def test_it_can_be_followed_itself(cylinder: Scene, verified: Tree) -> None:
    gait = PlannedGait(cylinder.hand, verified)
    assert (gait.route.following >= 0).any()


def test_edges_of_another_object_are_refused(planned: Path) -> None:
    other = Scene.build("dex5", "cube", "up")
    with pytest.raises(InvalidInput, match="edges are of Tree.*cylinder.*the scene is.*cube"):
        grow(other, FollowedEdges(tree=planned), nodes=3)
    with pytest.raises(InvalidInput, match="direct is 2"):
        FollowedEdges(direct=2.0)


def test_a_route_over_every_node_knows_which_lead_far(cylinder: Scene, planned: Path) -> None:
    tree = Tree.load(planned)
    whole, route = Route(tree, cylinder.hand, every=True), Route(tree, cylinder.hand)
    assert len(whole.node) == len(tree)
    np.testing.assert_array_equal(np.flatnonzero(whole.far), route.node)
    on = route.following >= 0
    np.testing.assert_array_equal(whole.following[route.node[on]], route.node[route.following[on]])
