"""SwitchProfile: shape, signs, draws, batches."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import dexctl.hands
from dexctl import GraspState
from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.hand import HandModel
from dexctl.switch.chain import joint_roles, own_joints
from dexctl.switch.profile import SwitchProfile

HAND = dexctl.hands.load("dex5")
RADIUS = 0.014


def grasp(batch: tuple[int, ...] = (), *, touch=None, seed: int = 0) -> GraspState:
    """Five fingers round an upright cylinder, each touching it on the side of its own base."""
    rng = np.random.default_rng(seed)
    q = np.tile([0.0, 0.5, -0.85], 5) + rng.uniform(-0.1, 0.1, (*batch, 15))
    tips = HAND.fingertip_positions(q)
    inward = -tips * [1.0, 1.0, 0.0]
    normal = inward / np.linalg.norm(inward, axis=-1, keepdims=True)
    in_contact = (
        np.ones((*batch, 5), bool) if touch is None else np.broadcast_to(touch, (*batch, 5))
    )
    shown = in_contact[..., None]
    return GraspState(
        q=q,
        q_target=q,
        in_contact=in_contact.copy(),
        contact_position=np.where(shown, tips + RADIUS * normal, 0.0),
        contact_normal=np.where(shown, normal, 0.0),
        contact_force=np.where(in_contact, 1.0, 0.0),
        object_position=np.broadcast_to([0.0, 0.0, 0.13], (*batch, 3)),
    )


def run(profile: SwitchProfile, state: GraspState, count: int) -> np.ndarray:
    return np.stack([profile.act(state) for _ in range(count)])


def test_shape_is_that_of_the_paper():
    profile = SwitchProfile(HAND, duration=1.0, control_period=0.05, speed=(0.2, 0.2))
    state = grasp()
    assert profile.begin(state, 1)
    assert profile.active
    assert (profile.steps, int(profile.finger)) == (20, 1)
    assert profile.switching.tolist() == [False, True, False, False, False]
    actions = run(profile, state, 20)
    assert not profile.active
    assert profile.finger == -1
    step = 0.2 * 0.05
    middle, roll = actions[:, 4], actions[:, 3]
    # on dex5, positive flexion is outward: away from the object
    np.testing.assert_allclose(middle, np.repeat([step, -step], 10), atol=1e-15)
    sign = np.sign(roll[10])
    expected = sign * np.repeat([0.0, step, 0.0], [5, 10, 5])
    np.testing.assert_allclose(roll, expected, atol=1e-15)
    others = np.delete(actions, [3, 4], axis=1)
    assert not others.any()
    assert not profile.act(state).any()


@pytest.mark.parametrize("finger", range(5))
@pytest.mark.parametrize("axis", [(0, 0, 1), (0, 0, -2)])
def test_first_half_leaves_the_object_and_roll_goes_against_its_rotation(finger, axis):
    state = grasp(seed=finger)
    profile = SwitchProfile(HAND, axis=axis)
    profile.begin(state, finger)
    jacobian = HAND.contact_jacobian(state.q, state.contact_position)[finger]
    first = jacobian @ profile.act(state)
    assert first @ state.contact_normal[finger] < 0
    profile.reset()
    profile.begin(state, finger)
    middle_of_switch = run(profile, state, 10)[-1]
    roll_only = np.where(np.arange(15) == 3 * finger, middle_of_switch, 0.0)
    arm = state.contact_position[finger] - [0, 0, 0.13]
    assert (jacobian @ roll_only) @ np.cross(axis, arm) < -1e-5


def test_roll_direction_fixed_by_option():
    state = grasp()
    for sign in (1, -1):
        profile = SwitchProfile(HAND, roll_direction=sign)
        profile.begin(state, 2)
        assert np.sign(run(profile, state, 10)[-1][6]) == sign


def test_without_object_position_the_contact_centroid_stands_in():
    tracked = grasp()
    untracked = replace(tracked, object_position=None)
    a, b = SwitchProfile(HAND), SwitchProfile(HAND)
    assert a.begin(tracked, 0)
    assert b.begin(untracked, 0)
    np.testing.assert_array_equal(run(a, tracked, 20), run(b, untracked, 20))


@pytest.mark.parametrize("period", [0.01, 0.05, 0.03, 0.125])
def test_path_does_not_depend_on_the_control_rate(period):
    """Set-points at common times agree, also where the period does not divide the duration."""
    fine, coarse = (SwitchProfile(HAND, control_period=p) for p in (0.005, period))
    state = grasp()
    paths = []
    for profile in (fine, coarse):
        profile.reset(seed=3)
        profile.begin(state)
        paths.append(np.cumsum(run(profile, state, profile.steps), axis=0))
    ratio = round(period / 0.005)
    whole = 200 // ratio
    np.testing.assert_allclose(paths[1][:whole], paths[0][ratio - 1 :: ratio][:whole], atol=1e-14)
    np.testing.assert_allclose(paths[1][-1], paths[0][-1], atol=1e-14)


@settings(derandomize=True, deadline=None, max_examples=25)
@given(seed=st.integers(0, 2**31), environments=st.integers(1, 6))
def test_batch_draws_what_each_environment_draws_alone(seed, environments):
    rng = np.random.default_rng(seed)
    state = grasp((environments,), touch=rng.random((environments, 5)) < 0.7, seed=seed % 1000)
    batch = SwitchProfile(HAND)
    batch.reset(seed=seed)
    together = []
    for _ in range(25):  # longer than one switch, so that second draws are seen too
        batch.begin(state)
        together.append(batch.act(state))
    for i in range(environments):
        alone = SwitchProfile(HAND)
        alone.reset(seed=seed + i)
        for k in range(25):
            alone.begin(state[i])
            np.testing.assert_array_equal(alone.act(state[i]), together[k][i])


def test_random_finger_is_in_contact_and_every_contact_comes_up():
    touch = np.array([True, False, True, True, False])
    state = grasp((400,), touch=touch)
    profile = SwitchProfile(HAND)
    assert profile.begin(state).all()
    share = np.bincount(profile.finger, minlength=5) / 400
    assert not share[~touch].any()
    np.testing.assert_allclose(share[touch], 1 / 3, atol=0.1)


def test_speeds_are_drawn_from_the_range_for_each_joint():
    state = grasp((300,))
    profile = SwitchProfile(HAND, control_period=0.05)
    profile.begin(state, 0)
    path = run(profile, state, 20).sum(axis=0)
    speeds = np.abs(np.stack([path[:, 0] / 0.5, profile._velocity[:, 0]]))
    assert speeds.min() >= 0.1
    assert speeds.max() < 0.4
    np.testing.assert_allclose(speeds.mean(axis=1), 0.25, atol=0.02)
    assert abs(np.corrcoef(speeds)[0, 1]) < 0.15


def test_nothing_begins_without_contact_or_while_switching_or_outside_the_mask():
    touch = np.array([[True] * 5, [False] * 5, [True] * 5])
    state = grasp((3,), touch=touch)
    profile = SwitchProfile(HAND)
    assert profile.begin(state, mask=[True, True, False]).tolist() == [True, False, False]
    assert profile.finger[1] == -1
    assert profile.begin(state).tolist() == [False, False, True]
    profile.reset()
    one_off = grasp((), touch=[True, True, False, True, True])
    assert not SwitchProfile(HAND).begin(one_off, 2)
    assert not SwitchProfile(HAND).begin(one_off, -1)


def test_rows_of_fingers_out_of_contact_are_not_read():
    state = grasp((2,), touch=[True, False, True, True, True])
    dirty_position, dirty_normal = state.contact_position.copy(), state.contact_normal.copy()
    dirty_position[:, 1], dirty_normal[:, 1] = np.nan, np.nan
    clean = replace(state, object_position=None)
    dirty = replace(clean, contact_position=dirty_position, contact_normal=dirty_normal)
    a, b = SwitchProfile(HAND), SwitchProfile(HAND)
    for k in range(20):
        np.testing.assert_array_equal(a.begin(clean), b.begin(dirty))
        np.testing.assert_array_equal(a.act(clean), b.act(dirty), err_msg=f"step {k}")


def test_masked_reset_ends_and_reseeds_only_those():
    state = grasp((3,))
    profile = SwitchProfile(HAND)
    profile.reset(seed=5)
    profile.begin(state)
    first = profile.act(state)
    profile.reset(seed=[5, 6, 7], mask=[False, True, False])
    assert profile.active.tolist() == [True, False, True]
    assert profile.begin(state).tolist() == [False, True, False]
    np.testing.assert_array_equal(profile.act(state)[1], first[1])


def test_a_loaded_state_replays():
    state = grasp((2,))
    profile = SwitchProfile(HAND)
    profile.reset(seed=1)
    profile.begin(state)
    run(profile, state, 7)
    saved = profile.state_dict()

    def go():
        actions = []
        for _ in range(30):
            profile.begin(state)
            actions.append(profile.act(state))
        return np.array(actions)

    first = go()
    profile.load_state_dict(saved)
    np.testing.assert_array_equal(go(), first)


def test_batch_shape_changes_only_between_switches():
    profile = SwitchProfile(HAND)
    profile.begin(grasp((2,)))
    with pytest.raises(InvalidInput, match=r"batch shape is \(\).*\(2,\).*under way"):
        profile.act(grasp())
    profile.reset()
    assert profile.act(grasp()).shape == (15,)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"duration": 0.0}, "duration is 0.0"),
        ({"duration": np.nan}, "duration is nan"),
        ({"duration": 0.01}, "at least a control_period"),
        ({"control_period": -1.0}, "control_period is -1.0"),
        ({"speed": (0.4, 0.1)}, "speed is"),
        ({"speed": (0.1, np.inf)}, "speed is"),
        ({"axis": (0, 0, 0)}, "axis is zero"),
        ({"axis": (0, 1)}, "axis is"),
        ({"roll_direction": "with"}, "'against', 1 or -1"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(InvalidInput, match=message):
        SwitchProfile(HAND, **options)


def test_bad_finger():
    with pytest.raises(InvalidInput, match=r"from -1 \(none\) to 4"):
        SwitchProfile(HAND).begin(grasp(), 5)
    with pytest.raises(UnknownName, match="unknown finger 7; known: 0, 1, 2, 3, 4"):
        own_joints(HAND, 7)


WRIST = """
<mujoco><compiler angle="radian"/><worldbody><body name="palm">
  <joint name="wrist" axis="0 0 1" range="-1 1"/><geom size="0.02"/>
  {fingers}
