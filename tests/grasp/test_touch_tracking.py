"""TouchTracking: objects found by hand-made contacts, and followed in the simulator."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dexctl import GraspState, HandModel
from dexctl.exceptions import InvalidInput
from dexctl.grasp import TouchTracking, TouchTrackingConfig
from dexctl.rotations import (
    angle_between,
    cross,
    from_rotation_vector,
    inverse,
    multiply,
    rotate,
    rotation_vector,
)
from dexctl.sim import Shape

CUBE = Shape.of_object("cube", 0.06)
CENTRE = np.array([0.0, 0.0, 0.1])
# points of five faces and the normals into them, in the frame of CUBE
POINT = 0.03 * np.array(
    [(1, 0.2, -0.3), (-1, -0.1, 0.4), (0.5, 1, 0.1), (-0.2, -1, -0.4), (0.1, 0.3, -1)]
)
INWARD = -np.array([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, -1.0)])
STILL = np.array([1.0, 0.0, 0.0, 0.0])


def touched(
    hand: HandModel,
    position: np.ndarray,
    quaternion: np.ndarray,
    touch: np.ndarray | None = None,
    point: np.ndarray = POINT,
    inward: np.ndarray = INWARD,
    felt: bool = True,
) -> GraspState:
    """Five contacts with objects ``(N,)`` that are there; the hand stands still."""
    count = len(position)
    touch = np.ones((count, 5), bool) if touch is None else touch
    there, aside = np.nan * np.ones((2, count, 5, 3))
    turn = np.broadcast_to(quaternion[:, None], (count, 5, 4))
    where = rotate(turn, np.broadcast_to(point, (count, 5, 3))) + position[:, None]
    facing = rotate(turn, np.broadcast_to(inward, (count, 5, 3)))
    q = np.tile([0.0, 0.75, -1.5], (count, 5))
    return GraspState(
        q=q,
        q_target=q,
        in_contact=touch,
        contact_position=np.where(touch[..., None], where, there),
        contact_normal=np.where(touch[..., None], facing, aside),
        contact_force=np.ones((count, 5)),
        normals_felt=felt,
    )


def tracking(hand: HandModel, count: int = 1, surface: object = CUBE, **changes) -> TouchTracking:
    found = TouchTracking(hand, surface, **changes)  # type: ignore[arg-type]
    found.start(count)
    found.place(np.ones(count, bool), np.tile(CENTRE, (count, 1)), np.tile(STILL, (count, 1)))
    return found


def off(one: TouchTracking, position: np.ndarray, quaternion: np.ndarray) -> tuple[float, float]:
    """How far it is from there, at most [m, rad]."""
    away = np.linalg.norm(one.position - position, axis=-1)
    return float(away.max()), float(angle_between(one.quaternion, quaternion).max())


def test_one_contact_weighs_as_a_kalman_filter_does(dex5: HandModel) -> None:
    """One fingertip on the cube's x face, 1 mm further out than it should be."""
    one = tracking(dex5, distance_noise=0.002, normal_noise=1e3, slip=0.01, middle_noise=1e3)
    touch = np.array([[True, False, False, False, False]])
    point = np.tile([0.031, 0.0, 0.0], (5, 1))
    state = touched(dex5, CENTRE[None], STILL[None], touch, point, np.tile([-1.0, 0, 0], (5, 1)))
    before = one.covariance[0, 0, 0]
    assert before == pytest.approx(0.002**2)
    one.track(state)
    # by how much the velocity may have changed in 0.05 s, and no contact before to say otherwise
    prior = before + (0.2 * 0.05**1.5) ** 2
    gain = prior / (prior + 0.002**2)
    assert one.position[0] - CENTRE == pytest.approx([gain * 0.001, 0.0, 0.0], abs=1e-9)
    assert one.covariance[0, 0, 0] == pytest.approx((1.0 - gain) * prior)
    assert one.covariance[0, 1, 1] == pytest.approx(prior, rel=1e-3)  # nothing was felt of it


