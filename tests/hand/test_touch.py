"""Touch without touch sensors: forces from joint torques and back, switches, thresholds, time."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dexctl import GraspState, InvalidInput, hands
from dexctl.hand import HandModel
from dexctl.joint_touch import JointTouch
from dexctl.touch import TouchConfig

RADIUS = 0.014
CONFIG = TouchConfig()


@pytest.fixture(scope="module")
def wrist_hand(tmp_path_factory: pytest.TempPathFactory) -> HandModel:
    """Two fingers of three joints each on a wrist."""
    mass = '<inertial pos="0 0 0" mass="0.1" diaginertia="1e-4 1e-4 1e-4"/>'
    fingers = "".join(
        f'<body pos="{x} 0 0"><joint name="a{i}" axis="1 0 0"/>{mass}<body pos="0 0 0.05">'
        f'<joint name="b{i}" axis="0 1 0"/>{mass}<body pos="0 0 0.05"><joint name="c{i}" '
        f'axis="0 1 0"/>{mass}<body name="tip{i}" pos="0 0 0.05"/></body></body></body>'
        for i, x in enumerate((-0.05, 0.05))
    )
    path = tmp_path_factory.mktemp("wrist") / "wrist.xml"
    path.write_text(
        '<mujoco><compiler angle="radian" autolimits="true"/><default><joint range="-2 2"/>'
        f'</default><worldbody><body><joint name="wrist" axis="0 0 1"/>{mass}{fingers}</body>'
        "</worldbody></mujoco>"
    )
    return HandModel.from_mjcf(path, ["tip0", "tip1"])


@pytest.fixture(scope="module")
def hand() -> HandModel:
    return hands.load("dex5")


def pressing(hand: HandModel, force: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A posture, the torques by which its tips press inwards with ``force``, and where to."""
    q = np.tile([0.1, 0.3, -0.9], hand.n_fingers)
    tip = hand.fingertip_positions(q)
    inward = tip.mean(axis=0) - tip
    inward /= np.linalg.norm(inward, axis=1, keepdims=True)
    jacobian = hand.contact_jacobian(q, tip)
    torque = np.einsum("fkd,fk->d", jacobian, np.asarray(force)[:, None] * inward)
    return q, torque, inward


def test_forces_are_those_that_made_the_torques(hand: HandModel) -> None:
    q, torque, inward = pressing(hand, [1.0, 0.0, 2.0, 0.3, 0.6])
    state = GraspState.from_joint_torques(hand, q, q, torque=torque, config=CONFIG)
    assert state.in_contact.tolist() == [True, False, True, False, True]
    on = state.in_contact
    np.testing.assert_allclose(state.contact_force, [1.0, 0.0, 2.0, 0.0, 0.6], rtol=0.05)
    np.testing.assert_allclose(state.contact_normal[on], inward[on], atol=0.02)
    point = hand.fingertip_positions(q) + RADIUS * inward
    np.testing.assert_allclose(state.contact_position[on], point[on], atol=5e-4)
    assert not state.contact_normal[~on].any()


def test_friction_at_the_contact_is_no_force_along_the_normal(hand: HandModel) -> None:
    """It has a moment about the tip point, which is inside of the fingertip."""
    q, _, inward = pressing(hand, [1.0] * 5)
    point = hand.fingertip_positions(q) + RADIUS * inward
    force = inward + np.array([0.0, 0.0, 0.5])
    torque = np.einsum("fkd,fk->d", hand.contact_jacobian(q, point), force)
    state = GraspState.from_joint_torques(hand, q, q, torque=torque, config=CONFIG)
    np.testing.assert_allclose(state.contact_force, 1.0, atol=0.02)


def test_servos_press_by_their_stiffness_up_to_their_limit(hand: HandModel) -> None:
    q, torque, _ = pressing(hand, [1.0] * 5)
    measured = GraspState.from_joint_torques(hand, q, q, torque=torque, config=CONFIG)
    lead = q + torque / 3.0
    by_lead = GraspState.from_joint_torques(hand, q, lead, 3.0, config=CONFIG)
    np.testing.assert_allclose(by_lead.contact_force, measured.contact_force)
    far = GraspState.from_joint_torques(hand, q, q + 100 * torque, 3.0)
    at_limit = GraspState.from_joint_torques(hand, q, q, torque=hand.effort * np.sign(torque))
    np.testing.assert_allclose(far.contact_force, at_limit.contact_force)