</body></worldbody></mujoco>
"""
FINGER = """
<body pos="{x} 0 0"><joint name="{n}a" axis="1 0 0" range="-1 1"/><geom size="0.01"/>
 <body pos="0 0 0.03"><joint name="{n}b" axis="0 1 0" range="-1 1"/><geom size="0.01"/>
  {more}<body name="{n}tip" pos="0 0 0.04"><geom size="0.01"/></body>{end}
 </body></body>
"""
LAST = '<body pos="0 0 0.04"><joint name="{n}c" axis="0 1 0" range="-1 1"/><geom size="0.01"/>'


def wrist_hand(tmp_path: Path, joints_per_finger: int = 3, **options) -> HandModel:
    fingers = "".join(
        FINGER.format(
            x=x,
            n=n,
            more=LAST.format(n=n) if joints_per_finger == 3 else "",
            end="</body>" if joints_per_finger == 3 else "",
        )
        for n, x in (("l", 0.05), ("r", -0.05))
    )
    path = tmp_path / "wrist.xml"
    path.write_text(WRIST.format(fingers=fingers))
    return HandModel.from_mjcf(path, ["ltip", "rtip"], **options)


def test_roles_leave_out_shared_joints_and_do_not_rely_on_the_joint_order(tmp_path):
    order = ["rc", "lb", "wrist", "la", "ra", "lc", "rb"]
    hand = wrist_hand(tmp_path, joints=order)
    names = np.array(hand.joint_names)
    roles = joint_roles(hand)
    assert names[roles.roll].tolist() == ["la", "ra"]
    assert names[roles.middle].tolist() == ["lb", "rb"]
    assert names[roles.distal].tolist() == ["lc", "rc"]


def test_a_finger_with_two_joints_is_an_error(tmp_path):
    hand = wrist_hand(tmp_path, joints_per_finger=2)
    with pytest.raises(InvalidInput, match=r"'ltip' has 2 joints of its own.*at least 3"):
        SwitchProfile(hand)


def test_roles_of_four_joints(four_fingers):
    hand, roles = four_fingers, joint_roles(four_fingers)
    assert [hand.joint_names[j] for j in roles.roll] == ["ffj0", "mfj0", "rfj0", "thj0"]
    assert [hand.joint_names[j] for j in roles.middle] == ["ffj2", "mfj2", "rfj2", "thj2"]
    assert [hand.joint_names[j] for j in roles.distal] == ["ffj3", "mfj3", "rfj3", "thj3"]