def test_it_comes_to_where_the_contacts_are(dex5: HandModel) -> None:
    position = CENTRE[None] + [[0.003, -0.002, 0.004]]
    quaternion = from_rotation_vector(np.array([[0.1, -0.15, 0.2]]))
    state = touched(dex5, position, quaternion)
    one = tracking(dex5, middle_noise=10.0)
    far = off(one, position, quaternion)
    for _ in range(30):
        seen = one.track(state)
    near = off(one, position, quaternion)
    assert near[0] < 0.02 * far[0] and near[1] < 0.02 * far[1]
    np.testing.assert_array_equal(seen.object_position, one.position)
    np.testing.assert_array_equal(seen.object_quaternion, one.quaternion)


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    name=st.sampled_from(["cube", "cylinder", "sphere", "l_shape", "u_shape", "dodecahedron"]),
)
def test_contacts_come_to_lie_on_any_surface(dex5: HandModel, seed: int, name: str) -> None:
    """Five fingertips at places of the surface, and an object thought to be a little elsewhere."""
    rng = np.random.default_rng(seed)
    shape = Shape.of_object(name, 0.06)
    point, outward = shape.samples(400, seed)
    free = shape.distance(point + 0.014 * outward) > 0.0139  # where a fingertip can be
    point, outward = point[free], outward[free]
    chosen = rng.choice(len(point), 5, replace=False)
    position = CENTRE + rng.uniform(-0.002, 0.002, (1, 3))
    quaternion = from_rotation_vector(rng.uniform(-0.08, 0.08, (1, 3)))
    state = touched(dex5, position, quaternion, None, point[chosen], -outward[chosen])
    one = tracking(dex5, 1, shape, middle_noise=10.0)

    def gap() -> float:
        local = state.contact_position[0] - one.position
        return float(np.abs(shape.distance(rotate(inverse(one.quaternion), local))).max())

    before = gap()
    for _ in range(20):
        one.track(state)
    assert gap() < max(0.5 * before, 2e-4)
    assert np.isfinite(one.covariance).all()
    assert (np.linalg.eigvalsh(one.covariance) > 0).all()


def test_it_goes_with_the_fingers_where_touch_says_nothing(dex5: HandModel) -> None:
    """A ball turned by fingers that do not slip: its surface does not say how it is turned."""
    q = np.tile([0.0, 0.75, -1.5], (1, 5))
    tip = dex5.fingertip_positions(q)
    centre = tip.mean(axis=1)
    inward = (centre[:, None] - tip) / np.linalg.norm(centre[:, None] - tip, axis=-1)[..., None]
    radius = np.linalg.norm(tip - centre[:, None], axis=-1).mean()
    one = TouchTracking(dex5, Shape.of_object("sphere", 2 * radius), slip=1e-4)
    one.place(np.array([True]), centre, STILL[None])
    about = np.array([[0.0, 0.0, 0.005]])
    turned = 0.0
    for k in range(9):
        turn = np.broadcast_to(from_rotation_vector(k * about)[:, None], (1, 5, 4))
        wanted = centre[:, None] + rotate(turn, tip - centre[:, None])
        for _ in range(10):
            now = dex5.configuration(q)
            jacobian = now.contact_jacobian(now.fingertip_position).reshape(1, -1, dex5.nq)[0]
            error = (wanted - now.fingertip_position).reshape(-1)
            q = q + np.linalg.lstsq(jacobian, error, rcond=None)[0]
        state = GraspState(
            q=q,
            q_target=q,
            in_contact=np.ones((1, 5), bool),
            contact_position=wanted,
            contact_normal=rotate(turn, inward),
            contact_force=np.ones((1, 5)),
        )
        one.track(state)
        turned = k * about[0, 2]
    found = rotation_vector(one.quaternion)[0]
    assert found[2] == pytest.approx(turned, rel=0.25)
    assert np.abs(found[:2]).max() < 0.2 * turned
    assert np.linalg.norm(one.position - centre) < 0.002