def test_what_holds_the_finger_itself_is_taken_off(hand: HandModel) -> None:
    q, torque, _ = pressing(hand, [1.0] * 5)
    weight = np.linspace(-0.05, 0.05, hand.nq)
    a = GraspState.from_joint_torques(hand, q, q, torque=torque + weight, free_torque=weight)
    b = GraspState.from_joint_torques(hand, q, q, torque=torque)
    np.testing.assert_allclose(a.contact_force, b.contact_force)


def test_pulling_away_is_no_touch(hand: HandModel) -> None:
    q, torque, _ = pressing(hand, [-2.0] * 5)
    assert not GraspState.from_joint_torques(hand, q, q, torque=torque).in_contact.any()


def test_a_finger_that_touched_is_let_go_later(hand: HandModel) -> None:
    q, torque, _ = pressing(hand, [0.3] * 5)
    touched = [True, False, True, False, False]
    state = GraspState.from_joint_torques(hand, q, q, torque=torque, touched=touched)
    assert state.in_contact.tolist() == touched


def test_the_normal_leans_with_the_force_so_far(hand: HandModel) -> None:
    q = np.tile([0.1, 0.3, -0.9], hand.n_fingers)
    tip = hand.fingertip_positions(q)
    inward = tip.mean(axis=0) - tip
    inward /= np.linalg.norm(inward, axis=1, keepdims=True)
    jacobian = hand.contact_jacobian(q, tip + RADIUS * inward)  # where it touches
    force = inward + np.array([0.0, 0.0, 0.8])
    torque = np.einsum("fkd,fk->d", jacobian, force)
    for lean in (0.0, 0.3, 2.0):
        state = GraspState.from_joint_torques(
            hand, q, q, torque=torque, config=TouchConfig(lean=lean)
        )
        along = np.minimum((state.contact_normal * inward).sum(axis=1), 1.0)
        angle = np.arccos(along)
        np.testing.assert_allclose(np.tan(angle), min(lean, 0.8), atol=0.05)


def test_a_switch_alone_has_a_nominal_force(hand: HandModel) -> None:
    q, _, inward = pressing(hand, [0.0] * 5)
    touch = [True, True, False, True, False]
    state = GraspState.from_binary_touch(hand, q, q, touch, config=TouchConfig(nominal_force=1.5))
    np.testing.assert_array_equal(state.contact_force, [1.5, 1.5, 0.0, 1.5, 0.0])
    np.testing.assert_allclose(state.contact_normal[touch], inward[touch])


def test_a_switch_and_torques(hand: HandModel) -> None:
    q, torque, _ = pressing(hand, [1.0, 0.1, 2.0, 1.0, -1.0])
    touch = [True, True, False, True, True]
    state = GraspState.from_binary_touch(hand, q, q, touch, torque=torque)
    assert state.in_contact.tolist() == touch
    np.testing.assert_allclose(state.contact_force, [1.0, 0.1, 0.0, 1.0, 0.0], rtol=0.05)


def test_a_tracked_object_says_where_the_fingers_press(hand: HandModel) -> None:
    q, _, _ = pressing(hand, [1.0] * 5)
    centre = np.array([0.01, 0.02, 0.12])
    state = GraspState.from_binary_touch(
        hand, q, q, [True] * 5, object_position=centre, object_quaternion=[1, 0, 0, 0]
    )
    tip = hand.fingertip_positions(q)
    towards = (centre - tip) / np.linalg.norm(centre - tip, axis=1, keepdims=True)
    np.testing.assert_allclose(state.contact_normal, towards)
    assert state.object_position is not None


