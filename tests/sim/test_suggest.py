"""Suggested grasps, the search for them, and what is said where an object is not held."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from dexctl import HandModel
from dexctl.exceptions import InvalidInput, SimulationError, UnknownName
from dexctl.grasp import epsilon_quality, is_force_closure
from dexctl.hand_config import PostureConfig
from dexctl.sim import Scene
from dexctl.sim.grasp_score import ranked, scores
from dexctl.sim.grasp_search import Contacts, GraspSearch, Placement
from dexctl.sim.hand_balls import HandBalls
from dexctl.sim.settle_failure import SettleFailure
from dexctl.sim.shapes import Shape
from dexctl.sim.workspace import BAND, CLEAR, Workspace

TIPS = {
    "ff_tip": (0, 0, 0.0267), "mf_tip": (0, 0, 0.0267),
    "rf_tip": (0, 0, 0.0267), "th_tip": (0, 0, 0.0423),
}  # fmt: skip


BAR = '<geom type="capsule" fromto="0 0 0 0.04 0 0" size="0.008"/>'
RANGE = '<joint range="-10 90" damping="0.01" armature="0.001"/>'


@pytest.fixture(scope="module")
def bare(four_fingers: HandModel) -> HandModel:
    """Four fingers of whom nothing is known but the file and the fingertips."""
    return HandModel.from_mjcf(four_fingers.path, TIPS)


def search_of(hand: HandModel, name: str = "cube", **changes: object) -> GraspSearch:
    scene = Scene.build(hand, name, object_size=1.0, grasp_centre=(0, 0, 10))
    limits = scene.lower, scene.upper
    given = {
        "workspace": Workspace(scene.model, hand, *limits, scene.open_q, count=400),
        "shape": Shape.of_body(scene.model), "size": None, "centre": None, "base": scene.open_q,
        "torque": hand.effort, "stiffness": scene.stiffness, "grip": 2.0,
    }  # fmt: skip
    return GraspSearch(**{**given, **changes})


def test_what_a_search_finds_touches_and_keeps_clear(bare: HandModel) -> None:
    search = search_of(bare)
    best = ranked(search, placements=60, keep=12)
    assert best is not None
    found, space = best.contacts, search.workspace
    assert len(found) >= 3
    totals = [score.total for score in best.score]
    assert totals == sorted(totals, reverse=True)
    assert ((space.lower <= found.q) & (found.q <= space.upper)).all()
    balls = space.balls
    for i, place in enumerate(found.placement):
        shape = search.shape.scaled(place.size)
        centres = (balls.centres(found.q[i : i + 1])[0] - place.centre) @ place.turn
        gap = shape.bound(centres) - balls.radius
        for finger in range(4):
            own = balls.finger == finger
            if found.active[i, finger]:
                assert abs(gap[own & balls.tip].min()) < BAND
                assert gap[own & ~balls.tip].min() > CLEAR
        assert gap[balls.finger == -1].min() > CLEAR
        on = found.active[i]
        local = (found.position[i, on] - place.centre) @ place.turn
        np.testing.assert_allclose(shape.distance(local), 0.0, atol=1e-9)
        outward = shape.normal(local) @ place.turn.T
        np.testing.assert_allclose(outward, -found.normal[i, on], atol=1e-6)
        lever = found.position[i, on] - place.centre
        assert (np.einsum("ij,ij->i", found.normal[i, on], lever) < 0).all()  # into the object
    closed = is_force_closure(found.position, found.normal, found.active, found.centre, 1.0)
    has_margin = np.array([score.margin > 0 for score in best.score])
    assert closed[has_margin].all() and has_margin.any()


def test_the_same_seed_finds_the_same(bare: HandModel) -> None:
    first, second = (search_of(bare, seed=3).run(30, 5) for _ in range(2))
    assert first is not None and second is not None
    np.testing.assert_array_equal(first.q, second.q)


@pytest.mark.parametrize(("link", "swing"), [(0.09, 0.2), (0.06, 0.0)])
def test_reach_is_that_of_the_joint_limits(tmp_path: Path, link: float, swing: float) -> None:
    """One hinge under each of three fingers: the turn of the object is the turn of the hinges.

    The link that turns with the finger is ``link`` from the object's centre; nearer, it touches.
    """
    tips = "".join(
        f'<body euler="0 0 {2 * np.pi * k / 3}"><joint name="j{k}" axis="0 0 1" '
        f'range="-0.32 0.22"/><geom type="sphere" size="0.01" pos="{link} 0 0"/>'
        f'<body name="arm{k}"><joint name="r{k}" type="slide" axis="1 0 0" range="-0.01 0.01"/>'
        f'<joint name="z{k}" type="slide" axis="0 0 1" range="-0.01 0.01"/>'
        f'<body name="t{k}" pos="0.06 0 0"><geom type="sphere" size="0.01"/></body></body></body>'
        for k in range(3)
    )
    servos = "".join(f'<position joint="{a}{k}" kp="3"/>' for k in range(3) for a in "jrz")
    text = (
        '<mujoco><compiler angle="radian" autolimits="true"/><worldbody>'
        f"{tips}</worldbody><actuator>{servos}</actuator></mujoco>"
    )
    path = tmp_path / "three.xml"
    path.write_text(text)
    hand = HandModel.from_mjcf(path, {f"t{k}": (0, 0, 0) for k in range(3)})
    search = search_of(hand, "sphere", grip=2.0, weight=1.0)
    inward = -np.array([[np.cos(a), np.sin(a), 0.0] for a in 2 * np.pi / 3 * np.arange(3)])
    one = Contacts(
        placement=(Placement(np.zeros(3), 0.1, 0.0),),
        q=np.zeros((1, 9)),
        active=np.ones((1, 3), bool),
        position=-0.05 * inward[None],
        normal=inward[None],
        clearance=np.array([0.02]),
        ease=np.ones(1),
        imbalance=np.zeros(1),
        lifted=np.ones(1),
    )
    (score,) = scores(search, one)
    assert score.reach == pytest.approx(0.3 + 0.2, abs=0.051)  # in steps of 0.05
    assert score.swing == pytest.approx(swing, abs=0.051)
    assert score.spare == 0.0  # with three fingers none can be lifted
    assert score.dexterity == pytest.approx(0.05, rel=1e-3)  # the hinge's lever
    assert score.balance == pytest.approx(1.0)
    # a third of the grip each, in the plane; epsilon of three contacts with friction 1, hexagons
    assert 0.5 < score.margin < 6.0
    assert score.fingers == 3
    # softest about an axis in the plane: two of three slides of 3 N/m, by half their lever squared
    assert score.stiffness == pytest.approx(4.5, rel=1e-3)


@pytest.mark.parametrize(("at", "holds"), [((0, 90, 180, 270), True), ((0, 40, 80, 180), False)])
def test_spare_is_the_margin_of_the_fingers_that_are_left(
    bare: HandModel, at: tuple[float, ...], holds: bool
) -> None:
    """Four contacts round an axis, of which three that stand all on one side hold nothing."""
    search = search_of(bare, "cylinder", grip=2.0, weight=1.0, friction=0.7)
    angle = np.deg2rad(at)
    outward = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    centre = np.array([0.0, 0.0, 0.5])
    found = Contacts(
        placement=(Placement(centre, 0.06, 0.0),),
        q=np.zeros((1, bare.nq)),
        active=np.ones((1, 4), bool),
        position=centre + 0.03 * outward[None],
        normal=-outward[None],
        clearance=np.array([0.02]),
        ease=np.ones(1),
        imbalance=np.zeros(1),
        lifted=np.zeros(1),
    )
    (score,) = scores(search, found)
    assert score.margin > 0
    left = [
        epsilon_quality(found.position[0], found.normal[0], np.arange(4) != f, centre, 0.7, edges=6)
        for f in range(4)
    ]
    assert score.spare == pytest.approx(min(left) * 3 * 2.0)  # three press with 2 N on 1 N
    assert (score.spare > 0.1) == holds


def test_the_search_looks_for_places_where_one_finger_can_be_lifted(bare: HandModel) -> None:
    found = search_of(bare, "sphere").run(60, 12)
    assert found is not None
    assert (found.lifted[~(found.active.sum(axis=-1) > 3)] == 1.0).all()
    assert ((found.lifted >= 0) & (found.lifted <= 1)).all() and found.lifted.min() < 0.8


def test_a_hand_of_which_nothing_is_known_holds(bare: HandModel) -> None:
    scene = Scene.build(bare, "sphere")
    assert scene.grasp_q is not None
    assert scene.notes[0].startswith("grasp suggested: sphere ")
    centre = scene.settled.qpos[scene.object_qpos][:3]
    assert np.linalg.norm(centre - scene.grasp_centre) < 0.01
    again = Scene.build(bare, "sphere", "down")  # of the same search
    assert again.object_width == scene.object_width
    again.settled  # noqa: B018 (raises where it is not held)


def test_a_suggestion_is_a_hand_file(bare: HandModel, tmp_path: Path) -> None:
    best = Scene.suggest_grasp(bare, "cube", count=1)[0]
    assert best.held_up and best.held_down
    config = best.applied(bare.config, bare.joint_names)
    config.write(tmp_path / "mine.toml")
    hand = HandModel.load(tmp_path / "mine.toml")
    for palm in ("up", "down"):
        scene = Scene.build(hand, "cube", palm)
        assert scene.object_width == pytest.approx(best.size, abs=1e-4)
        assert scene.notes == ()
        settled = scene.settled
        assert np.linalg.norm(settled.qpos[scene.object_qpos][:3] - best.centre) < 0.01


@pytest.mark.slow
def test_size_and_place_that_are_given_are_kept(bare: HandModel) -> None:
    centre = (0.015, -0.018, 0.09)
    found = Scene.suggest_grasp(bare, "sphere", object_size=0.06, grasp_centre=centre, count=1)
    assert found[0].size == 0.06
    np.testing.assert_array_equal(found[0].centre, centre)


def test_a_finger_of_very_many_joints_is_refused_in_one_line(tmp_path: Path) -> None:
    """In every drawn posture one joint is near its limits, and most links lie in others."""
    links = 120
    text = "".join(
        f'<body name="b{i}" pos="0 0 0.01"><joint name="j{i}" axis="1 0 0" range="0 1"/>'
        '<geom size="0.006"/>'
        for i in range(links)
    )
    path = tmp_path / "chain.xml"
    ends = "</body>" * links + "</worldbody></mujoco>"
    path.write_text(f'<mujoco><compiler angle="radian"/><worldbody>{text}{ends}')
    chain = HandModel.from_mjcf(path, [f"b{links - 1}"])
    with pytest.raises(SimulationError, match="chain: 1 finger, b119; expected 2 or more"):
        Scene.build(chain, "sphere")
    search = search_of(chain, "sphere")
    assert len(search.drawn(5, np.random.default_rng(0))) == 5
    search.run(5, 2)


def test_planar_fingers_are_named_and_no_size_is_advised(tmp_path: Path) -> None:
    fingers = "".join(
        f'<body name="a{k}" pos="0 {0.03 * k} 0"><joint name="a{k}" axis="0 1 0"/>{BAR}'
        f'<body name="b{k}" pos="0.04 0 0"><joint name="b{k}" axis="0 1 0"/>{BAR}'
        f'<body name="t{k}" pos="0.04 0 0"><joint name="t{k}" axis="0 1 0"/>{BAR}'
        "</body></body></body>"
        for k in range(3)
    )
    path = tmp_path / "planar.xml"
    path.write_text(f"<mujoco><default>{RANGE}</default><worldbody>{fingers}</worldbody></mujoco>")
    hand = HandModel.from_mjcf(path, {f"t{k}": (0.04, 0, 0) for k in range(3)})
    with pytest.raises(SimulationError, match="joints of t0, t1, t2 move .* plane") as caught:
        Scene.suggest_grasp(hand, "cube")
    assert "object_size" not in str(caught.value) and "expected 3 fingers" in str(caught.value)


def test_what_mujoco_cannot_step_is_said_in_one_line(
    dex5: HandModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise mujoco.FatalError("mj_stackAlloc: out of memory,\n stack overflow")

    monkeypatch.setattr(mujoco, "mj_step", full)
    scene = Scene.build(dex5, "cube", object_size=0.0512)  # which no other test has settled
    with pytest.raises(SimulationError, match="dex5.xml: MuJoCo cannot step the hand: mj_stack"):
        scene.settled  # noqa: B018


def test_suggestions_say_what_they_want(bare: HandModel, tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="twist is all zero"):
        Scene.suggest_grasp(bare, "cube", twist=np.zeros(6))
    with pytest.raises(InvalidInput, match="near is 'here'; expected a grasp"):
        Scene.suggest_grasp(bare, "cube", near="here")  # type: ignore[arg-type]
    for seed in (-1, "a"):
        with pytest.raises(InvalidInput, match=f"seed is {seed!r}; expected a whole number from 0"):
            Scene.suggest_grasp(bare, "cube", seed=seed)  # type: ignore[arg-type]
    with pytest.raises(SimulationError, match="no place, size and posture found"):
        Scene.suggest_grasp(bare, "cube", object_size=2.0)
    with pytest.raises(UnknownName, match="known: ffj0, ffj1"):
        Scene.build(bare, object_size=0.06, grasp_centre=(0, 0, 0.1), grasp_q={"thumb": 0.1})
    with pytest.raises(UnknownName, match="unknown joint 'f9'; known: ffj0, ffj1"):
        Scene.build(bare, "cube", object_size=0.06, grasp_centre=(0, 0, 0.1), open_q={"f9": 0.1})
    with pytest.raises(InvalidInput, match=r"mesh is .* and object_mesh"):
        Scene.build(bare, "mesh", mesh=tmp_path / "a.stl", object_mesh=tmp_path / "b.stl")


def test_failures_name_every_finger(dex5: HandModel) -> None:
    scene = Scene.build(dex5, "sphere", grasp_centre=(0.0, 0.0, 0.26))
    with pytest.raises(SettleFailure, match="out of reach: f1_tip by") as caught:
        scene.settled  # noqa: B018
    failure = caught.value
    assert "\n" not in str(failure)
    assert len(failure.attempts) >= 11
    assert failure.closest is not None
    assert failure.closest.gap.shape == (5,)
    assert (failure.closest.gap > 0.01).all()
    assert not failure.reached.any()
    lines = failure.details.splitlines()
    assert len(lines) == sum(1 + np.isfinite(a.gap).all() for a in failure.attempts)
    assert all(f"{name} +" in lines[1] for name in dex5.fingertip_names)
    assert failure.attempts[0].qpos.shape == (scene.model.nq,)


def test_couplings_are_followed(tmp_path: Path, dex5: HandModel) -> None:
    """A link that follows another joint is where the equality puts it, not at its zero."""
    text = dex5.path.read_text().replace(
        "</mujoco>",
        '<equality><joint joint1="f1_flexion2" joint2="f1_flexion1" polycoef="-0.2 -0.8 0 0 0"/>'
        "</equality></mujoco>",
    )
    path = tmp_path / "coupled.xml"
    path.write_text(text)
    hand = replace(dex5.config, description=path, postures=PostureConfig()).build()
    assert hand.nq == 14
    balls = HandBalls(mujoco.MjModel.from_xml_path(str(path)), hand)
    q = hand.posture({"f1_flexion1": 0.9})
    tip = balls.centres(q[None])[0, balls.tip & (balls.finger == 0)].mean(axis=0)
    np.testing.assert_allclose(tip, hand.fingertip_positions(q)[0], atol=1e-9)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"grasp_centre": (1, 1, 1)}, r"f1_tip 8\d\d mm away, .*grasp_centre nearer to those"),
        ({"object_size": 5.0}, r"the palm \d+ mm inside it; take a smaller object_size"),
        ({"grip": 1000.0}, "f5_tip too weak; take less grip than 1000 N"),
    ],
)
def test_where_there_is_no_place_it_says_how_near_each_came(given: dict, said: str) -> None:
    with pytest.raises(SimulationError, match=f"no place, size and posture found.*{said}"):
        Scene.suggest_grasp("dex5", "cube", **given)


def test_the_nearest_approach_is_that_of_the_postures(bare: HandModel) -> None:
    sphere = Scene.build(bare, "sphere", object_size=1.0, grasp_centre=(0, 0, 10))
    space, ball = search_of(bare).workspace, Shape.of_body(sphere.model)
    ball, away, near = ball.scaled(0.02), np.array([0.0, 0.0, 1.0]), space.tips[7, 2]
    assert space.approach(2, ball, near, np.eye(3)) == 0.0
    found = space.approach(2, ball, away, np.eye(3))
    rough = np.linalg.norm(space.tips[:, 2] - away, axis=-1).min() - 0.01
    assert rough - 0.06 < found < rough + 0.01


@pytest.mark.parametrize("wrist", ["", '<joint name="wrist" axis="0 1 0"/>'])
def test_fingers_are_as_long_as_from_their_own_first_joint(tmp_path: Path, wrist: str) -> None:
    """A wrist that moves them all, and what is below it, is not theirs; a plate amid them is."""
    fingers = "".join(
        f'<body name="base{i}" pos="0.09 {y} 0">{RANGE}{BAR}<body name="plate{i}" pos="0.01 0 0">'
        f'<body name="tip{i}" pos="0.03 0 0">{RANGE}{BAR}</body></body></body>'
        for i, y in enumerate((-0.03, 0.03))
    )
    path = tmp_path / "hand.xml"
    path.write_text(
        '<mujoco><compiler angle="degree"/><worldbody><body name="arm"><body name="palm" '
        f'pos="0.2 0 0">{wrist}{BAR}{fingers}</body></body></worldbody></mujoco>'
    )
    hand = HandModel.from_mjcf(path, {"tip0": (0.05, 0, 0), "tip1": (0.05, 0, 0)})
    assert search_of(hand).workspace.reach == pytest.approx(0.01 + 0.03 + 0.05)