def test_normals_that_nobody_felt_do_not_count(dex5: HandModel) -> None:
    """They point to the object's centre: a sensor says so that does not know better."""
    guessed = -POINT / np.linalg.norm(POINT, axis=1, keepdims=True)
    # the fingertip's centre is where it is, on its side of the true contact
    point = POINT - 0.014 * INWARD + 0.014 * guessed
    told = touched(dex5, CENTRE[None], STILL[None], None, point, guessed)
    unfelt = touched(dex5, CENTRE[None], STILL[None], None, point, guessed, felt=False)
    believing, knowing = tracking(dex5, middle_noise=10.0), tracking(dex5, middle_noise=10.0)
    for _ in range(10):
        believing.track(told)
        knowing.track(unfelt)
    assert off(knowing, CENTRE, STILL)[1] < 1e-6 < 0.01 < off(believing, CENTRE, STILL)[1]


def test_a_wild_contact_counts_little(dex5: HandModel) -> None:
    point = POINT.copy()
    point[2] += [0.0, 0.02, 0.0]  # 2 cm above the face
    state = touched(dex5, CENTRE[None], STILL[None], None, point)
    one = tracking(dex5)
    one.track(state)
    assert off(one, CENTRE, STILL)[0] < 0.003


def test_a_batch_is_as_many_single_ones(dex5: HandModel) -> None:
    other = Shape.of_object("u_shape", 0.06)
    surfaces = [CUBE, other, CUBE]
    rng = np.random.default_rng(0)
    position = CENTRE + rng.uniform(-0.002, 0.002, (3, 3))
    quaternion = from_rotation_vector(rng.uniform(-0.05, 0.05, (3, 3)))
    touch = rng.uniform(size=(3, 5)) < 0.8
    state = touched(dex5, position, quaternion, touch)
    whole = tracking(dex5, 3, surfaces)
    single = [tracking(dex5, 1, surface) for surface in surfaces]
    for _ in range(3):
        whole.track(state)
        for i, one in enumerate(single):
            one.track(state[i])
    for i, one in enumerate(single):
        np.testing.assert_allclose(whole.position[i], one.position[0], atol=1e-12)
        np.testing.assert_allclose(whole.quaternion[i], one.quaternion[0], atol=1e-12)
        np.testing.assert_allclose(whole.covariance[i], one.covariance[0], atol=1e-12)


def test_no_touch_at_all_makes_it_less_sure(dex5: HandModel) -> None:
    state = touched(dex5, CENTRE[None], STILL[None], np.zeros((1, 5), bool))
    one = tracking(dex5)
    sure = np.linalg.det(one.covariance)
    for _ in range(5):
        seen = one.track(state[0])
        assert np.linalg.det(one.covariance) > sure
        sure = np.linalg.det(one.covariance)
    np.testing.assert_allclose(one.position[0], CENTRE, atol=1e-12)  # nothing moved it
    assert seen.object_quaternion is not None and seen.object_quaternion.shape == (4,)


def test_it_goes_on_to_the_bit(dex5: HandModel) -> None:
    position = CENTRE[None] + [[0.001, 0.0, 0.0]]
    quaternion = from_rotation_vector(np.array([[0.0, 0.05, 0.0]]))
    state = touched(dex5, position, quaternion)
    one = tracking(dex5)
    one.track(state)
    saved = one.state_dict()
    one.track(state)
    expected = one.position, one.quaternion, one.covariance
    again = tracking(dex5)
    again.load_state_dict(saved)
    again.track(state)
    for a, b in zip(expected, (again.position, again.quaternion, again.covariance), strict=True):
        np.testing.assert_array_equal(a, b)
    with pytest.raises(InvalidInput, match="tracking by touch"):
        again.load_state_dict({})


def test_what_is_placed_anew_is_at_rest_there(dex5: HandModel) -> None:
    here, still = np.tile(CENTRE, (2, 1)), np.tile(STILL, (2, 1))
    aside = here + np.array([0.003, 0.0, 0.0])
    one = tracking(dex5, 2)
    for place in (here, aside):  # both are on the move
        one.track(touched(dex5, place, still))
    moved, turned = CENTRE[None] + 0.5, from_rotation_vector(np.array([[0.0, 0.0, 1.0]]))
    one.place(np.array([True, False]), moved, turned)
    before = one.position.copy()
    for _ in range(2):
        one.track(touched(dex5, aside, still, np.zeros((2, 5), bool)))
    np.testing.assert_allclose(one.position[0], moved[0], atol=1e-12)
    np.testing.assert_allclose(one.quaternion[0], turned[0], atol=1e-12)
    assert one.position[1, 0] > before[1, 0] + 1e-4  # goes on


