"""Set-point limits, quaternions, and checks of settings: the small parts that all rooms use."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from dexctl import HandModel
from dexctl.exceptions import InvalidInput
from dexctl.limits import SetPointLimits
from dexctl.rotations import cross, inverse, multiply, rotate, rotation_vector
from dexctl.validation import check_numbers, check_twist

PERIOD, SPEED, LEAD = 0.05, 2.0, 0.25
ANGLES = arrays(float, (2, 15), elements=st.floats(-3.0, 3.0))


def scipy_rotation(quaternion: np.ndarray) -> Rotation:
    return Rotation.from_quat(np.roll(quaternion, -1, axis=-1))


def quaternions(count: int, seed: int) -> np.ndarray:
    raw = np.random.default_rng(seed).normal(size=(count, 4))
    return raw / np.linalg.norm(raw, axis=-1, keepdims=True)


@pytest.fixture
def limits(dex5: HandModel) -> SetPointLimits:
    return SetPointLimits(dex5, SPEED, LEAD, PERIOD)


@given(q=ANGLES, lead=ANGLES, change=ANGLES)
def test_set_points_stay_within_range_and_lead(dex5, q, lead, change):
    """Where they were, to a step's length: what they come back from is the next test's."""
    limited = SetPointLimits(dex5, SPEED, LEAD, PERIOD)
    q = dex5.clip(q)
    q_target = dex5.clip(q + np.clip(0.1 * lead, -LEAD - 0.05, LEAD + 0.05))
    moved = limited(q, q_target, change)
    target = q_target + moved
    driven = change != 0
    assert not moved[~driven].any()
    slack = 1e-12
    assert (target[driven] >= np.broadcast_to(dex5.lower, q.shape)[driven] - slack).all()
    assert (target[driven] <= np.broadcast_to(dex5.upper, q.shape)[driven] + slack).all()
    assert (np.abs(target - q)[driven] <= LEAD + slack).all()


@given(change=ANGLES)
def test_speed_is_limited_for_the_hand_as_a_whole(dex5, change):
    """With nothing else in the way, the direction of the motion of the hand stays."""
    wide = SetPointLimits(dex5, SPEED, 1e3, PERIOD)
    middle = np.broadcast_to((dex5.lower + dex5.upper) / 2, change.shape)
    moved = wide(middle, middle, change)
    fastest = np.abs(change).max(axis=-1, keepdims=True)
    expected = change / np.maximum(fastest / (SPEED * PERIOD), 1.0)
    np.testing.assert_allclose(moved, expected, atol=1e-12)


@given(q=ANGLES, q_target=ANGLES, change=ANGLES, factor=st.sampled_from([1.0, 1e6]))
def test_speed_is_kept_wherever_the_joints_are(dex5, q, q_target, change, factor):
    """Set-points too far from their joints, or out of range, come back at the speed allowed."""
    moved = SetPointLimits(dex5, SPEED, LEAD, PERIOD)(factor * q, q_target, change)
    assert (np.abs(moved) <= np.minimum(SPEED, dex5.velocity) * PERIOD).all()


def test_a_joint_beyond_its_limit_is_brought_back(dex5, limits):
    q = (dex5.lower + dex5.upper) / 2
    q[0] = dex5.upper[0] + 0.15
    change = np.zeros(15)
    change[0] = 0.01
    first = q + limits(q, q.copy(), change)
    assert first[0] == pytest.approx(dex5.upper[0] + 0.15 - SPEED * PERIOD, abs=1e-15)
    second = first + limits(q, first, change)
    assert second[0] == pytest.approx(dex5.upper[0], abs=1e-15)
    np.testing.assert_array_equal(second[1:], q[1:])


def test_joints_that_rest_are_left_alone(dex5, limits):
    """Even beyond every limit: they may belong to another controller."""
    q = (dex5.lower + dex5.upper) / 2
    q_target = q + 0.5
    change = np.zeros(15)
    change[4] = 1e-3
    moved = limits(q, q_target, change)
    assert np.flatnonzero(moved).tolist() == [4]
    assert moved[4] == pytest.approx(-SPEED * PERIOD)


def test_batch_is_each_alone(dex5, limits):
    rng = np.random.default_rng(0)
    q, change = rng.uniform(-1, 1, (6, 15)), rng.normal(size=(6, 15)) * 0.1
    q_target = q + rng.uniform(-0.3, 0.3, (6, 15))
    together = limits(q, q_target, change)
    for i in range(6):
        np.testing.assert_array_equal(together[i], limits(q[i], q_target[i], change[i]))


@pytest.mark.parametrize("seed", range(3))
def test_quaternions_against_scipy(seed):
    a, b = quaternions(20, seed), quaternions(20, seed + 100)
    vector = np.random.default_rng(seed).normal(size=(20, 3))
    ra, rb = scipy_rotation(a), scipy_rotation(b)
    np.testing.assert_allclose(rotate(a, vector), ra.apply(vector), atol=1e-12)
    np.testing.assert_allclose(rotate(inverse(a), vector), ra.inv().apply(vector), atol=1e-12)
    np.testing.assert_allclose(rotate(multiply(a, b), vector), (ra * rb).apply(vector), atol=1e-12)
    np.testing.assert_allclose(rotation_vector(a), ra.as_rotvec(), atol=1e-10)


def test_rotation_vectors_by_hand():
    half = np.sqrt(0.5)
    np.testing.assert_allclose(rotation_vector(np.array([half, 0, 0, half])), [0, 0, np.pi / 2])
    # q and -q are one rotation, and the short way round is taken
    np.testing.assert_allclose(rotation_vector(np.array([-half, 0, 0, -half])), [0, 0, np.pi / 2])
    np.testing.assert_array_equal(rotation_vector(np.array([1.0, 0, 0, 0])), np.zeros(3))


@pytest.mark.parametrize("angle", [1e-12, 1e-9, 1e-6, 1e-3])
def test_small_rotations_keep_their_digits(angle):
    quaternion = np.array([np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0])
    np.testing.assert_allclose(rotation_vector(quaternion), [0.0, angle, 0.0], rtol=1e-9)


@given(
    a=arrays(float, (3, 4, 3), elements=st.floats(-10, 10)), b=st.tuples(*[st.floats(-1, 1)] * 3)
)
def test_cross_products(a, b):
    for left, right in ((a, np.array(b)), (np.array(b), a), (a, a[::-1])):
        np.testing.assert_allclose(cross(left, right), np.cross(left, right), atol=1e-12)


@dataclass
class Settings:
    speed: object = 1.0
    gain: object = 0.0
    share: object = 0.5


def check(settings: Settings) -> None:
    check_numbers(settings, positive=("speed",), not_negative=("gain",), fractions=("share",))


def test_numbers_of_any_kind_pass():
    check(Settings())
    check(Settings(speed=np.float32(0.1), gain=3, share=np.int64(1)))


@pytest.mark.parametrize(
    ("field", "value", "expected"),
    [
        ("speed", 0.0, "a finite number above 0"),
        ("speed", np.inf, "a finite number above 0"),
        ("speed", np.nan, "a finite number above 0"),
        ("speed", "1", "a finite number above 0"),
        ("speed", None, "a finite number above 0"),
        ("speed", True, "a finite number above 0"),
        ("speed", 10**400, "a finite number above 0"),
        ("speed", np.complex128(1.0), "a finite number above 0"),
        ("speed", np.ones(3), "a finite number above 0"),
        ("speed", np.datetime64(1, "s"), "a finite number above 0"),
        ("gain", -1e-9, "a finite number, 0 or more"),
        ("gain", [1.0], "a finite number, 0 or more"),
        ("share", 1.01, "a number from 0 to 1"),
        ("share", -0.01, "a number from 0 to 1"),
        ("share", np.nan, "a number from 0 to 1"),
    ],
)
def test_other_numbers_are_named(field, value, expected):
    with pytest.raises(InvalidInput) as caught:
        check(Settings(**{field: value}))
    message = str(caught.value)
    assert message.startswith(f"{field} is ") and message.endswith(f"expected {expected}")
    assert len(message) < 150


def test_twists():
    check_twist((0, 0, 0, 0, 0, 1))
    check_twist(np.zeros(6))
    for bad in (
        np.zeros((1, 6)), [0.0] * 5 + [np.nan], "twist", {}, [0, 0, 0, 0, 0, "x"],
        np.zeros(6) + 0j, 10**400, [[0.0], [0.0] * 5],
    ):  # fmt: skip
        with pytest.raises(InvalidInput, match="six finite numbers"):
            check_twist(bad)