def test_one_hand_and_a_batch_are_the_same(hand: HandModel) -> None:
    rng = np.random.default_rng(0)
    q = rng.uniform(-0.3, 0.3, (4, hand.nq))
    lead = q + rng.normal(0.0, 0.1, q.shape)
    batch = GraspState.from_joint_torques(hand, q, lead, 3.0)
    for i in range(4):
        one = GraspState.from_joint_torques(hand, q[i], lead[i], 3.0)
        for name, value in one.arrays().items():
            if value is not None and np.ndim(value):
                np.testing.assert_allclose(value, getattr(batch, name)[i], atol=1e-12)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"stiffness": 3.0, "q": np.zeros(15) + 1j}, "q is not an array of numbers"),
        ({"stiffness": 3.0, "q_target": np.full(15, 1e200)}, "q_target is .* at most 1e"),
        ({"stiffness": 1e300}, "stiffness is 1e.300; expected finite numbers, .* at most 1e"),
        ({"torque": np.full(15, 1e300)}, "torque is .* at most 1e"),
        ({"stiffness": 3.0, "touched": [2, 0, 0, 0, 0]}, "touched is .*; expected bools"),
        ({"stiffness": 3.0, "object_position": [0, 0, np.nan]}, "object_position is .* finite"),
        ({"stiffness": 3.0, "age": "old"}, "age is not an array of numbers"),
        ({}, "neither stiffness nor torque"),
        ({"stiffness": 3.0, "torque": np.zeros(15)}, "both stiffness and torque"),
        ({"stiffness": -1.0}, "stiffness is -1.0; expected N m/rad above 0"),
        ({"stiffness": np.ones(4)}, r"expected finite numbers, one or \(..., 15\)"),
        ({"torque": np.full(15, np.nan)}, "torque is .* expected finite numbers"),
        ({"stiffness": 3.0, "touched": [True]}, r"touched has shape \(1,\); expected \(5,\)"),
        ({"stiffness": 3.0, "q_target": np.zeros(3)}, r"q_target has shape \(3,\)"),
        ({"stiffness": 3.0, "q": "open"}, "q is not an array of numbers: 'open'"),
        ({"stiffness": 3.0, "q": np.full(15, np.nan)}, "q is .* expected finite numbers"),
        ({"stiffness": 3.0, "object_position": np.zeros(2)}, "object_position has shape"),
    ],
)
def test_bad_input(hand: HandModel, given: dict[str, Any], message: str) -> None:
    arguments = {"q": np.zeros(15), "q_target": np.zeros(15), **given}
    with pytest.raises(InvalidInput, match=message):
        GraspState.from_joint_torques(hand, **arguments)


@pytest.mark.parametrize("name", ["stiffness", "torque", "free_torque"])
def test_of_one_joint_of_each_or_of_each_hand(hand: HandModel, name: str) -> None:
    q = np.zeros((3, 15))
    state = bare(hand, q, q)
    touch = JointTouch(hand, 3.0)
    given: dict[str, Any] = {"torque": 1.0} if name == "free_torque" else {}
    for value in (0.5, np.full(15, 0.5), np.full((3, 15), 0.5)):
        one = GraspState.from_joint_torques(hand, q, q, **{**given, name: value})
        assert one.batch_shape == (3,) and np.isfinite(one.contact_force).all()
    for shape in ((0, 15), (2, 15), (2, 3, 15)):
        value = np.full(shape, 0.5)
        with pytest.raises(InvalidInput, match=rf"{name} has shape .*; expected \(3, 15\)"):
            GraspState.from_joint_torques(hand, q, q, **{**given, name: value})
        if name != "stiffness":
            with pytest.raises(InvalidInput, match=rf"{name} has shape .*; expected \(3, 15\)"):
                touch(state, **{name: value})


@pytest.mark.parametrize("name", ["switches", "mask"])
def test_rows_of_different_lengths_are_no_mask(hand: HandModel, name: str) -> None:
    wrong: Any = [[True], [True, False]]
    state = bare(hand, np.zeros((3, 15)), np.zeros((3, 15)))
    with pytest.raises(InvalidInput, match=f"{name} has shape .*; expected bools of shape"):
        JointTouch(hand, 3.0)(state, **{name: wrong})


def test_thresholds_in_the_wrong_order() -> None:
    with pytest.raises(InvalidInput, match="release_force is 0.5 N; expected at most touch_force"):
        TouchConfig(touch_force=0.4, release_force=0.5)


def test_joints_that_share_a_wrist_press_by_their_own_joints(wrist_hand: HandModel) -> None:
    q = np.full(wrist_hand.nq, 0.2)
    wrist = wrist_hand.moves.sum(axis=0) > 1
    assert wrist.any()
    torque = np.where(wrist, 10.0, 0.0)
    state = GraspState.from_binary_touch(
        wrist_hand, q, q, [True] * wrist_hand.n_fingers, torque=torque
    )
    assert not state.contact_force.any()


def bare(hand: HandModel, q: np.ndarray, q_target: np.ndarray) -> GraspState:
    return GraspState.from_binary_touch(hand, q, q_target, np.zeros((*q.shape[:-1], 5), bool))