def test_it_stays_finite_for_as_long_as_an_hour(dex5: HandModel) -> None:
    """Touch comes and goes, and for minutes there is none."""
    rng = np.random.default_rng(0)
    one = tracking(dex5)
    there = CENTRE[None], STILL[None]
    states = [touched(dex5, *there, rng.uniform(size=(1, 5)) < share) for share in (0.0, 0.5, 1.0)]
    now = dex5.configuration(states[0].q)
    for i in range(3000):
        state = states[0] if i > 2900 else states[rng.integers(3)]
        one.update(state, now, state.in_contact)
    one.covariance = one.covariance + 69_000 * 2.5e-3 * np.eye(6)  # which is what no touch adds
    one.update(states[2], now, states[2].in_contact)
    assert np.isfinite(one.covariance).all()
    assert np.linalg.eigvalsh(one.covariance).min() > 0
    np.testing.assert_allclose(one.covariance, one.covariance.swapaxes(1, 2), rtol=1e-6, atol=1e-9)


def test_bad_input_gets_one_line(dex5: HandModel) -> None:
    with pytest.raises(InvalidInput, match="slip is -1"):
        TouchTracking(dex5, CUBE, slip=-1)
    with pytest.raises(InvalidInput, match="middle_noise is 0"):
        TouchTrackingConfig(middle_noise=0)
    with pytest.raises(InvalidInput, match="hand is 'dex5'; expected a HandModel"):
        TouchTracking("dex5", CUBE)  # type: ignore[arg-type]
    with pytest.raises(InvalidInput, match="surface is 'cube'; expected a shape, such as dexctl.s"):
        TouchTracking(dex5, "cube")  # type: ignore[arg-type]
    with pytest.raises(InvalidInput, match="control_period is 0; expected seconds above 0"):
        TouchTracking(dex5, CUBE, control_period=0)
    one = tracking(dex5, 2)
    both, first = np.array([True, True]), np.array([True, False])
    for rows, place, turn, said in (
        ([1, 0], CENTRE, STILL, "mask has shape"),
        (first, CENTRE[:2], STILL, "expected 3 finite numbers, or 1 times 3"),
        (first, [0.0, np.nan, 0.0], STILL, "position is array"),
        (both, np.zeros((3, 3)), STILL, "or 2 times 3"),
        (both, CENTRE, 2 * STILL, "expected a unit quaternion"),
        (both, "here", STILL, "position is not an array of numbers: 'here'"),
    ):
        before = one.state_dict()
        with pytest.raises(InvalidInput, match=said):
            one.place(rows, place, turn)  # type: ignore[arg-type]
        for name, value in one.state_dict().items():
            np.testing.assert_array_equal(value, before[name])
    with pytest.raises(InvalidInput, match="3 surfaces for 2 hands; expected one, or one for each"):
        TouchTracking(dex5, [CUBE, CUBE, CUBE]).start(2)
    state = touched(dex5, np.tile(CENTRE, (2, 1)), np.tile(STILL, (2, 1)))
    with pytest.raises(InvalidInput, match="the state is of 2 hands; expected 1"):
        tracking(dex5).track(state)


def test_turns_add_up_in_the_hands_frame(dex5: HandModel) -> None:
    """`covariance` and corrections are of turns in the hand's frame, whatever the object's."""
    tilted = from_rotation_vector(np.array([[0.0, np.pi / 2, 0.0]]))
    state = touched(
        dex5, CENTRE[None], multiply(from_rotation_vector(np.array([[0, 0, 0.1]])), tilted)
    )
    one = tracking(dex5, middle_noise=10.0)
    one.place(np.array([True]), CENTRE[None], tilted)
    for _ in range(30):
        one.track(state)
    found = rotation_vector(multiply(one.quaternion, inverse(tilted)))[0]
    np.testing.assert_allclose(found, [0, 0, 0.1], atol=3e-3)
    assert np.abs(cross(found, np.array([0, 0, 1.0]))).max() < 3e-3