def test_torques_are_smoothed(hand: HandModel) -> None:
    q, torque, _ = pressing(hand, [1.0] * 5)
    touch = JointTouch(hand, 3.0, config=TouchConfig(smoothing_time=0.05), control_period=0.05)
    rest, press = bare(hand, q, q), bare(hand, q, q + torque / 3.0)
    full = JointTouch(hand, 3.0, config=TouchConfig(smoothing_time=0.0))(press).contact_force
    touch(rest)
    for share in 1 - np.exp(-np.arange(1, 5)):
        np.testing.assert_allclose(touch(press).contact_force, share * full)


@pytest.mark.parametrize("damping", [0.02, 0.15, 3.0, 1e6])
def test_damping_is_no_force(hand: HandModel, damping: float) -> None:
    """Joints that slow down as exp(-k t / d) on the way to where they press as hard as they do."""
    config, stiffness, period = TouchConfig(smoothing_time=0.0), 3.0, 0.05
    q, torque, _ = pressing(hand, [1.0] * 5)
    touch = JointTouch(hand, stiffness, damping, config, control_period=period)
    still = JointTouch(hand, stiffness, damping, config)(bare(hand, q, q + torque / stiffness))
    lead = np.linspace(-0.02, 0.02, hand.nq)  # what is left of the way
    before = q + lead - lead * np.exp(stiffness * period / damping)
    touch(bare(hand, before, before))
    target = q + lead + torque / stiffness
    np.testing.assert_allclose(
        touch(bare(hand, q, target)).contact_force, still.contact_force, rtol=1e-5
    )


def test_what_holds_the_finger_itself_is_no_force(hand: HandModel) -> None:
    config = TouchConfig(smoothing_time=0.0)
    q, torque, _ = pressing(hand, [1.0] * 5)
    weight = np.linspace(-0.05, 0.05, hand.nq)
    heavy = bare(hand, q, q + (torque + weight) / 3.0)
    light = JointTouch(hand, 3.0, config=config)(bare(hand, q, q + torque / 3.0))
    touch = JointTouch(hand, 3.0, config=config)
    found = touch(heavy, free_torque=weight)
    np.testing.assert_allclose(found.contact_force, light.contact_force)
    measured = touch(heavy, torque=torque + weight, free_torque=weight)
    np.testing.assert_allclose(measured.contact_force, light.contact_force)
    assert not np.allclose(touch(heavy).contact_force, light.contact_force)
    with pytest.raises(InvalidInput, match="free_torque is"):
        touch(heavy, free_torque=np.zeros(3))


def test_links_are_weighed_where_gravity_is_known(hand: HandModel) -> None:
    q, torque, _ = pressing(hand, [1.0] * 5)
    down, weight = np.array([0.0, 0.0, -9.81]), np.linspace(-0.05, 0.05, hand.nq)

    def weights(q: np.ndarray, gravity: np.ndarray) -> np.ndarray:
        return np.broadcast_to(gravity[..., 2:] / down[2] * weight, q.shape)

    def force(config: TouchConfig, gravity: np.ndarray | None, load: np.ndarray) -> np.ndarray:
        state = replace(bare(hand, q, q + (torque + load) / 3.0), gravity=gravity)
        return JointTouch(hand, 3.0, config=config, weights=weights)(state).contact_force

    plain = TouchConfig(smoothing_time=0.0)
    light = force(plain, None, 0 * weight)
    np.testing.assert_allclose(force(plain, down, weight), light)
    np.testing.assert_allclose(force(plain, -down, -weight), light)
    assert not np.allclose(force(plain, None, weight), light)
    left = replace(plain, weigh_links=False)
    np.testing.assert_array_equal(force(left, down, weight), force(plain, None, weight))
    with pytest.raises(InvalidInput, match="weigh_links is 1; expected a bool"):
        TouchConfig(weigh_links=1)  # type: ignore[arg-type]


def test_joints_without_damping_move_freely(hand: HandModel) -> None:
    config = TouchConfig(smoothing_time=0.0)
    q, torque, _ = pressing(hand, [1.0] * 5)
    touch = JointTouch(hand, 3.0, 0.0, config)
    here = bare(hand, q, q + torque / 3.0)
    still = touch(here).contact_force
    touch(bare(hand, q - 0.02, q - 0.02))
    np.testing.assert_allclose(touch(here).contact_force, still)


def test_each_hand_of_a_batch_begins_by_itself(hand: HandModel) -> None:
    q, torque, _ = pressing(hand, [0.3] * 5)
    config = TouchConfig(smoothing_time=0.0)
    touch = JointTouch(hand, 3.0, config=config)
    q2 = np.tile(q, (2, 1))
    assert touch(bare(hand, q2, q2 + torque)).in_contact.all()
    weak = bare(hand, q2, q2 + torque / 3.0)
    saved = touch.state_dict()
    assert touch(weak).in_contact.all()  # above the threshold of release
    touch.reset(np.array([True, False]))
    assert touch(weak).in_contact.tolist() == [[False] * 5, [True] * 5]
    other = JointTouch(hand, 3.0, config=config)
    other.load_state_dict(saved)
    assert other(weak).in_contact.all()
    # where no control period has passed the past stays as it is
    none = JointTouch(hand, 3.0, config=config)
    none(bare(hand, q2, q2 + torque))
    none(bare(hand, q2, q2), mask=np.array([True, False]))
    assert none(weak).in_contact.tolist() == [[False] * 5, [True] * 5]


def test_what_is_not_finite_is_refused_and_not_remembered(hand: HandModel) -> None:
    """One NaN in a torque was in the smoothed one for good: its finger touched nothing any more."""
    q, torque, _ = pressing(hand, [1.0] * 5)
    state, spoilt = bare(hand, q, q), torque.copy()
    spoilt[0] = np.nan
    touch, same = JointTouch(hand, 3.0), JointTouch(hand, 3.0)
    for one in (touch, same):
        one(state, torque=torque)
    for call, said in (
        (lambda: touch(state, torque=spoilt), "torque is .*; expected finite numbers"),
        (lambda: touch(state, torque=torque[:14]), r"torque is .*; expected finite .*\(..., 15\)"),
        (lambda: touch(replace(state, q=q + np.nan), torque=torque), "q is .*; expected finite"),
        (lambda: touch(replace(state, q_target=q + np.nan)), "q_target is .*; expected finite"),
        (lambda: touch(state, np.ones(4, bool), torque), r"switches has shape \(4,\)"),
        (
            lambda: touch(state, torque=torque, mask=np.ones(2, bool)),
            r"expected bools of shape \(\)",
        ),
        (lambda: touch.reset(np.ones(2, bool)), r"expected bools of shape \(\)"),
        (lambda: touch("state"), "state is 'state'; expected a GraspState"),  # type: ignore[arg-type]
    ):
        with pytest.raises(InvalidInput, match=said):
            call()
    after, before = (one(state, torque=torque) for one in (touch, same))
    assert after.in_contact.all()
    np.testing.assert_array_equal(after.contact_force, before.contact_force)


def test_a_bad_saved_past(hand: HandModel) -> None:
    with pytest.raises(InvalidInput, match="saved state of touch"):
        JointTouch(hand, 3.0).load_state_dict({"past": {"q": np.zeros(3)}})
    with pytest.raises(InvalidInput, match="damping is -1"):
        JointTouch(hand, 3.0, -1.0)


def test_what_joint_touch_refuses(hand: HandModel) -> None:
    for period in (0, -0.1, np.nan, np.inf, "fast"):
        with pytest.raises(InvalidInput, match="control_period is .*; expected seconds above 0"):
            JointTouch(hand, 1.0, control_period=period)  # type: ignore[arg-type]
    q = np.zeros(hand.nq)
    wrong: Any = {}
    for made in (
        lambda: JointTouch(hand, 1.0, config=wrong),
        lambda: GraspState.from_joint_torques(hand, q, q, 1.0, config=wrong),
        lambda: GraspState.from_binary_touch(hand, q, q, [True] * 5, config=wrong),
    ):
        with pytest.raises(InvalidInput, match="config is {}; expected a TouchConfig, or None"):
            made()
    name: Any = "dex5"
    for made in (
        lambda: JointTouch(name, 1.0),
        lambda: GraspState.from_joint_torques(name, q, q, 1.0),
        lambda: GraspState.from_binary_touch(name, q, q, [True] * 5),
    ):
        with pytest.raises(InvalidInput, match="hand is 'dex5'; expected a HandModel"):
            made()
    with pytest.raises(InvalidInput, match="stiffness is .*expected finite numbers, one or"):
        JointTouch(hand, ["hard"])
